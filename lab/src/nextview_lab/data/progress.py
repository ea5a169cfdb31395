"""Progress of jobs whose results are kept."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

from nextview.data.progress import TrackProgress

Result = TypeVar("Result")


def collected(
    results: Iterable[Result],
    total: int,
    what: str,
    track: TrackProgress,
) -> list[Result]:
    """Return results that are computed one after the other, and show the progress.

    Args:
        results: as yet not computed.
        total: their number.
        what: name of the work.
        track: shows the progress.
    """
    found: list[Result] = []

    def counts() -> Iterator[int]:
        for one in results:
            found.append(one)
            yield len(found)

    track(counts(), total, what)
    return found
