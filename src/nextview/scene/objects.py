"""The objects of a scene, as part of the public interface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.axes import upright_axes
from nextview.recognition.poses import (
    PoseCandidate,
    PoseUncertainty,
    place_in_words,
    uncertainty_of,
)
from nextview.sensing.tabletop import TableTop
from nextview.sensing.view_warning import ViewWarning
from nextview.things.naming import (
    CONFIDENT,
    LIKELY,
    named,
    pose_candidates,
    why_in_doubt,
)
from nextview.things.world import Thing, World
from nextview.types import Float, Mask

UNKNOWN_NAME = "unknown"
SETTLED_OBJECT_VIEWS = 2  # views after which an unknown object is settled
TOUCHING = 0.015  # metres of depth between two objects that touch
SEEN_POINTS = 400  # of an object, that a frame adds at most


@dataclass(frozen=True, eq=False)
class SceneObject:
    """An object found in a scene.

    Attributes:
        number: identifies the object in all frames.
        name: of the known thing; "unknown" if that is likelier than each name.
        confidence: belief in the name, 0 to 1; 0 for an unknown object.
        confident: whether the belief is high enough to act on.
        settled: whether another view would hardly change its name: it is confident, or was unknown
            in two frames at least.
        place: centre of the object, (3,), metres, in the world frame; for a single frame without a
            pose, in the camera frame.
        size: extents of the visible part, (3,), metres: two sides and the height.
        pixels: mask in each frame that shows the object, (H, W) bool, by frame number.
        seen_points: measured points of the object, (N, 3), metres, at most SEEN_POINTS a frame.
        touches: numbers of the objects that it touches in the image and in depth.
        beliefs: belief in each name that was compared, the likeliest first; the rest of 1 is the
            belief that the object was not taught.
        candidates: things and poses that the object may be, the likeliest first.
        doubt: why the name is not confident, in words; "" if it is, or if there is none.
        ruled_out: names that it cannot have, with the reasons, see ``scene.rule.SceneRule``.
        warnings: likely problems of the frames that show the object; usually empty.
        camera_error: standard deviation of the places of the cameras along each axis, millimetres.
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
    beliefs: dict[str, float] = field(repr=False)
    candidates: tuple[PoseCandidate, ...] = field(repr=False)
    doubt: str = ""
    ruled_out: tuple[tuple[str, str], ...] = ()
    warnings: tuple[ViewWarning, ...] = ()
    camera_error: float = field(default=0.0, repr=False)

    @property
    def pose(self) -> Float | None:
        """Pose of the scan in the world, (4, 4), metres; None for an unknown object."""
        return self._posed.pose if self._posed else None

    @property
    def pose_uncertainty(self) -> PoseUncertainty | None:
        """Uncertainty of ``pose``; None without a pose."""
        same = [one for one in self.candidates if one.thing == self.name]
        return uncertainty_of(same, self.camera_error) if same else None

    @property
    def symmetry(self) -> Any:
        """Rotations after which the thing looks the same; None if they are not known."""
        return self._posed.symmetry if self._posed else None

    @property
    def _posed(self) -> PoseCandidate | None:
        """The likeliest pose of its name; None for an unknown object."""
        return None if self.name == UNKNOWN_NAME else self.candidates[0]

    @property
    def most_like(self) -> str | None:
        """The likeliest name, also of an unknown object; None if no thing resembles it."""
        return next(iter(self.beliefs), None)

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


def objects_of(
    world: World,
    tops: Sequence[TableTop],
    ruled_out: Mapping[int, Mapping[str, str]],
) -> tuple[SceneObject, ...]:
    """Return the objects of a scene, in the order in which they were found.

    Args:
        world: what explains the frames.
        tops: support surfaces of each frame.
        ruled_out: names that objects cannot have, with the reasons, by their numbers.
    """
    pairs = touching_pairs(world)
    return tuple(
        _object(world, thing, tops, pairs, ruled_out.get(thing.number, {}))
        for thing in sorted(world.things, key=lambda one: one.number)
    )


def _object(
    world: World,
    thing: Thing,
    tops: Sequence[TableTop],
    pairs: set[tuple[int, int]],
    ruled_out: Mapping[str, str],
) -> SceneObject:
    """Return the public view of one thing."""
    points = seen_points(world, thing.number)
    axes = upright_axes(tops[0].up)
    flat = points @ axes.T
    middle = axes.T @ ((flat.min(0) + flat.max(0)) / 2)
    beside = [pair for pair in pairs if thing.number in pair]
    others = sorted({number for both in beside for number in both} - {thing.number})

    pixels = masks_of(world, thing.number)
    warnings = [one for k in pixels for one in tops[k].warnings]
    one = SceneObject(
        thing.number,
        UNKNOWN_NAME,
        0.0,
        False,
        len(pixels) >= SETTLED_OBJECT_VIEWS,
        middle,
        np.ptp(flat, axis=0),
        pixels,
        points,
        tuple(others),
        {},
        (),
        ruled_out=tuple(ruled_out.items()),
        warnings=tuple(dict.fromkeys(warnings)),
        camera_error=1000 * world.library.camera[1],
    )

    # from what explains it to a name
    if thing.row < 0:
        return one
    found = named(world, thing, ruled_out)
    if found is None:
        return one
    candidates = pose_candidates(world, found)
    if found.right < LIKELY:
        return replace(one, beliefs=found.beliefs(world), candidates=candidates)

    doubt = "" if found.right >= CONFIDENT else why_in_doubt(world, found)
    for warning in tops[max(pixels)].warnings if pixels else ():
        doubt = warning.message if warning.holds else doubt
    return replace(
        one,
        name=candidates[0].thing,
        confidence=found.right,
        confident=not doubt,
        settled=not doubt,
        place=candidates[0].place,
        beliefs=found.beliefs(world),
        candidates=candidates,
        doubt=doubt,
    )


def masks_of(world: World, number: int) -> dict[int, Mask]:
    """Return the pixels of a thing in each view that shows it, (H, W) bool, by view."""
    found = {}
    for k, (view, owner) in enumerate(zip(world.views, world.owners, strict=True)):
        cells = (owner == number).reshape(view.grid().depth.shape)
        if cells.any():
            # what another instance shows beside the middle of a cell is not of the thing
            label = view.enlarged(view.labels[:: view.stride, :: view.stride])
            mask = view.enlarged(cells) & (label == view.labels)
            found[k] = mask & (view.depth > 0)
    return found


def seen_points(world: World, number: int) -> Float:
    """Return measured points of a thing in all views, (N, 3), metres."""
    found = [np.zeros((0, 3))]
    for view, owner in zip(world.views, world.owners, strict=True):
        cells = np.flatnonzero(owner == number)
        found.append(view.points(cells[:: max(1, len(cells) // SEEN_POINTS)]))
    return np.concatenate(found)


def touching_pairs(world: World) -> set[tuple[int, int]]:
    """Return the pairs of things that touch in some view, the smaller number first."""
    found = set()
    for view, owner in zip(world.views, world.owners, strict=True):
        depth = view.grid().depth

        number: NDArray[np.int32] = owner.reshape(depth.shape)
        for gap in (1, 2, 3):
            for one, two in (
                (np.s_[:, :-gap], np.s_[:, gap:]),
                (np.s_[:-gap], np.s_[gap:]),
            ):
                beside = (number[one] != number[two]) & (number[one] > 0)
                beside &= (number[two] > 0) & (
                    np.abs(depth[one] - depth[two]) < TOUCHING
                )

                low = np.minimum(number[one][beside], number[two][beside])
                high = np.maximum(number[one][beside], number[two][beside])
                found |= set(zip(low.tolist(), high.tolist(), strict=True))
    return found
