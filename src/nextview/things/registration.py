"""Align surfaces with all views of a thing at once, many hypotheses at a time.

Every hypothesis is a surface in some pose. A Gauss-Newton step casts the rays of all views at it,
and draws it towards what was measured: along the surface's normals where the ray meets it and a
depth was measured (point to plane, Chen and Medioni, "Object modelling by registration of multiple
range images", 1992, projected along the ray as in Blais and Levine 1995), and within the image
where it sticks out of the thing's outline. Weights are robust (Cauchy), and come down from coarse
to fine. A prior holds the error of each camera's place near zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from nextview.things.depth_view import (
    ELSEWHERE,
    HIDING,
    HIDING_NOISE,
    NOT_MEASURED,
    THING,
    DepthView,
)
from nextview.things.surface import SurfaceCaster
from nextview.types import Float, Float32, Floats, Index, Mask

TURN = slice(0, 3)
PLACE = slice(3, 6)
POSE = 6
"""Unknowns of a step: turn and place of a hypothesis; the errors of the cameras follow."""

FREE_WEIGHT = 1e-3  # weight of one that nothing is known of
SHIFT_LIMIT = 0.25  # radii that a step moves a hypothesis at most
TURN_LIMIT = 0.3  # radians that a step turns it at most
TURN_TOLERANCE = np.radians(3.0)
PLACE_TOLERANCE = 0.03  # radii
"""Hypotheses of one thing that are not farther apart are one."""


# metres: a camera that stands as exactly as that is held in its place
LEAST_CAMERA_ERROR = 1e-4


@dataclass(frozen=True)
class RegistrationPrior:
    """How far off things may be before anything was aligned: standard deviations.

    Attributes:
        tilt: of the vertical, radians.
        place: of the centre, object radii.
        camera: of the place of each camera, metres.
        aim: of the direction in which each camera looks, radians. It displaces what is seen by so
            many times the distance, and is aligned as an error of the camera's place.
        pixels: how many pixels of a view are as good as so many that err independently.
    """

    tilt: float = 0.04
    place: float = 0.5
    camera: float = 0.003
    aim: float = 0.006
    pixels: float = 60.0

    def for_cameras(self, place: float, aim: float) -> "RegistrationPrior":
        """The same for cameras of another accuracy.

        Args:
            place: standard deviation of the place of each camera along each axis, metres.
            aim: of the direction in which it looks, radians.
        """
        return replace(self, camera=max(place, LEAST_CAMERA_ERROR), aim=aim)

    def displaced(self, views: Sequence[DepthView]) -> Float:
        """How far off each view may see the thing along each axis, (V,) float64, metres."""
        distances = np.array([np.linalg.norm(view.origin) for view in views])
        return np.hypot(self.camera, self.aim * distances)


@dataclass(frozen=True)
class Level:
    """Some steps of a registration, and how far off the hypotheses still are.

    A pixel that deviates by as much counts half.

    Attributes:
        steps: how many.
        off: by which part of its radius a surface is off.
        displaced: by which part of what it may be a view is still displaced.
    """

    steps: int
    off: float
    displaced: float

    def reach(self, radii: Float32, displaced: float) -> Float32:
        """Deviation to be expected of each hypothesis, (H,) float32, metres, without noise.

        Args:
            radii: of the surfaces of the hypotheses, (H,), metres.
            displaced: how far off the view may see them, metres.
        """
        return np.hypot(self.off * radii, np.float32(self.displaced * displaced))


FIRST = (Level(2, 0.25, 2.0),)
COARSE_LEVELS = (Level(2, 0.1, 1.0), Level(1, 0.05, 0.5))
FINE = (Level(2, 0.035, 0.25), Level(1, 0.02, 0.1))


@dataclass(frozen=True, eq=False)
class Alignment:
    """Poses of H hypotheses in the object frame, metres.

    Attributes:
        things: number of the surface of each hypothesis, (H,) int64.
        rotations: from the axes of the scan file to those of the object frame, (H, 3, 3) float64.
        centres: where the centre of the surface lies, (H, 3) float64.
        cameras: by how much each view sees the thing displaced, because of an error of the camera's
            place, (H, V, 3) float64.
    """

    things: Index
    rotations: Float
    centres: Float
    cameras: Float

    def turned(self, rotation: Float) -> "Alignment":
        """The same in an object frame that is turned about its origin.

        Args:
            rotation: from the axes so far to the new ones, (3, 3).
        """
        return replace(
            self,
            rotations=rotation @ self.rotations,
            centres=self.centres @ rotation.T,
            cameras=self.cameras @ rotation.T,
        )

    def __len__(self) -> int:
        """Number of hypotheses."""
        return len(self.things)

    def select(self, rows: NDArray) -> "Alignment":
        """Some of the hypotheses, by index or mask."""
        return Alignment(
            things=self.things[rows],
            rotations=self.rotations[rows],
            centres=self.centres[rows],
            cameras=self.cameras[rows],
        )

    def poses(self, caster: SurfaceCaster) -> Float:
        """Poses of the scan files' frames in the object frame, (H, 4, 4) float64, metres."""
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3, :3] = self.rotations
        own_centres = caster.centres[self.things].astype(np.float64)
        poses[:, :3, 3] = self.centres - np.einsum(
            "hij,hj->hi",
            self.rotations,
            own_centres,
        )
        return poses


def joined(first: Alignment, second: Alignment) -> Alignment:
    """Concatenate the hypotheses of two alignments with the same views.

    Args:
        first: H hypotheses.
        second: K more.
    """
    parts = {
        field.name: np.concatenate(
            [getattr(first, field.name), getattr(second, field.name)]
        )
        for field in fields(Alignment)
    }
    return Alignment(**parts)


def start(
    things: NDArray[np.integer],
    rotations: Float,
    centres: Float,
    views: int,
) -> Alignment:
    """Hypotheses before anything is aligned.

    Args:
        things: number of the surface of each, (H,) int.
        rotations: from the axes of the scan file to those of the object frame, (H, 3, 3).
        centres: of the surfaces in the object frame, (H, 3), metres.
        views: how many views there are.

    Returns:
        The hypotheses, with no error of any camera.
    """
    return Alignment(
        things=np.asarray(things, np.int64),
        rotations=np.asarray(rotations, np.float64),
        centres=np.asarray(centres, np.float64),
        cameras=np.zeros((len(things), views, 3)),
    )


SCAN_ERROR = 0.0007  # deviation of a surface from the thing itself, metres
# and a part of its radius: large things are scanned less exactly
RELATIVE_SCAN_ERROR = 0.005
SUNK = 0.005  # metres that a hypothesis may be below the ground, beside the errors of the scan
# deviations of the noise at which a pixel counts half, however fine the level
NOISE_REACH = 2.0


def scan_errors(radii: Float32 | float) -> Floats:
    """Deviation of surfaces of these radii, metres, from the things themselves, metres."""
    return np.hypot(SCAN_ERROR, RELATIVE_SCAN_ERROR * radii)


@dataclass(frozen=True, eq=False)
class Rendered:
    """What one view would see of H hypotheses, object frame, metres.

    Attributes:
        depth: (H, P) float32, infinity where a hypothesis does not show.
        normals: towards the camera, (H, P, 3) float32.
        radii: of the surfaces, (H,) float32.
    """

    depth: Float32
    normals: Float32
    radii: Float32

    def sunk(self, view: DepthView) -> Mask:
        """Where a hypothesis shows below the ground, (H, P) bool: nothing can be there."""
        if view.ground is None:
            return np.zeros(self.depth.shape, bool)
        shows = np.isfinite(self.depth)
        away = view.rays @ view.ground.normal.astype(np.float32)
        height = np.float32(view.ground.normal @ view.origin + view.ground.offset)
        heights = height + away * np.where(shows, self.depth, 0)
        deep = np.hypot(SUNK, view.ground.noise * self.depth.clip(0, 100) ** 2)
        return shows & (heights < -deep - self.errors[:, None])

    @property
    def errors(self) -> Float32:
        """Deviation of each surface from the thing itself, (H,) float32, metres."""
        return scan_errors(self.radii).astype(np.float32)

    def hidden(self, view: DepthView) -> Mask:
        """Where something else stands before a hypothesis, (H, P) bool."""
        before = self.depth - self._apart(view)
        return (view.kind == ELSEWHERE) & (view.depth < before)

    def seen_behind(self, view: DepthView) -> Mask:
        """Where something is measured behind a hypothesis that should hide it, (H, P) bool."""
        shows = np.isfinite(self.depth)
        behind = np.where(shows, self.depth, 0) + self._apart(view)
        return shows & (view.kind == ELSEWHERE) & (view.depth > behind)

    def _apart(self, view: DepthView) -> Float32:
        """Metres from which on depth is before or behind the hypotheses, (H, P)."""
        return np.hypot(HIDING, HIDING_NOISE * view.noise) + self.errors[:, None]


def render(
    caster: SurfaceCaster,
    alignment: Alignment,
    view: DepthView,
    number: int,
) -> Rendered:
    """Cast the rays of a view at all hypotheses.

    Args:
        caster: of all surfaces.
        alignment: the hypotheses.
        view: the view, which is the one of this ``number``.
        number: decides which of the cameras' errors is its own.

    Returns:
        What shows of each hypothesis alone, as if the others were not there.
    """
    centres = alignment.centres + alignment.cameras[:, number]
    from_centre = np.einsum("hji,hj->hi", alignment.rotations, view.origin - centres)
    origins = from_centre + caster.centres[alignment.things]
    turns = alignment.rotations.astype(np.float32)

    depth, normals = caster.cast(
        alignment.things,
        origins.astype(np.float32),
        view.rays @ turns,
    )
    radii = caster.radii[alignment.things]
    return Rendered(depth, normals @ turns.swapaxes(1, 2), radii)


@dataclass(frozen=True, eq=False)
class Pulls:
    """By how much, and in which direction, pixels of one view draw hypotheses: N pulls.

    Attributes:
        hypotheses: row of the hypothesis that is drawn, ascending, (N,) int64.
        arms: from the centre of the hypothesis to what is drawn, (N, 3).
        directions: unit vectors, (N, 3).
        distances: metres, (N,).
        weights: inverse variances, (N,).
        inside: how far within the outline of the thing the depth lies that draws, pixels of the
            image, (N,); infinity where an outline draws.
        count: of all hypotheses.
    """

    hypotheses: Index
    arms: Float32
    directions: Float32
    distances: Float32
    weights: Float32
    inside: Float32
    count: int


OUTLINE_PIXELS = 1.5  # deviation of an outline, pixels


def pulls_of(
    view: DepthView,
    rendered: Rendered,
    centres: Float,
    reach: Float32,
) -> Pulls:
    """Compute the pulls of one view on hypotheses.

    Args:
        view: the view.
        rendered: what it would show of the H hypotheses.
        centres: of the hypotheses, (H, 3), object frame, metres.
        reach: expected deviation of each hypothesis beside the noise, (H,), metres.
    """
    shows = np.isfinite(rendered.depth)
    # Where the thing was measured: along the normal.
    measured = shows & (view.kind == THING)
    # Where the hypothesis shows, and the outline says that it does not: towards the outline.
    elsewhere = shows & (view.kind == ELSEWHERE) & ~rendered.hidden(view)
    beyond = elsewhere & ~(view.level & ~rendered.seen_behind(view))
    # Where the thing was measured and the hypothesis does not show: the nearest of its pixels is
    # drawn there.
    shows_somewhere = shows.any(1, keepdims=True)
    missing = ~shows & (view.kind == THING) & ~view.level & shows_somewhere

    hypotheses, pixels = np.nonzero(np.asarray(measured | beyond | missing))
    along_normal = measured[hypotheses, pixels]
    absent = missing[hypotheses, pixels]
    nearest, gap, aside = _nearest_shown(
        view,
        shows,
        hypotheses[absent],
        pixels[absent],
    )
    drawn = pixels.copy()
    drawn[absent] = nearest
    depth = rendered.depth[hypotheses, drawn]
    rays = view.rays[drawn]
    points = view.origin.astype(np.float32) + rays * depth[:, None]
    arms = points - centres.astype(np.float32)[hypotheses]

    normals = rendered.normals[hypotheses, pixels]
    outwards = view.towards @ view.camera_axes[:, :2].T.astype(np.float32)
    sideways = outwards[pixels]
    sideways[absent] = aside
    directions = np.where(along_normal[:, None], normals, sideways)

    across = view.edge[pixels]
    across[absent] = gap
    behind = view.depth[pixels] - depth
    along = np.einsum("ni,ni->n", normals, rays)
    distances = np.where(along_normal, behind * along, across * view.pitch * depth)

    farther = np.where(absent, view.depth[pixels], depth)
    noise = view.noise[pixels]
    deviation = np.where(along_normal, noise, OUTLINE_PIXELS * view.pitch * farther)
    variance = rendered.errors[hypotheses] ** 2 + deviation**2
    expected = reach[hypotheses] ** 2 + (NOISE_REACH * noise) ** 2
    weights = 1 / variance / (1 + distances**2 / expected)
    return Pulls(
        hypotheses,
        arms,
        directions,
        distances.astype(np.float32),
        weights.astype(np.float32),
        np.where(along_normal, -view.edge[pixels], np.inf).astype(np.float32),
        len(shows),
    )


FAR_ROW = 1_000_000  # in place of a row where a column has none


def _nearest_shown(
    view: DepthView,
    shows: Mask,
    hypotheses: Index,
    pixels: Index,
) -> tuple[Index, Float32, Float32]:
    """For N pixels the nearest one where a hypothesis, which shows somewhere, shows, (N,).

    And the distance from there to the pixel, (N,), pixels of the image, and its direction, (N, 3),
    object frame.
    """
    rows, columns = np.divmod(pixels, view.shape[1])
    some, image = np.unique(hypotheses, return_inverse=True)
    images = shows[some].reshape(-1, *view.shape)
    # In each column the nearest row, then among these the nearest of all columns.
    every = np.arange(view.shape[0])[:, None]
    above = np.maximum.accumulate(np.where(images, every, -FAR_ROW), axis=1)
    from_below = np.where(images, every, FAR_ROW)[:, ::-1]
    below = np.minimum.accumulate(from_below, axis=1)[:, ::-1]
    nearest = np.where(every - above <= below - every, above, below)
    in_column = nearest[image, rows]

    down = (rows[:, None] - in_column) * view.step[0]
    aside = (columns[:, None] - np.arange(view.shape[1])) * view.step[1]
    best = (down**2 + aside**2).argmin(1)
    number = np.arange(len(pixels))
    in_image = np.stack([aside[number, best], down[number, best]], -1)
    distance = np.linalg.norm(in_image, axis=1)
    direction = in_image / np.maximum(distance, 1e-9)[:, None]
    return (
        in_column[number, best] * view.shape[1] + best,
        distance.astype(np.float32),
        (direction @ view.camera_axes[:, :2].T).astype(np.float32),
    )


def align(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    levels: Sequence[Level],
    prior: RegistrationPrior = RegistrationPrior(),
) -> Alignment:
    """Align hypotheses with all views at once.

    Args:
        caster: of all surfaces.
        alignment: the hypotheses as they are so far.
        views: the views, in the order of ``alignment.cameras``.
        levels: steps from coarse to fine.
        prior: what is held near zero.

    Returns:
        The same hypotheses in better poses.
    """
    for level in levels:
        for _ in range(level.steps):
            alignment = _step(caster, alignment, views, level, prior)
    return alignment


def _step(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    level: Level,
    prior: RegistrationPrior,
) -> Alignment:
    """One Gauss-Newton step: turn, place and, with several views, the cameras' errors."""
    left, right = _equations(caster, alignment, views, level, prior)
    # Damped: an outline that fits holds nothing in place, and few pixels beside it would move it
    # farther than it can be off.
    farthest = level.reach(caster.radii[alignment.things], prior.displaced(views).max())
    for unknown in range(POSE):
        off = level.off if unknown < PLACE.start else farthest
        left[:, unknown, unknown] += 1 / off**2
    change = np.linalg.solve(left, right[..., None])[..., 0]

    turn = np.clip(change[:, TURN], -TURN_LIMIT, TURN_LIMIT)
    limit = SHIFT_LIMIT * caster.radii[alignment.things].astype(np.float64)[:, None]
    moved = np.clip(change[:, 3:], -limit, limit)
    cameras = alignment.cameras
    if moved.shape[1] > 3:
        cameras = cameras + moved[:, 3:].reshape(cameras.shape)
    return replace(
        alignment,
        rotations=rotations_of(turn) @ alignment.rotations,
        centres=alignment.centres + moved[:, :3],
        cameras=cameras,
    )


def _equations(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    level: Level,
    prior: RegistrationPrior,
) -> tuple[Float, Float]:
    """Matrices, (H, U, U), and right-hand sides, (H, U), of a step with U unknowns."""
    errors_too = len(views) > 1  # one camera's error is the same as one of the place
    unknowns = POSE + 3 * len(views) if errors_too else POSE
    left = np.zeros((len(alignment), unknowns, unknowns))
    right = np.zeros((len(alignment), unknowns))
    displaced = prior.displaced(views)

    for number, view in enumerate(views):
        rendered = render(caster, alignment, view, number)
        centres = alignment.centres + alignment.cameras[:, number]
        reach = level.reach(rendered.radii, displaced[number])
        square, towards = _normal_equations(
            pulls_of(view, rendered, centres, reach),
            prior,
        )
        left[:, :POSE, :POSE] += square
        right[:, :POSE] += towards
        if errors_too:
            # A view that sees the thing displaced is the same, to itself, as a thing in another
            # place.
            own = slice(POSE + 3 * number, POSE + 3 * number + 3)
            left[:, own, own] += square[:, PLACE, PLACE]
            left[:, :POSE, own] += square[:, :, PLACE]
            left[:, own, :POSE] += square[:, PLACE, :]
            right[:, own] += towards[:, PLACE]

    weights, so_far = priors_of(
        caster,
        alignment,
        displaced if errors_too else None,
        prior,
    )
    left += weights[:, :, None] * np.eye(unknowns)
    right -= weights * so_far
    return left, right


def different_poses(caster: SurfaceCaster, alignment: Alignment) -> Index:
    """Leave out hypotheses that have come to the pose of an earlier one.

    Args:
        caster: of all surfaces.
        alignment: hypotheses, the best ones first.

    Returns:
        Indices of those that are left, ascending.
    """
    rotations = alignment.rotations.reshape(len(alignment), 9)
    apart = np.linalg.norm(alignment.centres[:, None] - alignment.centres, axis=-1)
    near = apart < PLACE_TOLERANCE * caster.radii[alignment.things][:, None]
    alike = (rotations @ rotations.T - 1) / 2 > np.cos(TURN_TOLERANCE)
    same = near & alike & (alignment.things[:, None] == alignment.things)

    kept: list[int] = []
    for number in range(len(alignment)):
        if not same[number, kept].any():
            kept.append(number)
    return np.array(kept, np.int64)


def pose_covariances(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    prior: RegistrationPrior = RegistrationPrior(),
) -> Float:
    """How well the views determine the poses of aligned hypotheses, given the cameras.

    It is the inverse of the matrix of a fine step, without what is unknown of the cameras. Where a
    hypothesis lies right its outline draws it nowhere, but would if it were displaced: so the
    outline is added.

    Args:
        caster: of all surfaces.
        alignment: the hypotheses, aligned.
        views: the views, in the order of ``alignment.cameras``.
        prior: how far off things may be before anything was aligned.

    Returns:
        Covariances of turn, radians, about the centre of each surface, and place of that centre,
        metres, both in the object frame, (H, 6, 6) float64.
    """
    level = FINE[-1]
    displaced = prior.displaced(views)
    weights, _ = priors_of(caster, alignment, None, prior)
    information = weights[:, :, None] * np.eye(POSE)

    for number, view in enumerate(views):
        rendered = render(caster, alignment, view, number)
        centres = alignment.centres + alignment.cameras[:, number]
        reach = level.reach(rendered.radii, displaced[number])
        drawn = pulls_of(view, rendered, centres, reach)
        held = pulls_of_outline(view, rendered, centres)
        information += _normal_equations(drawn, prior)[0]
        information += _normal_equations(held, prior)[0]

    return inverses(information)


def inverses(information: Float) -> Float:
    """Inverses of symmetric matrices, (H, N, N), none of which has a negative variance.

    In single precision a direction that is hardly determined may get a zero or negative
    eigenvalue: it counts as determined as little as that precision tells.
    """
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), FREE_WEIGHT))
    # turns and places have other units
    scaled = information / (scale[:, :, None] * scale[:, None])
    values, vectors = np.linalg.eigh((scaled + scaled.swapaxes(1, 2)) / 2)
    values = np.maximum(values, np.finfo(np.float32).eps)
    inverse = (vectors / values[:, None]) @ vectors.swapaxes(1, 2)
    return np.asarray(inverse / (scale[:, :, None] * scale[:, None]), np.float64)


def pulls_of_outline(view: DepthView, rendered: Rendered, centres: Float) -> Pulls:
    """Compute the pulls that hold hypotheses in their right poses at the thing's outline.

    These are the pixels of the thing next to others where something farther, or nothing, shows:
    the thing ends there, and is not hidden.

    Args:
        view: the view.
        rendered: what it would show of the H hypotheses.
        centres: of the hypotheses, (H, 3), object frame, metres.
    """
    thing = (view.kind == THING).reshape(view.shape)
    depth = np.where(view.kind == NOT_MEASURED, 0, view.depth).reshape(view.shape)
    own = np.where(thing, view.depth.reshape(view.shape), 0)
    inwards = np.zeros((*view.shape, 2), np.float32)
    for axis in (0, 1):
        for step in (-1, 1):
            beside = np.roll(depth, -step, axis)
            ends = thing & ~np.roll(thing, -step, axis) & (beside > own + HIDING)
            inwards[..., 1 - axis] -= step * ends

    length = np.linalg.norm(inwards, axis=2).ravel()
    rim = (length > 0) & np.isfinite(rendered.depth)
    in_image = inwards.reshape(-1, 2) / np.maximum(length, 1)[:, None]
    aside = in_image @ view.camera_axes[:, :2].T.astype(np.float32)

    hypotheses, pixels = np.nonzero(rim)
    depth = rendered.depth[hypotheses, pixels]
    points = view.origin.astype(np.float32) + view.rays[pixels] * depth[:, None]
    arms = points - centres.astype(np.float32)[hypotheses]
    deviation = OUTLINE_PIXELS * view.pitch * depth
    weights = 1 / (rendered.errors[hypotheses] ** 2 + deviation**2)
    return Pulls(
        hypotheses,
        arms,
        aside[pixels],
        np.zeros_like(depth),
        weights.astype(np.float32),
        np.full(len(pixels), np.inf, np.float32),
        len(rim),
    )


def _normal_equations(
    pulls: Pulls,
    prior: RegistrationPrior,
) -> tuple[Float, Float]:
    """What one view says of turn and place: matrices, (H, 6, 6), and right-hand sides, (H, 6)."""
    turning = np.cross(pulls.arms, pulls.directions)
    jacobian = np.concatenate(
        [turning, pulls.directions, pulls.distances[:, None]],
        axis=1,
    )
    # Neighbouring pixels err together.
    first = np.searchsorted(pulls.hypotheses, np.arange(pulls.count + 1))
    share = np.minimum(1, prior.pixels / np.maximum(np.diff(first), 1))
    weights = pulls.weights * share.astype(np.float32)[pulls.hypotheses]
    weighted = jacobian[:, :POSE] * weights[:, None]

    found = np.zeros((pulls.count, POSE, POSE + 1), np.float32)
    for hypothesis in range(pulls.count):
        own = slice(first[hypothesis], first[hypothesis + 1])
        np.matmul(weighted[own].T, jacobian[own], out=found[hypothesis])
    sums = found.astype(np.float64)
    return sums[..., :POSE], sums[..., POSE]


def priors_of(
    caster: SurfaceCaster,
    alignment: Alignment,
    displaced: Float | None,
    prior: RegistrationPrior,
) -> tuple[Float, Float]:
    """Return weights that hold unknowns near zero, and their present values.

    Args:
        caster: of all surfaces.
        alignment: H hypotheses.
        displaced: standard deviation of the place in which each view sees them, (V,), metres; None
            if the errors of the cameras are no unknowns.
        prior: how far off things may be before anything was aligned.

    Returns:
        Weights and values, (H, unknowns) float64 each.
    """
    cameras = 0 if displaced is None else 3 * len(displaced)
    weights = np.zeros((len(alignment), POSE + cameras))
    so_far = np.zeros((len(alignment), POSE + cameras))

    weights[:, TURN] = FREE_WEIGHT

    reach = prior.place * caster.radii[alignment.things].astype(np.float64)
    weights[:, PLACE] = 1 / reach[:, None] ** 2
    so_far[:, PLACE] = alignment.centres
    if displaced is not None:
        weights[:, POSE:] = np.repeat(1 / displaced**2, 3)
        so_far[:, POSE:] = alignment.cameras.reshape(len(alignment), -1)
    return weights, so_far


def rotations_of(vectors: Float) -> Float:
    """Rotation matrices, (H, 3, 3), of rotation vectors, (H, 3), radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()


def camera_cost(
    alignment: Alignment,
    views: Sequence[DepthView],
    prior: RegistrationPrior = RegistrationPrior(),
) -> Float:
    """Half the squared deviations of the cameras' places, (H, V) float64: a cost.

    Args:
        alignment: the hypotheses.
        views: the views, in the order of ``alignment.cameras``.
        prior: how far off cameras may be.
    """
    squared = (alignment.cameras**2).sum(-1)
    return np.asarray(0.5 * squared / prior.displaced(views) ** 2, np.float64)
