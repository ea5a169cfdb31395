"""Commands that need an optional part of the installation say so."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from nextview.errors import MissingExtraError


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Turn a failed import within into a sentence that says what to install."""
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(f"this command needs {error.name}: pip install 'nextview[{extra}]'") from None
