"""What the models say of views: the evidence that belief and policies work with."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nextview.recognition.novelty import ViewScore
from nextview.sensing.observation import Observation
from nextview.types import Floats, Mask


@dataclass(frozen=True)
class Evidence:
    """What the models say of one view in each of B episodes.

    Attributes:
        logits: (B, classes) float.
        maps: the maps that the policy needs, by name: local maps ("lem"), (B, rings, 3) float, and
            maps of the whole sphere ("lem-sphere"), (B, rings, azimuths), columns once round from
            the view.
        azimuth_bins: log-likelihood of each azimuth bin being the one that is seen, given each
            class, (B, classes, azimuth bins) float. None if the recogniser cannot tell.
        seen: whether anything was seen, (B,) bool; None if something was in all. A view without is
            no evidence: in episodes all the above counts as zero there.
        novelty: score of each view, B of them, made when asked for, see
            ``nextview.recognition.novelty``; None if the recogniser judges no single views.
        observations: the views themselves, B of them; None where only what the models say is known.

    Example:
        >>> Evidence(np.zeros((2, 10))).select([0]).logits.shape
        (1, 10)
    """

    logits: Floats
    maps: dict[str, Floats] = field(default_factory=dict)
    azimuth_bins: Floats | None = None
    seen: Mask | None = None
    novelty: Sequence[ViewScore] | None = None
    observations: Sequence[Observation] | None = None

    def select(self, rows: Any) -> "Evidence":
        """Evidence of some of the episodes, by index or mask."""

        def some(values: Any) -> Any:
            return None if values is None else values[rows]

        maps = {name: values[rows] for name, values in self.maps.items()}
        novelty = items_at(self.novelty, rows)
        observations = items_at(self.observations, rows)
        bins, seen = map(some, (self.azimuth_bins, self.seen))
        return Evidence(self.logits[rows], maps, bins, seen, novelty, observations)


def items_at(items: Sequence[Any] | None, rows: Any) -> list[Any] | None:
    """Select items of a sequence.

    Args:
        items: the sequence, or None.
        rows: indices or a mask.

    Returns:
        The selected items; None of None.
    """
    return None if items is None else [items[i] for i in np.arange(len(items))[rows]]
