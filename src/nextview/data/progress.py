"""Report the progress of a long job with a progress bar, lines of text, or not at all."""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable

TrackProgress = Callable[[Iterable[int], int, str], None]
"""Exhausts an iterable of counts of finished items, given their total and the name of the work.

``cli.progress.track``, a progress bar, is one; ``in_lines`` and ``silently`` are others.
"""
# seconds before the second line, and largest interval between lines
FIRST_WAIT = 5.0
LONGEST_WAIT = 30.0


def silently(done: Iterable[int], total: int, what: str, /) -> None:
    """Do the work without showing progress.

    Args:
        done: increasing counts of finished items.
        total: final count.
        what: name of the work.
    """
    deque(done, maxlen=0)


def in_lines(done: Iterable[int], total: int, what: str, /) -> None:
    """Do the work, and print lines to standard error at increasing intervals.

    Args:
        done: increasing counts of finished items.
        total: final count.
        what: name of the work.
    """
    print(f"{what}: {total} to do", file=sys.stderr, flush=True)
    begun = last = time.monotonic()
    wait = FIRST_WAIT
    for n in done:
        now = time.monotonic()
        if now - last > wait:
            line = f"{what}: {n} of {total} after {now - begun:.0f} s"
            print(line, file=sys.stderr, flush=True)
            last = now
            wait = min(2 * wait, LONGEST_WAIT)
