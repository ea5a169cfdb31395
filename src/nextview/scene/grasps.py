"""Grasps of taught things for a gripper with two fingers, and those that are free in a scene.

A grasp is annotated once, in the frame of the thing's scan: by hand, from CAD, or proposed from the
mesh (``propose_grasps``). In a scene it is free if the open gripper, on its straight way to the
grasp, meets nothing that was measured and no other known thing, and if its fingers need little
space that no frame has shown to be empty.

The frame of a gripper is that of a Panda's hand: the origin is midway between the fingertips, z
points forward, and the fingers close along y.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from scipy import ndimage
from scipy.spatial import cKDTree

from nextview.checks import number, one_line, plugin_errors, whole
from nextview.errors import DatasetError, NextviewError, UsageError
from nextview.files import read_record, write_record
from nextview.geometry.camera import checked_pose
from nextview.geometry.mesh import Mesh
from nextview.geometry.ray_caster import embree_scene
from nextview.scene.objects import SceneObject
from nextview.sensing.object_frame import Box
from nextview.sensing.tabletop import TableTop
from nextview.session.reach import truth_of
from nextview.things.surface import Surface
from nextview.types import Float, Floats, Index, Mask

# metres, error of a good pose and of a good hand-eye calibration
GRASP_CLEARANCE = 0.003
FRICTION = 0.4  # coefficient of steel on dry rubber or plastic, the lower end of tables
OBSTACLE_STEP = 0.003  # metres between the points that stand for obstacles of fingers
PALM_STEP = 0.01  # metres between those of the palm
# of depth along the image; what is steeper mixes an edge and its background
STEEPEST_SURFACE = 4.0
# of a cell that faces the camera, whose mean has less noise than a pixel
FEWEST_CELL_PIXELS = 3
# of a cell's side by pixels: a surface seen at 75 degrees; less is noise
LEAST_COVERED = 0.25
# metres from a thing's scan within which measured points are its own
OWN_SURFACE = 0.004
OWN_PIXELS = 0.01  # the same for points in its mask, which noise has displaced
# sample points of a finger across, along y, and along its length
FINGER_STEPS = (3, 3, 9)
# share of the fingers' space; less needs more views, more touches more
MOST_UNSEEN = 0.25
MILLIMETRE = 0.001
APPROACH = 0.10  # metres of the straight way to a grasp
COARSE_STEP = 16  # of so many points one is tested first

GRASPED_POINTS = 1000  # of a thing, tested against the gripper
CONTACT_POINTS = 300  # of a thing, on which a finger may press
# directions around the closing axis from which a pair of contacts is tried
APPROACHES = 16
TIP_DEPTHS = (0.002, 0.01)  # metres by which the fingertips reach beyond the contacts
# places on a finger, in its widths, that should touch the thing
PAD_GRID = (-0.4, 0.0, 0.4)
PAD_TOUCH = 0.001  # metres within which they do
# metres; of grasps from the same side that are closer the best is kept
ALIKE_PLACE = 0.008

# of the gripper, which exchanges the fingers
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Gripper:
    """A gripper with two parallel fingers, as boxes.

    Attributes:
        opening: largest distance between the fingers, metres.
        finger_width: of a finger along x, across the closing direction, metres.
        finger_thickness: of a finger along y, metres.
        finger_length: from the front of the hand to the fingertips, metres.
        palm: sides of the hand along x, y and z, with all that is mounted on it, metres; behind
            the fingers and centred between them.
    """

    opening: float = 0.08
    finger_width: float = 0.02
    finger_thickness: float = 0.01
    finger_length: float = 0.055
    palm: tuple[float, float, float] = (0.07, 0.21, 0.12)

    def __post_init__(self) -> None:
        sizes = (
            self.opening,
            self.finger_width,
            self.finger_thickness,
            self.finger_length,
            *self.palm,
        )
        for size in sizes:
            number(size, "a side of the gripper, in metres,", above=0, most=1)


@dataclass(frozen=True, eq=False)
class Grasp:
    """A grasp of a thing.

    Attributes:
        pose: of the gripper in the frame of the thing's scan, gripper-to-thing, (4, 4) float64,
            metres.
        width: distance between the fingers when they hold the thing, metres.
        quality: preference among the grasps of a thing, 0 to 1.
    """

    pose: Float
    width: float
    quality: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", checked_pose(self.pose))
        # fingers without a gap between them hold nothing
        number(self.width, "the width of a grasp, in metres,", above=0, most=1)
        number(self.quality, "the quality of a grasp", 0, 1)


@dataclass(frozen=True, eq=False)
class FreeGrasp:
    """A grasp of an object of a scene that nothing known is in the way of.

    Attributes:
        number: of the object.
        name: of the object.
        pose: of the gripper in the world, gripper-to-world, (4, 4) float64, metres.
        width: distance between the fingers when they hold the object, metres.
        opening: distance between the fingers on the way to the grasp, metres.
        unseen: share of the space of the fingers that no frame has shown to be empty, 0 to 1.
        score: ``quality`` of the grasp times the share of the space that was shown to be empty.
    """

    number: int
    name: str
    pose: Float
    width: float
    opening: float
    unseen: float
    score: float


# The file


class _GraspRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A grasp in a file; see ``Grasp``."""

    pose: Annotated[
        tuple[Annotated[tuple[float, ...], Meta(min_length=4, max_length=4)], ...],
        Meta(min_length=4, max_length=4),
    ]
    width: float
    quality: float = 1.0


class _GraspsFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Grasps of some things by their names."""

    grasps: dict[str, tuple[_GraspRecord, ...]]


def save_grasps(
    path: str | Path,
    grasps: Mapping[str, Sequence[Grasp]],
    overwrite: bool = False,
) -> None:
    """Write grasps to a JSON file, completely or not at all.

    Args:
        path: of the file, usually ``things.grasps`` in the folder of the memory.
        grasps: of each thing, by its name.
        overwrite: whether an existing file may be replaced.

    Raises:
        ResultsError: the file exists or cannot be written.
    """
    found = {
        name: tuple(
            _GraspRecord(
                tuple(tuple(row) for row in one.pose.tolist()),
                float(one.width),
                float(one.quality),
            )
            for one in some
        )
        for name, some in grasps.items()
    }
    write_record(Path(path), _GraspsFile(found), overwrite)


def load_grasps(path: str | Path) -> dict[str, tuple[Grasp, ...]]:
    """Read a file of grasps.

    Args:
        path: of a file that ``save_grasps`` wrote, or with the same content.

    Returns:
        The grasps of each thing, by its name.

    Raises:
        DatasetError: the file is missing or invalid, or one of the grasps is.
    """
    record = read_record(Path(path), _GraspsFile, "a file of grasps", DatasetError)
    found = {}
    for name, some in record.grasps.items():
        grasps = []
        for place, one in enumerate(some, 1):
            try:
                grasps.append(Grasp(np.array(one.pose), one.width, one.quality))
            except NextviewError as error:
                where = f"grasp {place} of {one_line(name)}"
                raise DatasetError(f"{path}: {where}: {error}") from None
        found[name] = tuple(grasps)
    return found


# Proposals


def propose_grasps(
    mesh: Mesh,
    gripper: Gripper,
    most: int = 400,
    friction: float = FRICTION,
    seed: int = 0,
) -> tuple[Grasp, ...]:
    """Propose antipodal grasps of a thing: two opposite contacts within the cones of friction.

    The fingers come from outside, so a thing is not held by the inside of a hole. Neither fingers
    nor palm touch the thing before the fingers close. ``quality`` is the share of the fingers'
    places that touch the thing, smaller for contacts far from the centroid, about which the thing
    would turn.

    Args:
        mesh: of the thing, of known unit.
        gripper: that grasps it.
        most: largest number of grasps; they come from as many sides as possible.
        friction: coefficient of friction between finger and thing.
        seed: of the points on the surface.

    Returns:
        The grasps, each in the frame of the mesh file, metres; () if the thing is too large.

    Raises:
        MeshError: the unit of the mesh is not known.
        UsageError: a number is out of range.
    """
    whole(most, "the number of grasps", 1)
    number(friction, "the coefficient of friction", above=0, most=10)
    surface = Surface.from_mesh(mesh, mesh.name)
    rng = np.random.default_rng(seed)
    points = _surface_points(surface, GRASPED_POINTS, rng)[0]
    rays = embree_scene([(surface.vertices, surface.faces)])
    pairs = _contact_pairs(surface, rays, gripper, friction, rng)
    poses, widths = _around_contacts(*pairs)
    for step in (COARSE_STEP, 1):
        fits = ~_touches_itself(points[::step], poses, widths, gripper)
        poses = poses[fits]
        widths = widths[fits]
    if not len(poses):
        return ()

    quality = _share_touching(surface, rays, poses, widths, gripper)
    middle = poses[:, :3, 3] - poses[:, :3, 2] * TIP_DEPTHS[0]
    lever = np.linalg.norm(middle - surface.centroid, axis=1) / surface.radius
    quality = quality * np.clip(1 - lever, 0, 1)
    order = _from_all_sides(poses, quality)[:most]
    return tuple(
        Grasp(poses[row], float(widths[row]), float(quality[row])) for row in order
    )


def _surface_points(
    surface: Surface, count: int, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Draw points on a surface, (N, 3), and the normals of their triangles, (N, 3)."""
    chosen = surface.faces[surface.triangles_by_area(count, rng)]
    corners = surface.vertices[chosen].astype(np.float64)
    weights = rng.dirichlet(np.ones(3), count)
    points = np.einsum("nk,nkd->nd", weights, corners)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return points, across / np.linalg.norm(across, axis=1, keepdims=True)


def _first_hits(
    rays: object, points: Float, axes: Float, far: float
) -> tuple[Float, Float]:
    """Where rays from far outside, against some axes, first meet a surface.

    Args:
        rays: an Embree scene.
        points: on the rays, (N, 3), metres.
        axes: unit vectors from the points outwards, (N, 3).
        far: metres from the points at which the rays begin.

    Returns:
        Distance of the hits from the points along the axes, (N,), minus infinity without one; and
        the cosine between normal and axis at each, (N,).
    """
    origins = np.ascontiguousarray(points + far * axes, np.float32)
    hits = rays.run(origins, np.ascontiguousarray(-axes, np.float32), output=1)  # type: ignore[attr-defined]
    hit = hits["primID"] >= 0
    normals = hits["Ng"] / np.maximum(
        np.linalg.norm(hits["Ng"], axis=1, keepdims=True), 1e-12
    )
    along = np.where(hit, far - hits["tfar"], -np.inf)
    return along, np.abs((normals * axes).sum(1)) * hit


def _contact_pairs(
    surface: Surface,
    rays: object,
    gripper: Gripper,
    friction: float,
    rng: np.random.Generator,
) -> tuple[Float, Float, Float]:
    """Find pairs of opposite contacts.

    Returns:
        Points midway between the contacts, (N, 3); closing axes, unit vectors, (N, 3); and
        distances of the contacts, (N,); metres.
    """
    points, axes = _surface_points(surface, CONTACT_POINTS, rng)
    far = 4 * surface.radius
    left, steep = _first_hits(rays, points, axes, far)
    right, steep_too = _first_hits(rays, points, -axes, far)
    widths = left + right
    cone = 1 / np.hypot(1, friction)  # cosine of the half angle of the cone of friction
    fits = (steep > cone) & (steep_too > cone)
    fits &= (widths > 0) & (widths < gripper.opening - 2 * GRASP_CLEARANCE)
    middle = points[fits] + axes[fits] * ((left - right) / 2)[fits, None]
    return middle, axes[fits], widths[fits]


def _around_contacts(
    middle: Float, closing: Float, widths: Float
) -> tuple[Float, Float]:
    """Turn the gripper around each pair of contacts; poses, (N, 4, 4), and widths, (N,)."""
    helper = np.where(
        np.abs(closing[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])
    )
    first = np.cross(closing, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(closing, first)
    angles = np.arange(APPROACHES) / APPROACHES * 2 * np.pi
    forward = (
        np.cos(angles)[:, None, None] * first + np.sin(angles)[:, None, None] * second
    )
    forward = np.concatenate([forward] * len(TIP_DEPTHS))
    depths = np.repeat(TIP_DEPTHS, APPROACHES)
    along = np.broadcast_to(closing, forward.shape)

    poses = np.zeros((*forward.shape[:2], 4, 4))
    poses[..., :3, 0] = np.cross(along, forward)
    poses[..., :3, 1] = along
    poses[..., :3, 2] = forward
    poses[..., :3, 3] = middle + depths[:, None, None] * forward
    poses[..., 3, 3] = 1
    return poses.reshape(-1, 4, 4), np.tile(widths, len(depths))


def _touches_itself(
    points: Float, poses: Float, widths: Float, gripper: Gripper
) -> Mask:
    """Whether fingers or palm are in the thing before the fingers close, (G,) bool."""
    x, y, z = _in_gripper(points.astype(np.float32), poses.astype(np.float32))
    x = np.abs(x)
    y = np.abs(y)
    behind = z < -gripper.finger_length

    half = widths[:, None] / 2
    fingers = (x < gripper.finger_width / 2) & (z < 0) & ~behind
    fingers &= y > half + PAD_TOUCH
    fingers &= y < half + GRASP_CLEARANCE + gripper.finger_thickness
    palm = (x < gripper.palm[0] / 2) & (y < gripper.palm[1] / 2) & behind
    return np.asarray((fingers | palm).any(1))


def _in_gripper(points: Float, poses: Float) -> tuple[Float, Float, Float]:
    """Coordinates x, y and z of points, (N, 3), in the frames of grippers, (G, N) each."""
    turned = np.einsum("nd,gdk->kgn", points, poses[:, :3, :3], optimize=True)
    start = np.einsum("gd,gdk->kg", poses[:, :3, 3], poses[:, :3, :3])
    x, y, z = turned - start[:, :, None]
    return x, y, z


def _share_touching(
    surface: Surface, rays: object, poses: Float, widths: Float, gripper: Gripper
) -> Float:
    """Share of the places on the ends of both fingers that touch the thing, (G,)."""
    far = 4 * surface.radius
    u, v = np.meshgrid(PAD_GRID, PAD_GRID, indexing="ij")
    own = gripper.finger_width * np.stack([u, 0 * u, v - PAD_GRID[-1]], -1).reshape(
        -1, 3
    )
    places = np.einsum("pd,gkd->gpk", own, poses[:, :3, :3]) + poses[:, None, :3, 3]
    touching = np.zeros(len(poses))
    for sign in (1, -1):
        axes = np.broadcast_to(sign * poses[:, None, :3, 1], places.shape)
        along, _ = _first_hits(rays, places.reshape(-1, 3), axes.reshape(-1, 3), far)
        off = np.abs(along.reshape(places.shape[:2]) - widths[:, None] / 2)
        touching += (off < PAD_TOUCH).mean(1)
    return touching / 2


def _from_all_sides(poses: Float, quality: Float) -> Index:
    """Order grasps so that the best one from each side comes first; similar ones are left out."""
    side = np.round(1.5 * poses[:, :3, 2])
    turn = np.round(1.5 * np.abs(poses[:, :3, 1]))
    place = np.round(poses[:, :3, 3] / ALIKE_PLACE)
    order = np.argsort(-quality, kind="stable")
    key = np.concatenate([side, turn, place], 1)[order]
    kept = order[np.sort(np.unique(key, axis=0, return_index=True)[1])]

    _, own = np.unique(side[kept], axis=0, return_inverse=True)
    rank = np.zeros(len(kept), np.int64)
    for group in range(own.max() + 1):
        rows = np.flatnonzero(own == group)
        rank[rows] = np.arange(len(rows))
    return np.asarray(kept[np.lexsort([-quality[kept], rank])])


# Those that are free in a scene


def free_grasps(
    objects: Sequence[SceneObject],
    tops: Sequence[TableTop],
    grasps: Mapping[str, Sequence[Grasp]],
    gripper: Gripper,
    clearance: float = GRASP_CLEARANCE,
    most_unseen: float = MOST_UNSEEN,
    region: Box | None = None,
) -> list[FreeGrasp]:
    """Find the grasps that nothing known is in the way of; see ``Scene.grasps``.

    Args:
        objects: of the scene.
        tops: support surfaces of the frames.
        grasps: of each thing, by its name.
        gripper: that grasps.
        clearance: distance that fingers and palm keep from everything else, metres.
        most_unseen: largest share of the fingers' space that no frame has shown to be empty.
        region: box that contains the things; None for everywhere.

    Returns:
        The grasps of all confident objects, the best first.

    Raises:
        UsageError: a number is out of range.
    """
    number(clearance, "the clearance", 0, 0.1)
    number(most_unseen, "the largest unseen share", 0, 1)

    known = {
        one.number: points for one in objects if (points := _known(one)) is not None
    }
    offering = [
        one
        for one in objects
        if one.number in known
        and grasps.get(one.name)
        and (region is None or _within(known[one.number], region))
    ]
    if not offering:
        return []

    measured = _Measured.of(tops, objects)
    found = []
    for one in offering:
        others = [points for other, points in known.items() if other != one.number]
        obstacles = np.concatenate(
            [measured.beside(one.number, known[one.number]), *others]
        )
        found += _free_of(
            one, grasps[one.name], obstacles, tops, gripper, clearance, most_unseen
        )
    return sorted(found, key=lambda grasp: -grasp.score)


def _free_of(
    one: SceneObject,
    grasps: Sequence[Grasp],
    obstacles: Float,
    tops: Sequence[TableTop],
    gripper: Gripper,
    clearance: float,
    most_unseen: float,
) -> list[FreeGrasp]:
    """Find the free grasps of one object, in the order in which they are given.

    Args:
        one: the object, with a pose.
        grasps: of its thing.
        obstacles: points of everything else, (N, 3), world, metres.
        tops: support surfaces of the frames.
        gripper: see ``free_grasps``, as the rest.
        clearance: metres.
        most_unseen: share.
    """
    assert one.pose is not None
    _check_lengths(one, grasps, gripper)
    poses = one.pose @ np.stack([grasp.pose for grasp in grasps])
    widths = np.array([grasp.width for grasp in grasps])
    openings = np.minimum(widths + 4 * clearance, gripper.opening)
    rows = np.flatnonzero(widths + 2 * clearance <= gripper.opening)

    far = _thinned(obstacles, PALM_STEP)
    rows = rows[~_palm_blocked(far, poses[rows], gripper, clearance)]
    reach = np.linalg.norm(poses[:, :3, 3] - one.place, axis=1).max()
    reach += gripper.finger_length + gripper.opening
    near = obstacles[np.linalg.norm(obstacles - one.place, axis=1) < reach]
    for step in (COARSE_STEP, 1):
        hit = _fingers_blocked(
            near[::step], poses[rows], openings[rows], gripper, clearance
        )
        rows = rows[~hit]

    unseen = _unseen(tops, poses[rows], openings[rows], gripper)
    return [
        FreeGrasp(
            one.number,
            one.name,
            poses[row],
            float(widths[row]),
            float(openings[row]),
            float(share),
            float(grasps[row].quality * (1 - share)),
        )
        for row, share in zip(rows.tolist(), unseen, strict=True)
        if share <= most_unseen
    ]


def _check_lengths(
    one: SceneObject,
    grasps: Sequence[Grasp],
    gripper: Gripper,
) -> None:
    """Refuse grasps so far from what is seen of a thing that no finger touches it.

    Raises:
        UsageError: most are farther away than the thing and the gripper are long.
    """
    assert one.pose is not None
    places = np.stack([grasp.pose[:3, 3] for grasp in grasps])
    to_thing = np.linalg.inv(one.pose)
    seen = one.seen_points @ to_thing[:3, :3].T + to_thing[:3, 3]
    # a thing is hardly ten times as long as the part that is seen
    reach = 10 * float(np.linalg.norm(np.ptp(seen, axis=0)))
    reach += gripper.finger_length + gripper.opening
    away = float(np.median(np.linalg.norm(places - seen.mean(0), axis=1)))
    if away <= reach:
        return
    places = places * MILLIMETRE
    nearer = np.median(np.linalg.norm(places - seen.mean(0), axis=1)) <= reach
    hint = ": are their poses in millimetres? Metres are expected" if nearer else ""
    raise UsageError(
        f"the grasps of {one.name} are {away:.3g} m away from it, where no finger touches it{hint}"
    )


def _not_asked(said: str) -> UsageError:
    """The error of a function that is asked whether a grasp can be reached."""
    return UsageError(
        f"asked whether a grasp can be reached, the function raised {said}"
    )


def within_reach(
    found: Sequence[FreeGrasp],
    reachable: Callable[[Float], bool],
    most: int | None,
) -> list[FreeGrasp]:
    """Return the first grasps that an arm can reach, as they are or with the fingers exchanged.

    Args:
        found: free grasps, the best first.
        reachable: function that returns True if the arm can bring the gripper to a pose,
            gripper-to-world, (4, 4).
        most: largest number of grasps; None for all.
    """
    kept: list[FreeGrasp] = []
    for grasp in found:
        if most is not None and len(kept) >= most:
            break
        for turn in (np.eye(4), HALF_TURN):
            pose = grasp.pose @ turn
            with plugin_errors(_not_asked):
                reached = reachable(pose)
            if truth_of(reached):
                kept.append(replace(grasp, pose=pose))
                break
    return kept


@dataclass(frozen=True, eq=False)
class _Measured:
    """What the frames measured, as the mean points of small cells.

    Attributes:
        points: (N, 3), world, metres.
        owner: number of the object in whose mask most pixels of the cell are, 0 for none, (N,).
    """

    points: Float
    owner: Index

    @classmethod
    def of(cls, tops: Sequence[TableTop], objects: Sequence[SceneObject]) -> _Measured:
        """Measure all frames.

        Left out are pixels at depth steps, which cameras measure between the two surfaces, cells
        that hardly any pixel covers, and what a later frame sees past.

        Args:
            tops: support surfaces of the frames.
            objects: of the scene.
        """
        points = []
        owners = []
        for number_of_frame, top in enumerate(tops):
            depth = top.frame.depth
            owner = np.zeros(depth.shape, np.int64)
            for one in objects:
                if number_of_frame in one.pixels:
                    owner[one.pixels[number_of_frame]] = one.number

            shown = depth > 0
            nearest = ndimage.minimum_filter(np.where(shown, depth, np.inf), 3)
            pixel = depth / top.frame.intrinsics[0, 0]
            shown &= depth - nearest < STEEPEST_SURFACE * pixel + OBSTACLE_STEP
            if not shown.any():
                continue
            usual = float(np.median(pixel[shown][::COARSE_STEP]))
            step = max(1, int(OBSTACLE_STEP / usual / np.sqrt(FEWEST_CELL_PIXELS)))
            rows, columns = step * np.stack(np.nonzero(shown[::step, ::step]))
            cells, own = _cells(
                top.frame.positions(rows, columns),
                step * pixel[rows, columns],
                owner[rows, columns],
            )

            past = np.zeros(len(cells), bool)
            for later in tops[number_of_frame + 1 :]:
                past |= _depth_behind(later, cells) > 2 * OBSTACLE_STEP
            points.append(cells[~past])
            owners.append(own[~past])
        return cls(
            np.concatenate([np.zeros((0, 3)), *points]),
            np.concatenate([np.zeros(0, np.int64), *owners]),
        )

    def beside(self, number_of_object: int, own: Float) -> Float:
        """Points that do not belong to an object, (M, 3).

        Args:
            number_of_object: of the object.
            own: points on its scan, (K, 3), metres.
        """
        low = own.min(0) - OWN_PIXELS
        high = own.max(0) + OWN_PIXELS
        near = ((self.points > low) & (self.points < high)).all(1)
        away, _ = cKDTree(own).query(self.points[near])
        mine = self.owner[near] == number_of_object
        itself = np.zeros(len(self.points), bool)
        itself[near] = (away < OWN_SURFACE) | mine & (away < OWN_PIXELS)
        return self.points[~itself]


def _cells(points: Float, pixels: Floats, owner: Index) -> tuple[Float, Index]:
    """Average points in cells of OBSTACLE_STEP.

    Args:
        points: (N, 3), metres.
        pixels: side of the pixel of each point, metres, (N,).
        owner: object of each point, (N,).

    Returns:
        The mean of each cell, (C, 3), and the owner of one of its points, (C,).
    """
    flat = _cell_of(points, OBSTACLE_STEP)
    _, first, cell = np.unique(flat, return_index=True, return_inverse=True)
    count = np.bincount(cell)
    means = np.stack([np.bincount(cell, axis) for axis in points.T], 1) / count[:, None]
    covered = np.bincount(cell, pixels.astype(np.float64) ** 2) / OBSTACLE_STEP**2
    kept = covered >= LEAST_COVERED
    return means[kept], owner[first[kept]]


def _cell_of(points: Float, step: float) -> Index:
    """Number of the cell of each point, (N,), of cells with a side of some metres."""
    cells = np.floor(points / step).astype(np.int64)
    cells -= cells.min(0, initial=0)
    size = cells.max(0, initial=0) + 1
    return np.asarray((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2])


def _thinned(points: Float, step: float) -> Float:
    """Keep one point of each cell with a side of some metres."""
    return points[np.unique(_cell_of(points, step), return_index=True)[1]]


def _known(one: SceneObject) -> Float | None:
    """Points on the scan of a confident object, (N, 3), world, metres; None for another object."""
    if not one.confident or not one.candidates or one.pose is None:
        return None
    named = [each for each in one.candidates if each.thing == one.name]
    shown = named[0] if named else one.candidates[0]
    if shown.vertices is None or shown.faces is None:
        return None
    surface = Surface(one.name, shown.vertices, shown.faces)
    points, _ = _surface_points(surface, 4 * GRASPED_POINTS, np.random.default_rng(0))
    return _thinned(points @ one.pose[:3, :3].T + one.pose[:3, 3], OBSTACLE_STEP)


def _within(points: Float, region: Box) -> bool:
    """Whether all points, (N, 3), are in a box, but for the error of a pose."""
    along = points @ region.axes.T
    inside = (along > region.low - OWN_SURFACE) & (along < region.high + OWN_SURFACE)
    return bool(inside.all())


def _palm_blocked(
    points: Float, poses: Float, gripper: Gripper, clearance: float
) -> Mask:
    """Whether something is on the straight way of the palm to a grasp, (G,) bool."""
    x, y, z = _in_gripper(points.astype(np.float32), poses.astype(np.float32))
    palm = np.abs(x) < gripper.palm[0] / 2 + clearance
    palm &= np.abs(y) < gripper.palm[1] / 2 + clearance
    back = -gripper.finger_length
    palm &= (z < back + clearance) & (z > back - gripper.palm[2] - APPROACH)
    return np.asarray(palm.any(1))


def _fingers_blocked(
    points: Float,
    poses: Float,
    openings: Float,
    gripper: Gripper,
    clearance: float,
) -> Mask:
    """Whether something is where the open fingers are in a grasp, or between them, (G,) bool.

    What is between them may not be another thing, so that they do not close on two. The way of the
    fingers is within that of the palm.
    """
    x, y, z = _in_gripper(points.astype(np.float32), poses.astype(np.float32))
    span = openings[:, None] / 2 + gripper.finger_thickness + clearance
    fingers = np.abs(x) < gripper.finger_width / 2 + clearance
    fingers &= np.abs(y) < span
    fingers &= (z < clearance) & (z > -gripper.finger_length)
    return np.asarray(fingers.any(1))


def _unseen(
    tops: Sequence[TableTop], poses: Float, openings: Float, gripper: Gripper
) -> Float:
    """Share of the fingers' space that no frame has shown to be empty, (G,)."""
    across, thick, long = (
        (np.arange(count) + 0.5) / count - 0.5 for count in FINGER_STEPS
    )
    x, y, z = np.meshgrid(
        across * gripper.finger_width,
        thick * gripper.finger_thickness,
        (long - 0.5) * gripper.finger_length,
        indexing="ij",
    )
    finger = np.stack([x, y, z], -1).reshape(-1, 3)

    both = np.concatenate([finger, finger])
    sides = np.repeat([1.0, -1.0], len(finger))
    own = np.broadcast_to(both, (len(poses), *both.shape)).copy()
    own[..., 1] += sides * (openings[:, None] + gripper.finger_thickness) / 2
    places = np.einsum("gpd,gkd->gpk", own, poses[:, :3, :3]) + poses[:, None, :3, 3]

    free = np.zeros(places.shape[:2], bool)
    for top in tops:
        free |= (_depth_behind(top, places.reshape(-1, 3)) > 0).reshape(free.shape)
    return np.asarray(1 - free.mean(1))


def _depth_behind(top: TableTop, points: Float) -> Float:
    """Measured depth less that of points, (N, 3), metres, (N,); minus infinity if not measured."""
    frame = top.frame
    pose = frame.camera_to_world
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    away = inside[:, 2]
    ahead = away > 0.01
    at = frame.pinhole.project(
        np.column_stack([inside[:, :2], np.where(ahead, away, 1.0)])
    )
    column, row = np.floor(np.clip(at, -1e6, 1e6)).astype(np.int64).T
    ahead &= (row >= 0) & (row < frame.shape[0])
    ahead &= (column >= 0) & (column < frame.shape[1])
    depth = frame.depth[np.where(ahead, row, 0), np.where(ahead, column, 0)]
    return np.where(ahead & (depth > 0), depth - away, -np.inf)
