"""The ``nextview`` command: each subcommand is one file beside this one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import tyro

from nextview import __version__
from nextview.cli.benchmark import benchmark
from nextview.cli.capture import capture
from nextview.cli.check import check
from nextview.cli.correspond import correspond
from nextview.cli.demo import demo
from nextview.cli.download import download
from nextview.cli.ending import orderly_end
from nextview.cli.evaluate import evaluate
from nextview.cli.export import export_lcm, export_lem, export_recogniser
from nextview.cli.fit import fit_calibration, fit_size, fit_valleys
from nextview.cli.fit_policies import fit_policies
from nextview.cli.fit_unknown import fit_unknown
from nextview.cli.inspect import inspect
from nextview.cli.measure import measure
from nextview.cli.models import models
from nextview.cli.predict import predict
from nextview.cli.presets import with_preset
from nextview.cli.recognise import recognise
from nextview.cli.render import render
from nextview.cli.report import report
from nextview.cli.train_gain import train_gain
from nextview.cli.train_grid import train_grid
from nextview.cli.train_maps import train_lcm, train_lem
from nextview.cli.train_recogniser import train_recogniser

COMMANDS: dict[str, Any] = {
    "recognise": recognise,
    "demo": demo,
    "capture": capture,
    "models": models,
    "download": download,
    "render": render,
    "check": check,
    "measure": measure,
    "correspond": correspond,
    "inspect": inspect,
    "train": {
        "recogniser": train_recogniser,
        "grid": train_grid,
        "lem": train_lem,
        "lcm": train_lcm,
        "gain": train_gain,
    },
    "export": {"recogniser": export_recogniser, "lem": export_lem, "lcm": export_lcm},
    "predict": predict,
    "fit": {
        "size": fit_size,
        "calibration": fit_calibration,
        "unknown": fit_unknown,
        "valleys": fit_valleys,
        "policies": fit_policies,
    },
    "evaluate": evaluate,
    "benchmark": benchmark,
    "report": report,
}
GROUPS = {
    "train": "Train a network on a view store.",
    "export": "Turn a training run into an ONNX model with a card.",
    "fit": "Fit what sizes mean, a recogniser's calibration, what it does not know, a map's valleys, simple policies.",
}


def main(arguments: list[str] | None = None) -> None:
    """Run a command; see ``orderly_end`` for how it may end."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with orderly_end(_advice(arguments)):
        _run(arguments)


def _run(arguments: list[str]) -> None:
    commands = COMMANDS
    if arguments == ["--version"]:
        print(f"nextview {__version__}")
        return
    prog, description = "nextview", "Active 3D object recognition: what it is, and where to look next."
    if arguments and isinstance(commands.get(arguments[0]), dict):  # a group, such as nextview train
        prog, description = f"{prog} {arguments[0]}", GROUPS[arguments[0]]
        commands, arguments = commands[arguments[0]], arguments[1:]
        commands = {name: with_preset(command, arguments) for name, command in commands.items()}
    else:
        commands = {name: _group(name) if isinstance(c, dict) else c for name, c in commands.items()}
    tyro.extras.subcommand_cli_from_dict(
        commands,
        prog=prog,
        description=description,
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def _advice(arguments: list[str]) -> str:
    """How to go on with a command that was stopped; those that resume say so in their help."""
    command: Any = COMMANDS
    for name in arguments[:2]:
        command = command.get(name) if isinstance(command, dict) else command
    resumes = "Resumes" in (getattr(command, "__doc__", None) or "") and not isinstance(command, dict)
    return "run the same command again" + ("; it resumes" if resumes else "")


def _group(name: str) -> Callable[[], None]:
    """Stands for a group in the list of commands; the group itself is taken apart before."""

    def group() -> None:
        raise AssertionError(name)

    group.__doc__ = GROUPS[name]
    return group


if __name__ == "__main__":
    main()
