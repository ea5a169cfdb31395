"""One object of a scene, as users see it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nextview.recognition.poses import PoseCandidate, PoseUncertainty, place_in_words
from nextview.scene.tracks import Track
from nextview.sensing.view_warning import ViewWarning
from nextview.session.result import Recognition
from nextview.types import Float, Mask

UNKNOWN_NAME = "unknown"


@dataclass(frozen=True, eq=False)
class SceneObject:
    """An object that was found.

    Attributes:
        number: stays the same from frame to frame.
        name: which of the known things it is; "unknown" for none of them.
        confidence: belief in the name, 0 to 1; 0 for an unknown object.
        confident: whether the belief is high enough to act on.
        place: of its centre, (3,), metres, in the world; of a single frame without a pose in the
            camera's frame.
        size: extents of what was seen of it, (3,), metres: two sides and the height.
        pixels: its pixels in each frame that shows it, (H, W) bool, by the number of the frame.
        seen_points: corners of the hull of what each frame shows of it, (N, 3), metres.
        touches: numbers of the objects that it touches in the picture and in depth.
        result: all that is known of it.
    """

    number: int
    name: str
    confidence: float
    confident: bool
    place: Float
    size: Float
    pixels: dict[int, Mask] = field(repr=False)
    seen_points: Float = field(repr=False)
    touches: tuple[int, ...]
    result: Recognition = field(repr=False)

    @classmethod
    def of(cls, track: Track, touching: Collection[tuple[int, int]]) -> SceneObject:
        """What users see of an object.

        Args:
            track: the object, judged.
            touching: numbers of all pairs of objects that touch.
        """
        result = track.result
        assert result is not None
        frame = track.thing.object_frame
        sightings = track.thing.sightings
        seen = np.concatenate([one.hull for one in sightings])
        pair = [other for other in touching if track.number in other]
        others = sorted({number for both in pair for number in both} - {track.number})

        return cls(
            number=track.number,
            name=result.answer or UNKNOWN_NAME,
            confidence=result.confidence,
            confident=track.confident,
            place=frame.centre if result.place is None else result.place,
            size=np.ptp(seen @ frame.axes.T, axis=0),
            pixels=track.pixels,
            seen_points=seen,
            touches=tuple(others),
            result=result,
        )

    @property
    def pose(self) -> Float | None:
        """From the frame of its scan file into the world, (4, 4), metres; None for an unknown one.

        See ``Recognition.pose``.
        """
        return self.result.pose

    @property
    def pose_uncertainty(self) -> PoseUncertainty | None:
        """How far off ``pose`` may be; None where there is none."""
        return self.result.pose_uncertainty

    @property
    def candidates(self) -> tuple[PoseCandidate, ...]:
        """The things and poses that it may be, the likeliest first."""
        return self.result.pose_candidates

    @property
    def symmetry(self) -> Any:
        """Turns after which it looks the same; None where they are not known."""
        return self.result.symmetry

    @property
    def warnings(self) -> tuple[ViewWarning, ...]:
        """What is likely to be wrong with it; usually nothing."""
        return tuple(warning for view in self.result.views for warning in view.warnings)

    def __repr__(self) -> str:
        """One line: ``3: mug, belief 0.998, confident, at [0.412, -0.103, 0.050] m``."""
        where = f"at {place_in_words(self.place)}"
        if self.name == UNKNOWN_NAME:
            sides = " x ".join(f"{100 * side:.0f}" for side in self.size)
            return f"{self.number}: unknown, {sides} cm, {where}"
        sure = "confident" if self.confident else "not confident"
        return (
            f"{self.number}: {self.name}, belief {self.confidence:.3f}, {sure}, {where}"
        )
