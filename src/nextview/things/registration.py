"""Registration of surfaces with all views of a thing at once, for many hypotheses.

Each hypothesis is a surface in a pose. A Gauss-Newton step casts the rays of all views at it and
minimises two kinds of residuals: along the normal of the surface, where the ray meets it and a
depth was measured (point to plane, Chen and Medioni, "Object modelling by registration of multiple
range images", 1992, with correspondences along the ray as in Blais and Levine 1995), and in the
image plane, where the hypothesis exceeds the outline of the thing. Robust weights (Cauchy) have a
scale that decreases from coarse to fine. A prior limits the position error of each camera. Views
from one place of a camera with a name, which stands still, share its error.
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
"""Unknowns of a step: rotation and translation of a hypothesis; the camera errors follow."""

FREE_WEIGHT = 1e-3  # weight of the prior of an unknown without prior knowledge
SHIFT_LIMIT = 0.25  # largest translation of a step, radii
TURN_LIMIT = 0.3  # largest rotation of a step, radians
TURN_TOLERANCE = np.radians(3.0)
PLACE_TOLERANCE = 0.03  # radii
"""Hypotheses of one thing within both tolerances are duplicates."""


# lower bound of a camera's position error, metres: a more accurate camera counts as exact
LEAST_CAMERA_ERROR = 1e-4


@dataclass(frozen=True)
class RegistrationPrior:
    """Standard deviations of the unknowns before the registration.

    Attributes:
        tilt: of the vertical, radians.
        place: of the centre, object radii.
        camera: of the position of each camera, metres.
        aim: of the viewing direction of each camera, radians. It displaces the thing by this angle
            times the distance, and is estimated as an error of the camera position.
        pixels: effective number of independent pixels of a view.
    """

    tilt: float = 0.04
    place: float = 0.5
    camera: float = 0.003
    aim: float = 0.006
    pixels: float = 60.0

    def for_cameras(self, place: float, aim: float) -> "RegistrationPrior":
        """The same prior for cameras with another pose accuracy.

        Args:
            place: standard deviation of the position of each camera along each axis, metres.
            aim: standard deviation of its viewing direction, radians.

        Returns:
            The prior.
        """
        return replace(self, camera=max(place, LEAST_CAMERA_ERROR), aim=aim)

    def displaced(self, views: Sequence[DepthView]) -> Float:
        """Standard deviation of the displacement of the thing in each view along each axis.

        Args:
            views: V views of the thing.

        Returns:
            Standard deviations, (V,) float64, metres.
        """
        distances = np.array([np.linalg.norm(view.origin) for view in views])
        return np.hypot(self.camera, self.aim * distances)


@dataclass(frozen=True)
class Level:
    """Some steps of a registration, and the expected residuals of the hypotheses.

    A pixel with a residual of this size has half weight.

    Attributes:
        steps: number of steps.
        off: expected error of a surface, relative to its radius.
        displaced: remaining displacement of a view, relative to its prior.
    """

    steps: int
    off: float
    displaced: float

    def reach(self, radii: Float32, displaced: float) -> Float32:
        """Expected residual of each hypothesis without noise.

        Args:
            radii: radii of the surfaces of the hypotheses, (H,), metres.
            displaced: standard deviation of their displacement in the view, metres.

        Returns:
            Residuals, (H,) float32, metres.
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
        centres: positions of the centres of the surfaces, (H, 3) float64.
        cameras: displacement of each hypothesis in each view by the error of the camera position,
            (H, V, 3) float64.
    """

    things: Index
    rotations: Float
    centres: Float
    cameras: Float

    def turned(self, rotation: Float) -> "Alignment":
        """The same poses in an object frame that is rotated about its origin.

        Args:
            rotation: from the old axes to the new axes, (3, 3).

        Returns:
            The rotated poses.
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
        """Select hypotheses.

        Args:
            rows: indices or mask.

        Returns:
            The selected hypotheses.
        """
        return Alignment(
            things=self.things[rows],
            rotations=self.rotations[rows],
            centres=self.centres[rows],
            cameras=self.cameras[rows],
        )

    def poses(self, caster: SurfaceCaster) -> Float:
        """Poses of the scan files' frames in the object frame.

        Args:
            caster: all surfaces.

        Returns:
            Poses, (H, 4, 4) float64, metres.
        """
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
        second: K hypotheses.

    Returns:
        H + K hypotheses.
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
    """Initial alignment of hypotheses.

    Args:
        things: number of the surface of each, (H,) int.
        rotations: from the axes of the scan file to those of the object frame, (H, 3, 3).
        centres: centres of the surfaces in the object frame, (H, 3), metres.
        views: number of views.

    Returns:
        The hypotheses, with exact cameras.
    """
    return Alignment(
        things=np.asarray(things, np.int64),
        rotations=np.asarray(rotations, np.float64),
        centres=np.asarray(centres, np.float64),
        cameras=np.zeros((len(things), views, 3)),
    )


SCAN_ERROR = 0.0007  # standard deviation of a scan from the thing, metres
# the same relative to the radius: scans of large things are less accurate
RELATIVE_SCAN_ERROR = 0.005
SUNK = 0.005  # tolerated depth below the ground beside the errors of the scan, metres
# standard deviations of the noise at which a pixel has half weight, at any level
NOISE_REACH = 2.0


def scan_errors(radii: Float32 | float) -> Floats:
    """Standard deviation of scans from the things.

    Args:
        radii: radii of the surfaces, metres.

    Returns:
        Standard deviations, metres.
    """
    return np.hypot(SCAN_ERROR, RELATIVE_SCAN_ERROR * radii)


@dataclass(frozen=True, eq=False)
class Rendered:
    """Rendering of H hypotheses in one view, object frame, metres.

    Attributes:
        depth: depth of each hypothesis, (H, P) float32, infinity where it is absent.
        normals: surface normals towards the camera, (H, P, 3) float32.
        radii: radii of the surfaces, (H,) float32.
    """

    depth: Float32
    normals: Float32
    radii: Float32

    def sunk(self, view: DepthView) -> Mask:
        """Pixels where a hypothesis lies below the ground, which is impossible.

        Args:
            view: the rendered view.

        Returns:
            Mask, (H, P) bool.
        """
        floor = view.floor
        if floor is None:
            return np.zeros(self.depth.shape, bool)
        shows = np.isfinite(self.depth)
        away = view.rays @ floor.normal.astype(np.float32)
        height = np.float32(floor.normal @ view.origin + floor.offset)
        heights = height + away * np.where(shows, self.depth, 0)
        deep = np.hypot(SUNK, floor.noise * self.depth.clip(0, 100) ** 2)
        return shows & (heights < -deep - self.errors[:, None])

    @property
    def errors(self) -> Float32:
        """Standard deviation of each surface from the thing, (H,) float32, metres."""
        return scan_errors(self.radii).astype(np.float32)

    def hidden(self, view: DepthView) -> Mask:
        """Pixels where something else occludes a hypothesis.

        Args:
            view: the rendered view.

        Returns:
            Mask, (H, P) bool.
        """
        before = self.depth - self._apart(view)
        return (view.kind == ELSEWHERE) & (view.depth < before)

    def seen_behind(self, view: DepthView) -> Mask:
        """Pixels with a measurement behind a hypothesis, which should occlude it.

        Args:
            view: the rendered view.

        Returns:
            Mask, (H, P) bool.
        """
        shows = np.isfinite(self.depth)
        behind = np.where(shows, self.depth, 0) + self._apart(view)
        return shows & (view.kind == ELSEWHERE) & (view.depth > behind)

    def _apart(self, view: DepthView) -> Float32:
        """Smallest significant depth difference to the hypotheses, (H, P), metres."""
        return np.hypot(HIDING, HIDING_NOISE * view.noise) + self.errors[:, None]


def render(
    caster: SurfaceCaster,
    alignment: Alignment,
    view: DepthView,
    number: int,
) -> Rendered:
    """Cast the rays of a view at all hypotheses.

    Args:
        caster: all surfaces.
        alignment: the hypotheses.
        view: the view.
        number: index of the view, which selects its camera error.

    Returns:
        Rendering of each hypothesis on its own, without the others.
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
    """N residuals of one view, each of which pulls a hypothesis in a direction.

    Attributes:
        hypotheses: index of the hypothesis, ascending, (N,) int64.
        arms: from the centre of the hypothesis to the point on its surface, (N, 3).
        directions: unit vectors, (N, 3).
        distances: residuals, metres, (N,).
        weights: inverse variances, (N,).
        inside: distance of a depth pixel to the outline of the thing from inside, pixels of the
            image, (N,); infinity for a residual of the outline.
        count: number of hypotheses.
    """

    hypotheses: Index
    arms: Float32
    directions: Float32
    distances: Float32
    weights: Float32
    inside: Float32
    count: int


OUTLINE_PIXELS = 1.5  # standard deviation of an outline, pixels


def pulls_of(
    view: DepthView,
    rendered: Rendered,
    centres: Float,
    reach: Float32,
) -> Pulls:
    """Compute the residuals of hypotheses in one view.

    Args:
        view: the view.
        rendered: rendering of the H hypotheses in it.
        centres: centres of the hypotheses, (H, 3), object frame, metres.
        reach: expected residual of each hypothesis beside the noise, (H,), metres.

    Returns:
        The residuals.
    """
    shows = np.isfinite(rendered.depth)
    # Depth was measured on the thing: residual along the normal.
    measured = shows & (view.kind == THING)
    # The hypothesis exceeds the outline of the thing: residual towards the outline.
    elsewhere = shows & (view.kind == ELSEWHERE) & ~rendered.hidden(view)
    beyond = elsewhere & ~(view.level & ~rendered.seen_behind(view))
    # The hypothesis does not cover a thing pixel: its nearest pixel is pulled there.
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


FAR_ROW = 1_000_000  # placeholder for a column without a pixel


def _nearest_shown(
    view: DepthView,
    shows: Mask,
    hypotheses: Index,
    pixels: Index,
) -> tuple[Index, Float32, Float32]:
    """Nearest pixel of a hypothesis to each of N pixels, (N,).

    The hypothesis covers at least one pixel. The distance from there to the pixel, (N,), pixels of
    the image, and its direction, (N, 3), object frame, are returned as well.
    """
    rows, columns = np.divmod(pixels, view.shape[1])
    some, image = np.unique(hypotheses, return_inverse=True)
    images = shows[some].reshape(-1, *view.shape)
    # The nearest row of each column, then the nearest column.
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
    """Register hypotheses with all views at once.

    Args:
        caster: all surfaces.
        alignment: initial hypotheses.
        views: the views, in the order of ``alignment.cameras``.
        levels: steps from coarse to fine.
        prior: prior of the unknowns.

    Returns:
        The same hypotheses in refined poses.
    """
    for level in levels:
        for _ in range(level.steps):
            alignment = _step(caster, alignment, views, level, prior)
    return alignment


SAME_PLACE = 1e-6  # tolerance of equal camera poses, metres: a rounding error


@dataclass(frozen=True, eq=False)
class CameraStands:
    """Places from which V views were taken.

    Views that a camera with a name took from one place share its error. A camera without a name may
    be on an arm, which comes back to a place with another error.

    Attributes:
        numbers: number of the place of each view, (V,).
        first: first view from each place, (S,).
    """

    numbers: Index
    first: Index

    @classmethod
    def of(cls, views: Sequence[DepthView]) -> "CameraStands":
        """Return the places of some views."""
        poses = np.array(
            [np.append(view.camera_axes.ravel(), view.origin) for view in views]
        )
        apart = np.abs(poses[:, None] - poses).max(-1)
        names = np.array([view.camera for view in views])
        named = (names[:, None] == names) & (names != "")
        same = np.eye(len(views), dtype=bool) | (named & (apart < SAME_PLACE))
        earliest = same.argmax(1)
        first, numbers = np.unique(earliest, return_inverse=True)
        return cls(numbers, first)

    @property
    def several(self) -> bool:
        """True if there are several: the error of a single camera equals a translation."""
        return len(self.first) > 1

    @property
    def counts(self) -> Index:
        """Number of views from each place, (S,)."""
        return np.bincount(self.numbers)

    def unknowns(self, number: int, before: int) -> slice:
        """Return the unknowns of the camera error of a view.

        Args:
            number: of the view.
            before: number of other unknowns, which come first.
        """
        start = before + 3 * int(self.numbers[number])
        return slice(start, start + 3)


def _step(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    level: Level,
    prior: RegistrationPrior,
) -> Alignment:
    """One Gauss-Newton step: rotation, translation and, with several views, the camera errors."""
    left, right = _equations(caster, alignment, views, level, prior)
    # Damped: an outline that fits gives no constraint, and a few pixels beside it would move the
    # hypothesis by more than its possible error.
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
        of_stands = moved[:, 3:].reshape(len(cameras), -1, 3)
        cameras = cameras + of_stands[:, CameraStands.of(views).numbers]
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
    stands = CameraStands.of(views)
    unknowns = POSE + 3 * len(stands.first) if stands.several else POSE
    left = np.zeros((len(alignment), unknowns, unknowns))
    right = np.zeros((len(alignment), unknowns))
    displaced = prior.displaced(views)

    for number, view in enumerate(views):
        rendered = render(caster, alignment, view, number)
        centres = alignment.centres + alignment.cameras[:, number]
        reach = level.reach(rendered.radii, displaced[number])
        square, towards = normal_equations(
            pulls_of(view, rendered, centres, reach),
            prior,
        )
        left[:, :POSE, :POSE] += square
        right[:, :POSE] += towards
        if stands.several:
            # Within one view, a displacement by the camera error equals a translation of the thing.
            own = stands.unknowns(number, POSE)
            left[:, own, own] += square[:, PLACE, PLACE]
            left[:, :POSE, own] += square[:, :, PLACE]
            left[:, own, :POSE] += square[:, PLACE, :]
            right[:, own] += towards[:, PLACE]

    weights, so_far = priors_of(
        caster,
        alignment,
        stands if stands.several else None,
        displaced,
        prior,
    )
    left += weights[:, :, None] * np.eye(unknowns)
    right -= weights * so_far
    return left, right


def different_poses(caster: SurfaceCaster, alignment: Alignment) -> Index:
    """Remove hypotheses that have converged to the pose of an earlier one.

    Args:
        caster: all surfaces.
        alignment: hypotheses, the best ones first.

    Returns:
        Indices of the remaining hypotheses, ascending.
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
    """Covariances of the poses of registered hypotheses, given the cameras.

    They are the inverses of the matrices of a fine step without the camera errors. An outline that
    fits has no residual, but would have one after a displacement, so its information is added.

    Args:
        caster: all surfaces.
        alignment: the registered hypotheses.
        views: the views, in the order of ``alignment.cameras``.
        prior: prior of the unknowns.

    Returns:
        Covariances of rotation, radians, about the centre of each surface, and position of that
        centre, metres, both in the object frame, (H, 6, 6) float64.
    """
    level = FINE[-1]
    displaced = prior.displaced(views)
    weights, _ = priors_of(caster, alignment, None, displaced, prior)
    information = weights[:, :, None] * np.eye(POSE)

    for number, view in enumerate(views):
        rendered = render(caster, alignment, view, number)
        centres = alignment.centres + alignment.cameras[:, number]
        reach = level.reach(rendered.radii, displaced[number])
        drawn = pulls_of(view, rendered, centres, reach)
        held = pulls_of_outline(view, rendered, centres)
        information += normal_equations(drawn, prior)[0]
        information += normal_equations(held, prior)[0]

    return inverses(information)


def inverses(information: Float) -> Float:
    """Inverses of symmetric matrices without negative variances.

    In single precision, a hardly determined direction may get a zero or negative eigenvalue. It is
    raised to the resolution of single precision.

    Args:
        information: matrices, (H, N, N).

    Returns:
        Inverses, (H, N, N) float64.
    """
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), FREE_WEIGHT))
    # rotations and translations have different units
    scaled = information / (scale[:, :, None] * scale[:, None])
    values, vectors = np.linalg.eigh((scaled + scaled.swapaxes(1, 2)) / 2)
    values = np.maximum(values, np.finfo(np.float32).eps)
    inverse = (vectors / values[:, None]) @ vectors.swapaxes(1, 2)
    return np.asarray(inverse / (scale[:, :, None] * scale[:, None]), np.float64)


def pulls_of_outline(view: DepthView, rendered: Rendered, centres: Float) -> Pulls:
    """Compute the constraints of the outline of the thing on well registered hypotheses.

    They come from thing pixels next to pixels with a larger depth or free background: the thing
    ends there and is not occluded.

    Args:
        view: the view.
        rendered: rendering of the H hypotheses in it.
        centres: centres of the hypotheses, (H, 3), object frame, metres.

    Returns:
        Constraints with zero residuals.
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


def normal_equations(
    pulls: Pulls,
    prior: RegistrationPrior,
) -> tuple[Float, Float]:
    """Compute the normal equations of one view.

    Args:
        pulls: residuals of H hypotheses.
        prior: gives the effective number of independent pixels.

    Returns:
        Matrices, (H, 6, 6), and right-hand sides, (H, 6), of rotation and translation.
    """
    turning = np.cross(pulls.arms, pulls.directions)
    jacobian = np.concatenate(
        [turning, pulls.directions, pulls.distances[:, None]],
        axis=1,
    )
    # The errors of neighbouring pixels are correlated.
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
    stands: CameraStands | None,
    displaced: Float,
    prior: RegistrationPrior,
) -> tuple[Float, Float]:
    """Weights of the priors of the unknowns, and present values of the unknowns.

    Args:
        caster: all surfaces.
        alignment: H hypotheses.
        stands: places of the cameras; None if the camera errors are no unknowns.
        displaced: standard deviation of the displacement in each view, (V,), metres.
        prior: prior of the unknowns.

    Returns:
        Weights and values, (H, unknowns) float64 each.
    """
    cameras = 0 if stands is None else 3 * len(stands.first)
    weights = np.zeros((len(alignment), POSE + cameras))
    so_far = np.zeros((len(alignment), POSE + cameras))

    weights[:, TURN] = FREE_WEIGHT

    reach = prior.place * caster.radii[alignment.things].astype(np.float64)
    weights[:, PLACE] = 1 / reach[:, None] ** 2
    so_far[:, PLACE] = alignment.centres
    if stands is not None:
        weights[:, POSE:] = np.repeat(1 / displaced[stands.first] ** 2, 3)
        shared = alignment.cameras[:, stands.first]
        so_far[:, POSE:] = shared.reshape(len(alignment), -1)
    return weights, so_far


def rotations_of(vectors: Float) -> Float:
    """Rotation matrices of rotation vectors.

    Args:
        vectors: rotation vectors, (H, 3), radians.

    Returns:
        Rotation matrices, (H, 3, 3).
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()


def camera_cost(
    alignment: Alignment,
    views: Sequence[DepthView],
    prior: RegistrationPrior = RegistrationPrior(),
) -> Float:
    """Half the squared normalised camera errors; views from one place share the cost.

    Args:
        alignment: the hypotheses.
        views: the views, in the order of ``alignment.cameras``.
        prior: prior of the camera errors.

    Returns:
        Costs, (H, V) float64.
    """
    squared = (alignment.cameras**2).sum(-1)
    stands = CameraStands.of(views)
    shares = 1 / stands.counts[stands.numbers]
    return np.asarray(0.5 * squared / prior.displaced(views) ** 2 * shares, np.float64)
