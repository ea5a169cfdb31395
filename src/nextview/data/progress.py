"""How a long job tells how far it is, to whoever wants to know: a progress bar, a log or nobody."""

from collections import deque
from collections.abc import Callable, Iterable

TrackProgress = Callable[[Iterable[int], int, str], None]
"""Follows one part of a job to its end, given counts of what is done, their last one and its name.

``cli.progress.track``, a progress bar, is one; ``silently`` is another.
"""


def silently(done: Iterable[int], total: int, what: str, /) -> None:
    """Do the work without showing progress.

    Args:
        done: growing counts.
        total: number that is reached at the end.
        what: name of the work.
    """
    deque(done, maxlen=0)
