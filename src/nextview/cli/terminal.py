"""Printing names that may hold anything."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from nextview.cli.ending import printable


class Terminal(Console):
    """Prints text as it is: brackets and colons in names are no markup, and control characters are shown, not sent."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Every text passes here, those in tables too."""
        return super().render_str(printable(text), **options)
