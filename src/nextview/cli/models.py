"""``nextview models``: what ships with the package."""

from __future__ import annotations

import tyro


def models(name: tyro.conf.Positional[str | None] = None, /) -> None:
    """List the bundled models, or print the whole card of one.

    Args:
        name: the model whose card to print.
    """
    import json

    from rich.table import Table

    from nextview.cli.terminal import Terminal
    from nextview.models.model_card import bundled_cards, file_hash, find_card

    if name:
        print(json.dumps(find_card(name).to_dict(), indent=1))
        return
    table = Table("model", "kind", "MB", "scores on test", "file")
    table.columns[0].no_wrap = True
    for card in bundled_cards().values():
        tested = []
        for split, scores in card.scores.items():
            if split.startswith("test"):
                tested.append(split)
            for score, value in scores.items() if split.startswith("test") else ():
                value = f"{value['instance']}\n    class mean {value['class']}" if isinstance(value, dict) else value
                tested.append(f"  {score.replace('_', ' ')} {value}")
        intact = "intact" if file_hash(card.path) == card.sha256 else "DAMAGED"
        size = f"{card.path.stat().st_size / 1e6:.1f}"
        table.add_row(card.name, card.kind, size, "\n".join(tested), intact)
    Terminal().print(table)
