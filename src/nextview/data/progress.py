"""How a long job tells how far it is, to whoever wants to know: a progress bar, lines or nobody."""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable

TrackProgress = Callable[[Iterable[int], int, str], None]
"""Follows one part of a job to its end, given counts of what is done, their last one and its name.

``cli.progress.track``, a progress bar, is one; ``in_lines`` and ``silently`` are others.
"""
# seconds to the second line, and between two lines in the end
FIRST_WAIT = 5.0
LONGEST_WAIT = 30.0


def silently(done: Iterable[int], total: int, what: str, /) -> None:
    """Do the work without showing progress.

    Args:
        done: growing counts.
        total: number that is reached at the end.
        what: name of the work.
    """
    deque(done, maxlen=0)


def in_lines(done: Iterable[int], total: int, what: str, /) -> None:
    """Do the work, and print lines to standard error: one at once, and then less and less often.

    Args:
        done: growing counts.
        total: number that is reached at the end.
        what: name of the work.
    """
    print(f"{what}: begun, {total} in all", file=sys.stderr, flush=True)
    begun = last = time.monotonic()
    wait = FIRST_WAIT
    for n in done:
        now = time.monotonic()
        if now - last > wait:
            line = f"{what}: {n} of {total} after {now - begun:.0f} s"
            print(line, file=sys.stderr, flush=True)
            last = now
            wait = min(2 * wait, LONGEST_WAIT)
