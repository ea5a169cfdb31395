"""The recognisers that an export averages: training runs, or recognisers that were exported before."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.data.splits import split_training
from nextview.data.store import ViewStore
from nextview.errors import ModelError
from nextview.models.model_card import find_card
from nextview.models.network_input import CHANNELS_OF, InputSpec
from nextview.training.architectures import ResNet, recogniser_network
from nextview.training.checkpoints import exported_networks, load_run
from nextview.training.lite import LiteNet
from nextview.training.recipes import RecogniserRecipe
from nextview.training.runs import read_commands, read_recipe


@dataclass(frozen=True)
class Member:
    """One of them.

    Attributes:
        source: the folder of the run, or the card.
        input: what its networks take.
        validated: names of the training split's objects that it was not trained on and that chose its epoch.
        held: names of those kept from it altogether, as a fold.
        recipes: of its training, the last one last.
        commands: that led to it, as far as its run or card names them.
    """

    source: Path
    input: InputSpec
    validated: frozenset[str]
    held: frozenset[str]
    recipes: list[RecogniserRecipe]
    commands: list[str]


@takes_paths("source")
def member(source: Path, views: ViewStore) -> Member:
    """What is known of a run (a folder), or of an exported recogniser (its card, NAME.json).

    Raises:
        ModelError: it is neither, or the recogniser was not trained on this store.
    """
    if source.suffix == ".json":
        return _exported(source, views)
    recipe = read_recipe(source, RecogniserRecipe)
    _, aside = split_training(views, recipe.validation, recipe.seed)
    noted = source / "held_out.json"
    held = json.loads(noted.read_text()) if noted.exists() else []
    validated = frozenset(views.names[i] for i in aside)
    return Member(
        source, InputSpec(recipe.input, recipe.size), validated, frozenset(held), [recipe], list(read_commands(source))
    )


def _exported(source: Path, views: ViewStore) -> Member:
    model = find_card(source)
    if model.kind != "recogniser":
        raise ModelError(f"{source}: is a {model.kind}, not a recogniser")
    kept = frozenset(model.held_out) & frozenset(views.names)
    if list(model.classes) != views.classes or not kept:
        raise ModelError(f"{source}: is a recogniser of other objects than {views.path} holds")
    try:
        recipes = [RecogniserRecipe(**recipe) for recipe in model.training.recipes]
    except TypeError as error:
        raise ModelError(f"{source}: says not, or not as this version does, how it was trained ({error})") from None
    if not recipes:
        raise ModelError(f"{source}: does not say how it was trained")
    return Member(source, model.input, kept, frozenset(), recipes, list(model.training.commands))


def member_networks(one: Member, views: ViewStore, sample: NDArray[np.uint8]) -> list[ResNet | LiteNet]:
    """Its networks, in evaluation mode: that of a run, or all that an exported recogniser averages.

    Args:
        one: the member.
        views: the store that it was trained on.
        sample: some views' inputs, (B, C, S, S); see ``weights.load_exported``.
    """
    if one.source.suffix == ".json":
        return exported_networks(one.source, CHANNELS_OF[one.input.kind], torch.from_numpy(sample).float() / 255)
    return [run_network(one.source, one.recipes[0], views)]


def run_network(run: Path, recipe: RecogniserRecipe, views: ViewStore) -> ResNet | LiteNet:
    """The recogniser of a finished run, in evaluation mode."""
    azimuths = views.sphere.azimuths if recipe.azimuth_bins_weight else 0
    return load_run(recogniser_network(recipe, len(views.classes), azimuths), run)
