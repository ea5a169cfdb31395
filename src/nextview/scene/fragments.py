"""Small objects beside larger ones that may be parts of these: their names are not confident."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from nextview.scene.tracks import Track

FRAGMENT_PIXELS = 500  # fewer than these look like many small things
TIMES_LARGER = 4  # by which an object has more pixels than a fragment of it


def fragments(
    tracks: Sequence[Track],
    touching: Collection[tuple[int, int]],
) -> list[bool]:
    """Find the objects that may be fragments of others.

    The tip of a banana may look like a die. In so few pixels any small round patch does, so that a
    good fit does not tell a part of an object from a small thing beside it.

    Args:
        tracks: all objects, numbered.
        touching: numbers of all pairs of objects that touch in the picture and in depth.

    Returns:
        Whether each has few pixels in every frame and touches an object that has many more.
    """
    pixels = {
        track.number: max(
            (int(np.count_nonzero(mask)) for mask in track.pixels.values()),
            default=0,
        )
        for track in tracks
    }

    found = []
    for track in tracks:
        own = pixels[track.number]
        beside = [
            pixels.get(number, 0)
            for pair in touching
            if track.number in pair
            for number in pair
            if number != track.number
        ]
        larger = max(beside, default=0) >= TIMES_LARGER * own
        found.append(own < FRAGMENT_PIXELS and larger)
    return found
