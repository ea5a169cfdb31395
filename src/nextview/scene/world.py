"""The set of posed things that explains the pixels of all frames best.

A table of hypotheses and views holds the score of each pair. It gains a column with each frame and
rows where a frame shows something that no chosen hypothesis explains. Things are chosen greedily:
each pixel counts once, for the hypothesis that explains it best. An object of which no model is
known, a stranger, explains its pixels a little, so that a name has to explain them better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nextview.segmentation.view import Segment, View
from nextview.things.library import Hypotheses, Library
from nextview.things.propose import propose
from nextview.things.register import camera_error, register
from nextview.things.score import PIXEL_GAIN, Score, score, total
from nextview.types import Float, Float32, Index, Mask

NEW_OBJECT = 20.0  # nats that an object has to explain to be one
STRANGER_GAIN = 0.45  # nats, of a pixel of something without a model
EXPLAINED = 0.6  # share of a segment that is explained, from which on it is not searched
EXPLAINS = 0.5  # nats of a pixel from which on it is explained
RIVALS = 12  # hypotheses of one place that are kept
RIVALS_OF_ONE = 2
CLEAR_SHARE = 0.5  # share of the possible gain from which on a thing corrects the camera


@dataclass(frozen=True, eq=False)
class Explanation:
    """One thing of a world.

    Attributes:
        row: of its hypothesis.
        gain: over what the others explain, nats.
        share: of the gain that it could have at most.
        lead: over the best hypothesis of another thing at its place, nats.
        rival: row of that hypothesis; -1 for none.
    """

    row: int
    gain: float
    share: float
    lead: float
    rival: int


@dataclass(eq=False)
class World:
    """Hypotheses, views, and how well each explains each.

    Attributes:
        library: the taught things.
        views: in the order of their frames.
        hypotheses: that are kept; None for none.
        scores: of each hypothesis in each view.
        chosen: those that explain the views best together.
    """

    library: Library
    views: list[View] = field(default_factory=list)
    hypotheses: Hypotheses | None = None
    scores: list[list[Score | None]] = field(default_factory=list)
    chosen: list[Explanation] = field(default_factory=list)

    def update(self, view: View) -> None:
        """Take another view."""
        among = np.ones(len(self.library), bool)
        clear = [one.row for one in self.chosen if one.share > CLEAR_SHARE]
        if clear:
            view = camera_error(self.library, view, self.hypotheses[np.array(clear)])
        self.views.append(view)
        if self.hypotheses is not None:
            some = register(self.library, self.views, self.hypotheses, (0.03, 0.02), 96)
            self.hypotheses = some
            columns = [score(self.library, one, some) for one in self.views]
            self.scores = [list(row) for row in zip(*columns, strict=True)]
            self.choose()
        for segments in (view.instances, view.unions, view.fragments):
            explained = self.explained(len(self.views) - 1)
            left = [
                one
                for one in segments()
                if explained[one.mask].mean() < EXPLAINED
            ]
            new = propose(self.library, view, left, among)
            if new is None:
                continue
            self.add(new)
            self.choose()
        self.prune()

    def add(self, new: Hypotheses) -> None:
        """Add hypotheses, registered to all views."""
        if len(self.views) > 1:
            new = register(self.library, self.views, new, (0.04, 0.03, 0.02), 64)
        columns = [score(self.library, one, new) for one in self.views]
        self.scores += [list(row) for row in zip(*columns, strict=True)]
        old = self.hypotheses
        self.hypotheses = new if old is None else Hypotheses.joined([old, new])

    @property
    def totals(self) -> Float:
        """Score of each hypothesis alone, over all views, nats, (M,)."""
        return np.array([total(row) for row in self.scores])

    def explained(self, number: int) -> Mask:
        """Return the pixels of a view that its things explain, (H, W) bool."""
        view = self.views[number]
        shown = np.zeros(view.grid().depth.shape, bool)
        for one in self.chosen:
            found = self.scores[one.row][number]
            if found is not None and one.share > CLEAR_SHARE:
                shown.ravel()[found.cells[found.gain > EXPLAINS]] = True
        stride = view.stride
        large = np.repeat(np.repeat(shown, stride, 0), stride, 1)
        return large[: view.depth.shape[0], : view.depth.shape[1]]

    def choose(self) -> None:
        """Choose the things that explain all views best together."""
        totals = self.totals
        have = [np.zeros(view.grid().depth.size, np.float32) for view in self.views]
        bounds = {
            int(row): float(totals[row]) for row in np.flatnonzero(totals > NEW_OBJECT)
        }
        gains: list[tuple[int, float]] = []
        while bounds:
            row = max(bounds, key=lambda one: bounds[one])
            gain = sum(
                float(_added(one, have[number]).sum()) + one.paid
                for number, one in enumerate(self.scores[row])
                if one is not None
            )
            if gain <= NEW_OBJECT:
                del bounds[row]
                continue
            if gain < max((bounds[one] for one in bounds if one != row), default=0.0):
                bounds[row] = gain
                continue
            del bounds[row]
            gains.append((row, gain))
            for number, one in enumerate(self.scores[row]):
                if one is not None:
                    cells = one.cells
                    have[number][cells] = np.maximum(have[number][cells], one.gain)
        self.chosen = [self._explanation(row, gain, totals) for row, gain in gains]

    def _explanation(self, row: int, gain: float, totals: Float) -> Explanation:
        """Say how well a chosen hypothesis explains the views."""
        some = self.hypotheses
        thing = some.things[row]
        near = np.linalg.norm(some.centres - some.centres[row], axis=1)
        beside = (some.things != thing) & (near < self.library.radii[thing])
        best = np.where(beside, totals, 0.0)
        rival = int(best.argmax())
        seen = sum(one.seen for one in self.scores[row] if one is not None)
        return Explanation(
            row,
            gain,
            gain / max(1.0, PIXEL_GAIN * seen),
            float(totals[row] - best[rival]),
            rival if best[rival] > 0 else -1,
        )

    def prune(self) -> None:
        """Keep the chosen hypotheses, and the likeliest others of each place."""
        some = self.hypotheses
        if some is None:
            return
        totals = self.totals
        kept = {one.row for one in self.chosen}
        places: list[int] = []
        for row in np.argsort(-totals).tolist():
            radius = np.maximum(
                self.library.radii[some.things[row]],
                self.library.radii[some.things[places]],
            )
            apart = np.linalg.norm(some.centres[places] - some.centres[row], axis=1)
            near = apart < 0.5 * radius
            same = near & (some.things[places] == some.things[row])
            few = near.sum() < RIVALS and same.sum() < RIVALS_OF_ONE
            if row in kept or (few and totals[row] > 0):
                kept.add(row)
                places.append(row)
        rows = np.array(sorted(kept), np.int64)
        number = {int(row): at for at, row in enumerate(rows)}
        self.hypotheses = some[rows]
        self.scores = [self.scores[row] for row in rows]
        self.chosen = [
            replace(
                one,
                row=number[one.row],
                rival=number.get(one.rival, -1),
            )
            for one in self.chosen
        ]


def _added(one: Score, have: Float32) -> Float32:
    """Return what each pixel of a score adds to what is explained, nats."""
    return np.maximum(one.gain - have[one.cells], np.minimum(one.gain, 0))
