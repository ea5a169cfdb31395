"""One page for each bundled model, from its card."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from nextview.policies.policy_card import PolicyCard, bundled_policies, read_policy_card
from nextview.recognition.model_card import ModelCard, bundled_cards

USE = {
    "recogniser": (
        "Names the object in the depth image of a view; the evidence of several is fused into a"
        " belief."
    ),
    "features": (
        "Turns a view into 256 numbers that alike views share; how novel an object is follows from"
        " them."
    ),
    "lem": (
        "Predicts the depth entropy of the views around the current one (local-depth-entropy map)."
    ),
    "lcm": (
        "Predicts the recogniser's confidence in the views around the current one (local confidence"
        " map)."
    ),
    "gain": (
        "Values every candidate view by what it is expected to add to the belief, less its weighted"
        " travel."
    ),
    "fixed-sequence": "Makes the same moves whatever is seen.",
    "fixed-ring": "Goes round one ring of views.",
    "class-table": "Values views by a table, by the class that is believed.",
}
"""What a model or policy of each kind is for."""
LIMITS = (
    "It was trained on clean renders of ModelNet10's upright objects, one object a picture, seen"
    " from 40 places, from the horizon to 72 degrees above it. An object of another class is given"
    " one of the ten names unless `--unknown` is used. What noise, missing depth and views from"
    " elsewhere cost is measured in [the results](../results.md) and in [your"
    " camera](../your_camera.md)."
)


@cache
def card_pages() -> dict[str, str]:
    """Markdown of each page by its place in the site; the first lists them all."""
    models, policies, rows = bundled_cards(), bundled_policies(), []
    pages = {f"models/{name}.md": _model_page(card) for name, card in models.items()}
    for card in models.values():
        rows.append(
            f"| [{card.name}]({card.name}.md) | {card.network} | {USE[card.kind]} |"
        )
    cards = {name: read_policy_card(path) for name, path in policies.items()}
    for name, policy in cards.items():
        pages[f"models/{name}.md"] = _policy_page(name, policy)
        rows.append(
            f"| [{name}]({name}.md) | policy, {policy.scope} | {USE[policy.kind]} |"
        )
    table = "\n".join(["| model | what it is | what it does |", "|---|---|---|", *rows])
    about = "From their cards. `nextview list models NAME` prints one whole."
    top = f"# Models that ship with nextview\n\n{about}\n\n{table}\n"
    return {"models/index.md": top} | pages


def _model_page(card: ModelCard) -> str:
    facts = {
        "network": card.network,
        "input": f"{card.input.kind}, {card.input.size} x {card.input.size} pixels",
        "weights": (
            f"{card.path.name}, {card.path.stat().st_size / 1e6:.1f} MB, SHA-256 `{card.sha256}`"
        ),
        "learned from": card.training.data,
        "held out for validation": f"{len(card.held_out)} objects of the training split",
        **{f"{name} fitted to": value for name, value in card.fitted_to.items()},
    }
    if card.is_recogniser:
        facts |= {
            "classes": ", ".join(c.replace("_", " ") for c in card.classes),
            "azimuth bins": card.azimuth_bins,
            "temperature of one view": f"{card.calibration.temperature:g}",
            "correlation of two views": f"{card.calibration.correlation:g}",
        }
    elif card.kind != "features":
        facts |= {
            "output": card.output,
            "valley classes": ", ".join(card.valley_classes) or "none",
        }
    parts = [f"# {card.name}", USE[card.kind], card.note, _table(facts)]
    parts += ["## Scores", _table(dict(_scores(card.scores)), ("measured on", ""))]
    if card.memory is not None:
        parts += ["## Attribution", card.memory.attribution]
    limits = (
        ["## Limits", LIMITS] if card.memory is None and card.kind != "features" else []
    )
    parts += [*limits, "## How it was made", _shell(card.training.commands)]
    for k, recipe in enumerate(card.training.recipes, 1):
        parts += [f"Recipe {k}:", _table(recipe, ("option", "value"))]
    return "\n\n".join(filter(None, parts)) + "\n"


def _policy_page(name: str, card: PolicyCard) -> str:
    facts = {
        "kind": card.kind,
        "scope": card.scope,
        "viewpoints": f"{len(card.elevations)} rings of {card.azimuths}",
        "learned from": card.learned_from,
    }
    if card.sha256:
        facts["weights"] = f"{name}.onnx, SHA-256 `{card.sha256}`"
    parts = [
        f"# {name}",
        USE[card.kind],
        _table(facts),
        f"Use it with `--policy {name}`.",
    ]
    parts += ["## How it was made", _shell(card.commands)]
    if card.settings:
        parts.append(_table(card.settings, ("option", "value")))
    return "\n\n".join(parts) + "\n"


def _scores(scores: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for objects, measured in scores.items():
        yield (
            objects,
            "<br>".join(
                f"{key.replace('_', ' ')}: {_value(value)}"
                for key, value in measured.items()
            ),
        )


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {each}" for key, each in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _table(rows: Mapping[str, Any], heads: tuple[str, str] = ("", "")) -> str:
    lines = [
        f"| {key} | {_value(value)} |"
        for key, value in rows.items()
        if value not in ("", None)
    ]
    return "\n".join([f"| {heads[0]} | {heads[1]} |", "|---|---|", *lines])


def _shell(commands: tuple[str, ...]) -> str:
    return "```sh\n" + "\n".join(commands) + "\n```" if commands else ""
