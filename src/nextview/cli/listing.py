"""``nextview list``: what ships with the package."""

from __future__ import annotations

from typing import Literal

from rich.table import Table

from nextview.cli.progress import Terminal
from nextview.files import sha256_of
from nextview.recognition.model_card import bundled_cards, find_card


def show(what: Literal["models", "measures"], name: str | None = None, /) -> None:
    """List the bundled models, or the view measures: what makes a view good.

    A measure that needs the depth is computed from a view store alone. One that needs the mesh also takes the folder of
    meshes that the store was rendered from. MODULE:FUNCTION is a measure of your own (docs/add_a_measure.md).

    Args:
        what: models or measures.
        name: of a model: print its whole card.
    """
    if what == "measures":
        from nextview.data.measures import all_measures

        table = Table("measure", "needs", "better views", "source")
        for key, measure in all_measures().items():
            table.add_row(key, measure.needs, "high" if measure.good == "peak" else "low", measure.source)
        return Terminal().print(table)
    if name:
        print(find_card(name).path.with_suffix(".json").read_text())
        return None
    table = Table("model", "kind", "MB", "scores on test", "file")
    table.columns[0].no_wrap = True
    for card in bundled_cards().values():
        tested = []
        for split, scores in card.scores.items():
            if split.startswith("test"):
                tested.append(split)
                tested += [f"  {score.replace('_', ' ')} {_score(value)}" for score, value in scores.items()]
        intact = "intact" if sha256_of(card.path) == card.sha256 else "DAMAGED"
        table.add_row(card.name, card.kind, f"{card.path.stat().st_size / 1e6:.1f}", "\n".join(tested), intact)
    return Terminal().print(table)


def _score(value: float | dict[str, float]) -> str:
    return f"{value['instance']}\n    class mean {value['class']}" if isinstance(value, dict) else f"{value}"
