"""Commands that take a recipe offer named ones: --preset sets the defaults of all its options.

Presets of tyro's own (``tyro.extras.overridable_config_cli``) are subcommands: options of the recipe could then be
given only after the name of a preset, the default one too.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from nextview.cli.train_agent import train_agent
from nextview.cli.train_maps import train_lcm, train_lem, train_map
from nextview.cli.train_recogniser import train_recogniser
from nextview.training.recipes import MVSELECT, THESIS_MAP, THESIS_RECOGNISER, AgentRecipe, MapRecipe, RecogniserRecipe

PRESETS: dict[Callable, dict[str, Any]] = {
    train_recogniser: {"default": RecogniserRecipe(), "thesis": THESIS_RECOGNISER},
    train_map: {"default": MapRecipe(), "thesis": THESIS_MAP},
    train_lem: {"default": MapRecipe(), "thesis": THESIS_MAP},
    train_lcm: {"default": MapRecipe(), "thesis": THESIS_MAP},
    train_agent: {"default": AgentRecipe(), "mvselect": MVSELECT},
}
"""The recipes of each command that has several."""


def with_preset(command: Callable, arguments: Sequence[str]) -> Callable:
    """A command whose recipe begins as the preset that the arguments name, so that any option of it can be changed.

    Args:
        command: with a parameter ``recipe``; one that has no presets is returned as it is.
        arguments: of the command line.
    """
    presets = PRESETS.get(command)
    if presets is None:
        return command
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset", default="default")
    try:
        chosen = parser.parse_known_args(list(arguments))[0].preset
    except argparse.ArgumentError:  # --preset without a name: tyro says so
        chosen = "default"
    signature = inspect.signature(command)
    recipe = signature.parameters["recipe"].replace(default=presets.get(chosen, presets["default"]))
    help_text = "which recipe the options below begin as: the published one, or ours"
    kind = Annotated[Literal[tuple(presets)], tyro.conf.arg(help=help_text)]  # type: ignore[valid-type]
    preset = inspect.Parameter("preset", inspect.Parameter.KEYWORD_ONLY, default="default", annotation=kind)

    def started(*args: Any, **options: Any) -> Any:
        del options["preset"]
        return command(*args, **options)

    parameters = [recipe if name == "recipe" else p for name, p in signature.parameters.items()]
    started.__doc__ = command.__doc__
    started.__signature__ = signature.replace(parameters=[*parameters, preset])  # type: ignore[attr-defined]
    started.__annotations__ = get_type_hints(command, include_extras=True) | {"preset": kind}
    return started
