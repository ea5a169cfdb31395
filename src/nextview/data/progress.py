"""How a long job tells how far it is, to whoever wants to know: a progress bar, a log or nobody."""

from collections import deque
from collections.abc import Iterable
from typing import Protocol


class Track(Protocol):
    """Follows one part of a job to its end. ``cli.progress.track``, a progress bar, is one; ``silently`` is another."""

    def __call__(self, done: Iterable[int], total: int, what: str, /) -> None:
        """Draw all of ``done``."""


def silently(done: Iterable[int], total: int, what: str, /) -> None:
    """Do the work and tell nobody."""
    deque(done, maxlen=0)
