"""For how many columns the output is laid out."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

NARROWEST, WIDEST = 20, 500
"""Columns that help and tables are laid out for: in five, laying out the help never ends and takes all memory."""


@contextmanager
def sensible_columns() -> Iterator[None]:
    """Lay out for no fewer and no more columns than make sense."""
    before = os.environ.get("COLUMNS")
    columns = shutil.get_terminal_size().columns
    if before is not None or not NARROWEST <= columns <= WIDEST:
        os.environ["COLUMNS"] = str(min(max(columns, NARROWEST), WIDEST))
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("COLUMNS", None)
        else:
            os.environ["COLUMNS"] = before
