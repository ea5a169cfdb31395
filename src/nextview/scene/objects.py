"""One object of a scene, as part of the public interface."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nextview.recognition.poses import PoseCandidate, PoseUncertainty, place_in_words
from nextview.sensing.view_warning import ViewWarning
from nextview.session.result import Recognition
from nextview.session.tracks import Track
from nextview.types import Float, Mask

UNKNOWN_NAME = "unknown"


@dataclass(frozen=True, eq=False)
class SceneObject:
    """An object found in a scene.

    Attributes:
        number: identifies the object in all frames.
        name: of the known thing; "unknown" if it matches none.
        confidence: belief in the name, 0 to 1; 0 for an unknown object.
        confident: whether the belief is high enough to act on.
        settled: whether another view would hardly change its name: it is confident, or was unknown
            in two frames at least.
        place: centre of the object, (3,), metres, in the world frame; for a single frame without a
            pose, in the camera frame.
        size: extents of the visible part, (3,), metres: two sides and the height.
        pixels: mask in each frame that shows the object, (H, W) bool, by frame number.
        seen_points: vertices of the convex hull of each view of the object, (N, 3), metres.
        touches: numbers of the objects that it touches in the image and in depth.
        result: full recognition result.
    """

    number: int
    name: str
    confidence: float
    confident: bool
    settled: bool
    place: Float
    size: Float
    pixels: dict[int, Mask] = field(repr=False)
    seen_points: Float = field(repr=False)
    touches: tuple[int, ...]
    result: Recognition = field(repr=False)

    @classmethod
    def of(cls, track: Track, touching: Collection[tuple[int, int]]) -> SceneObject:
        """Create the public view of a tracked object.

        Args:
            track: the object, already judged.
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
            settled=track.settled,
            place=frame.centre if result.place is None else result.place,
            size=np.ptp(seen @ frame.axes.T, axis=0),
            pixels=track.pixels,
            seen_points=seen,
            touches=tuple(others),
            result=result,
        )

    @property
    def pose(self) -> Float | None:
        """Pose of the scan in the world, scan-to-world, (4, 4), metres; None for an unknown object.

        See ``Recognition.pose``.
        """
        return self.result.pose

    @property
    def pose_uncertainty(self) -> PoseUncertainty | None:
        """Uncertainty of ``pose``; None without a pose."""
        return self.result.pose_uncertainty

    @property
    def candidates(self) -> tuple[PoseCandidate, ...]:
        """Candidate things and poses of the object, the likeliest first."""
        return self.result.pose_candidates

    @property
    def symmetry(self) -> Any:
        """Rotations after which the thing looks the same; None if they are not known."""
        return self.result.symmetry

    @property
    def warnings(self) -> tuple[ViewWarning, ...]:
        """Likely problems with this object; usually empty."""
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
