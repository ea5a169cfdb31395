"""``nextview list``: the bundled models."""

from typing import Literal

from rich.table import Table

from nextview.cli.progress import Terminal
from nextview.files import sha256_of
from nextview.recognition.model_card import bundled_cards, find_card


def show(
    what: Literal["models"],
    name: str | None = None,
    /,
) -> None:
    """List the bundled models.

    Args:
        what: list to print.
        name: model whose card is printed instead of the list.
    """
    if name:
        return print(find_card(name).card_path.read_text(encoding="utf-8"))
    table = Table("model", "kind", "MB", "scores on test", "file")
    table.columns[0].no_wrap = True
    for card in bundled_cards().values():
        tested = []
        for split, scores in card.scores.items():
            if split.startswith("test"):
                tested.append(split)
                for score, value in scores.items():
                    mean = (
                        f"{value['instance']}\n    class mean {value['class']}"
                        if isinstance(value, dict)
                        else value
                    )
                    tested.append(f"  {score.replace('_', ' ')} {mean}")
        intact = "intact" if sha256_of(card.path) == card.sha256 else "DAMAGED"
        table.add_row(
            card.name,
            card.kind,
            f"{card.path.stat().st_size / 1e6:.1f}",
            "\n".join(tested),
            intact,
        )
    return Terminal().print(table)
