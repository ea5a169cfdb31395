"""The ``nextview`` command: each subcommand is one file beside this one."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import tyro

from nextview import __version__
from nextview.cli.benchmark import benchmark
from nextview.cli.check import check
from nextview.cli.correspond import correspond
from nextview.cli.demo import demo
from nextview.cli.download import download
from nextview.cli.evaluate import evaluate
from nextview.cli.export import export_lcm, export_lem, export_recogniser
from nextview.cli.fit import fit_calibration, fit_policies, fit_size, fit_valleys
from nextview.cli.grid import train_grid
from nextview.cli.inspect import inspect
from nextview.cli.measure import measure
from nextview.cli.models import models
from nextview.cli.predict import predict
from nextview.cli.presets import with_preset
from nextview.cli.recognise import recognise
from nextview.cli.render import render
from nextview.cli.report import report
from nextview.cli.train import train_lcm, train_lem, train_recogniser
from nextview.cli.train_gain import train_gain
from nextview.errors import NextviewError

COMMANDS: dict[str, Any] = {
    "recognise": recognise,
    "demo": demo,
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
    "fit": {"size": fit_size, "calibration": fit_calibration, "valleys": fit_valleys, "policies": fit_policies},
    "evaluate": evaluate,
    "benchmark": benchmark,
    "report": report,
}
GROUPS = {
    "train": "Train a network on a view store.",
    "export": "Turn a training run into an ONNX model with a card.",
    "fit": "Fit what sizes mean, a recogniser's calibration, a map's valleys or simple policies to predictions.",
}


def main(arguments: list[str] | None = None) -> None:
    """Run a command.

    A ``NextviewError``, and an OSError that names its file, end in one sentence on standard error and exit status 2.
    Anything else is a bug: its traceback is shown, and the status is 1.
    """
    commands = COMMANDS
    prog, arguments = "nextview", sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"nextview {__version__}")
        return
    description = "Active 3D object recognition: what it is, and where to look next."
    if arguments and isinstance(commands.get(arguments[0]), dict):  # a group, such as nextview train
        prog, description = f"{prog} {arguments[0]}", GROUPS[arguments[0]]
        commands, arguments = commands[arguments[0]], arguments[1:]
        commands = {name: with_preset(command, arguments) for name, command in commands.items()}
    else:
        commands = {name: _group(name) if isinstance(c, dict) else c for name, c in commands.items()}
    try:
        try:
            tyro.extras.subcommand_cli_from_dict(
                commands,
                prog=prog,
                description=description,
                args=arguments,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
            )
        except NextviewError as error:
            print(f"nextview: {error}", file=sys.stderr)
            sys.exit(2)
        except OSError as error:
            if error.filename is None or isinstance(error, BrokenPipeError):
                raise
            print(f"nextview: {error.filename}: {error.strerror}", file=sys.stderr)
            sys.exit(2)
        finally:
            sys.stdout.flush()  # here and not at the interpreter's end, also after --help, which exits by itself
    except BrokenPipeError:  # whoever read this has gone, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is still to be flushed goes nowhere
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


def _group(name: str) -> Callable[[], None]:
    """Stands for a group in the list of commands; the group itself is taken apart before."""

    def group() -> None:
        raise AssertionError(name)

    group.__doc__ = GROUPS[name]
    return group


if __name__ == "__main__":
    main()
