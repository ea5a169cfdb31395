"""What the next views of a scene may show: information on uncertain objects and hidden areas.

The expected information of a view is summed over the objects. Each object is rendered from each
candidate view in its likeliest hypotheses, behind everything known to stand in front of it; see
``views.expected_views``. Occluded areas may contain further objects. The part of the table that no
frame has shown therefore counts too, weighted with the density of objects on the visible part.
``view_policies`` chooses by these values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from nextview.geometry.axes import upright_axes
from nextview.geometry.viewsphere import angle_between
from nextview.scene.objects import SceneObject
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.tabletop import TableTop
from nextview.session.limits import Limits
from nextview.session.reach import Reach
from nextview.session.surroundings import Surroundings
from nextview.session.system import System
from nextview.things.world import World
from nextview.types import Float, Index, Mask
from nextview.views.expected_views import Outlook

TABLE_CELL = 0.02  # metres, side of a cell of the table
OBJECT_MARGIN = 0.08  # metres of table around the objects that count
HIDDEN_STEP = 0.015  # metres, least distance of an occluder in front of a hidden cell
RAY_STEPS = 48  # samples along a ray that is tested for occluders
FEWEST_HIDDEN = 12  # connected hidden cells; fewer cannot hide an object

SAME_VIEW_ANGLE = np.radians(15.0)  # between two views with the same information
UNKNOWN_WORTH = (
    1.0  # nats, information of a view of an unknown object from the far side
)
SURE_WORTH = 0.1  # the same for a settled object, which may be two or hide another one
SOME_POINTS = 60  # sampled points of an object for the occlusion test


@dataclass(frozen=True, eq=False)
class TableGround:
    """Top view of the table as a grid of cells.

    Attributes:
        points: centre of each cell on the plane, (C, 3), world, metres.
        top: height of the highest point over each cell, above the plane, (C,), metres; 0 if empty.
        hidden: cells that are occluded in every frame that contains them, (C,) bool.
        shape: rows and columns of cells; C is their product.
        low: corner of the first cell, along the axes, (2,), metres.
        axes: upright, rows x, y and z in the world, (3, 3).
        floor: height of the plane along z, metres.
    """

    points: Float
    top: Float
    hidden: Mask
    shape: tuple[int, int]
    low: Float
    axes: Float
    floor: float

    @classmethod
    def of(
        cls, tops: Sequence[TableTop], objects: Sequence[SceneObject]
    ) -> TableGround:
        """Lay a grid over the visible part of the plane.

        Args:
            tops: support surfaces of the frames, at least one.
            objects: at least one.
        """
        axes = upright_axes(tops[0].up)
        corners = np.concatenate([one.seen_points for one in objects])
        flat = corners @ axes.T
        plane = tops[0].plane
        floor = float(np.median(flat[:, 2] - plane.height(corners)))
        low = flat[:, :2].min(0) - OBJECT_MARGIN
        count = (
            np.ceil((flat[:, :2].max(0) + OBJECT_MARGIN - low) / TABLE_CELL).astype(int)
            + 1
        )
        shape = (int(count[0]), int(count[1]))
        at = np.stack(
            np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"),
            -1,
        ).reshape(-1, 2)
        middle = np.column_stack(
            [low + (at + 0.5) * TABLE_CELL, np.full(len(at), floor)]
        )
        level = middle @ axes
        # the plane may be slightly tilted
        points = level - plane.height(level)[:, None] * axes[2] / (
            plane.normal @ axes[2]
        )

        top = np.zeros(len(points))
        in_view = np.zeros(len(points), bool)
        shown = np.zeros(len(points), bool)
        for one in tops:
            _raise_over(top, one, low, shape, axes)
            inside, seen = _seen_in(one.frame, points)
            in_view |= inside
            shown |= seen
        return cls(points, top, in_view & ~shown & (top == 0), shape, low, axes, floor)

    @property
    def largest_hidden(self) -> Index:
        """Cells of the largest connected hidden area of the table, (N,) int64."""
        label, count = ndimage.label(self.hidden.reshape(self.shape))
        if not count:
            return np.zeros(0, np.int64)
        largest = np.bincount(label.ravel())[1:].argmax() + 1
        return np.flatnonzero(label.ravel() == largest)

    def visible(self, camera: Float) -> Mask:
        """Return which cells would be visible from a camera position, (C,) bool.

        Args:
            camera: position, (3,), world.
        """
        own = np.full(len(self.points), TABLE_CELL / 2)
        return self.clear(camera, self.points, (self.points @ self.axes.T)[:, 2], own)

    def past_others(self, camera: Float, points: Float) -> Mask:
        """Return which points of one object would be visible past everything else, (N,) bool.

        Args:
            camera: position, (3,), world.
            points: of the object, (N, 3), world, metres.
        """
        middle = points.mean(0)
        aside = np.linalg.norm((points - middle) @ self.axes[:2].T, axis=1)
        # the object does not occlude itself, whatever the direction of the camera
        own = aside + aside.max() + TABLE_CELL
        return self.clear(camera, points, np.full(len(points), self.floor), own)

    def clear(self, camera: Float, points: Float, floor: Float, own: Float) -> Mask:
        """Return which points would be visible from a camera position, (N,) bool.

        Args:
            camera: position, (3,), world.
            points: to test, (N, 3), world, metres.
            floor: height of the plane below each point, (N,), metres.
            own: horizontal distance around each point without occluders, (N,), metres.
        """
        start = self.axes @ camera
        ends = points @ self.axes.T
        # Only the part of each ray below the highest object can be blocked.
        highest = float(self.top.max()) if len(self.top) else 0.0
        rise = max(start[2] - self.floor, 1e-6)
        last = min(1.0, (highest + TABLE_CELL) / rise)
        shares = np.linspace(0, last, RAY_STEPS, endpoint=False)[1:]
        along = ends[:, None] + shares[:, None] * (start - ends)[:, None]

        cell = np.floor((along[..., :2] - self.low) / TABLE_CELL).astype(np.int64)
        inside = ((cell >= 0) & (cell < self.shape)).all(-1)
        index = np.where(inside, cell[..., 0] * self.shape[1] + cell[..., 1], 0)
        beyond = (
            np.linalg.norm(along[..., :2] - ends[:, None, :2], axis=-1) > own[:, None]
        )
        blocked = inside & beyond & (self.top[index] > along[..., 2] - floor[:, None])
        return np.asarray(~blocked.any(1))


def _raise_over(
    top: Float,
    one: TableTop,
    low: Float,
    shape: tuple[int, int],
    axes: Float,
) -> None:
    """Raise the height of each cell to the points of a frame above the plane."""
    rows, columns = np.nonzero(one.above)
    few = slice(None, None, max(1, len(rows) // 20_000))
    points = one.frame.positions(rows[few], columns[few])
    cell = np.floor((points @ axes[:2].T - low) / TABLE_CELL).astype(np.int64)
    inside = ((cell >= 0) & (cell < shape)).all(1)
    index = cell[inside, 0] * shape[1] + cell[inside, 1]
    np.maximum.at(
        top,
        index,
        one.height[rows[few], columns[few]][inside].astype(np.float64),
    )


def _seen_in(frame: Frame, points: Float) -> tuple[Mask, Mask]:
    """Return which points, (C, 3), have a depth in a frame, and which are not occluded."""
    pose = frame.camera_to_world
    in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = in_camera[:, 2] > 0.01
    away = np.where(ahead, in_camera[:, 2], 1.0)

    at = frame.pinhole.project(np.column_stack([in_camera[:, :2], away]))
    column, row = np.floor(np.clip(at, -1e6, 1e6)).astype(np.int64).T
    inside = ahead & (row >= 0) & (row < frame.shape[0])
    inside &= (column >= 0) & (column < frame.shape[1])

    depth = np.where(
        inside,
        frame.depth[np.where(inside, row, 0), np.where(inside, column, 0)],
        0,
    )
    measured = depth > 0
    return measured, np.asarray(measured & (depth > away - HIDDEN_STEP))


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate views of a whole scene.

    Attributes:
        poses: camera-to-world, (V, 4, 4), OpenCV axes, metres.
        directions: from the centre of the scene to each view, unit vectors, (V, 3), upright axes
            (z against gravity).
        free: views that may be chosen: within limits and reach, and not close to an earlier view,
            (V,) bool.
        travel: straight way from the last camera to each view, (V,), metres; or its cost by
            ``Scene.travel_cost``.
        current: direction from the centre of the scene to the last camera, unit vector, (3,),
            upright axes.
    """

    poses: Float
    directions: Float
    free: Mask
    travel: Float
    current: Float


def candidates(
    system: System,
    tops: Sequence[TableTop],
    around: ObjectFrame,
    distance: float | None,
    limits: Limits,
    surroundings: Sequence[Surroundings],
    reach: Reach,
) -> Candidates:
    """Create candidate views around a scene, all at the same distance from its centre.

    Args:
        system: with the directions of the candidates.
        tops: support surfaces of the frames.
        around: what the cameras look at, world, metres.
        distance: of the cameras from the centre, metres; None for that of the last camera.
        limits: on the positions of the cameras.
        surroundings: of the scene in each frame.
        reach: of the camera.
    """
    last = tops[-1].frame.camera_to_world
    places = np.stack([top.frame.camera_to_world[:3, 3] for top in tops])
    turned = (places - around.centre) @ around.axes.T
    ways = np.linalg.norm(turned, axis=1)
    away = float(ways[-1]) if distance is None else distance
    poses = around.pose_in_world(system.sphere.poses, away)
    directions = (poses[:, :3, 3] - around.centre) @ around.axes.T / away
    towards = turned / ways[:, None]

    free = limits.reasons(poses, around, surroundings) == ""
    for earlier in towards:
        free &= angle_between(directions, earlier) > SAME_VIEW_ANGLE

    start = int(np.argmax(directions @ towards[-1]))
    views, cost = reach.moves(np.flatnonzero(free), start, last, lambda: poses)
    free = np.isin(np.arange(len(free)), views)
    travel = np.linalg.norm(poses[:, :3, 3] - places[-1], axis=1)
    if cost is not None:
        travel = np.full(len(free), cost.max(initial=0.0))
        travel[views] = cost
    return Candidates(poses, directions, free, travel, towards[-1])


def object_value(
    world: World,
    one: SceneObject,
    tops: Sequence[TableTop],
    ground: TableGround,
    views: Candidates,
) -> Float:
    """Return the expected information of each view about one object, nats, (V,).

    A view from another side tells a name from a stranger: by its distance from the views of the
    object, times the share of the object that it shows. Where names or poses are in doubt, it tells
    them apart, too.

    Args:
        world: what explains the frames.
        one: the object.
        tops: support surfaces of the frames.
        ground: with everything that may occlude the object.
        views: the candidates; values of views that are not free have no meaning.
    """
    told = _from_another_side(one, tops, views)
    points = outline_of(one)
    for row in np.flatnonzero(views.free):
        told[row] *= ground.past_others(views.poses[row, :3, 3], points).mean()
    if not one.settled and one.candidates:
        told = told + _information(world, one, tops, views)
    return told


def outline_of(one: SceneObject) -> Float:
    """Sample the measured points of an object in all frames, (N, 3), world, metres."""
    points = one.seen_points
    return points[:: max(1, len(points) // SOME_POINTS)]


def ground_value(
    ground: TableGround,
    objects: int,
    things: int,
    views: Candidates,
) -> Float:
    """Return the expected information of each view about objects on the hidden ground, nats, (V,).

    Args:
        ground: the table.
        objects: number of objects that are found on it.
        things: number of things that are known.
        views: the candidates; the value of a view that is not free is 0.
    """
    value = np.zeros(len(views.poses))
    if len(ground.largest_hidden) < FEWEST_HIDDEN:
        return value
    each = objects * np.log(max(things, 2)) / max(len(ground.hidden), 1)
    for row in np.flatnonzero(views.free):
        seen = ground.visible(views.poses[row, :3, 3]) & ground.hidden
        value[row] = each * np.count_nonzero(seen)
    return value


def elsewhere_value(tops: Sequence[TableTop], views: Candidates) -> Float:
    """Return the value of each view by its distance from the views of all frames, nats, (V,).

    Args:
        tops: support surfaces of the frames.
        views: the candidates.
    """
    earlier = [top.frame.camera_to_world[:3, 2] for top in tops]
    return UNKNOWN_WORTH * _nearest_angle(views.poses[:, :3, 2], earlier) / np.pi


def _nearest_angle(towards: Float, earlier: Sequence[Float]) -> Float:
    """Return the angle from unit vectors, (V, 3), to the nearest of earlier ones, radians, (V,)."""
    return np.min([angle_between(towards, before) for before in earlier], axis=0)


def _information(
    world: World,
    one: SceneObject,
    tops: Sequence[TableTop],
    views: Candidates,
) -> Float:
    """Return the expected information of each view about a named object, nats, (V,).

    Occluders in front of the object are taken into account.
    """
    # a frame with its origin in the object, z against gravity
    axes = upright_axes(tops[0].up)
    to_object = np.eye(4)
    to_object[:3, :3] = axes
    to_object[:3, 3] = -axes @ one.place
    thing = world.thing(one.number)
    outlook = Outlook.of(world, thing, one.candidates, one.beliefs, to_object)
    return outlook.expect(to_object @ views.poses).information("thing")


def _from_another_side(
    one: SceneObject,
    tops: Sequence[TableTop],
    views: Candidates,
) -> Float:
    """Return the value of each view by its distance from the views of one object, nats, (V,)."""
    places = [tops[number].frame.camera_to_world[:3, 3] for number in one.pixels]
    earlier = [_unit(place - one.place) for place in places]
    towards = _unit(views.poses[:, :3, 3] - one.place)
    worth = one.confidence * SURE_WORTH + (1 - one.confidence) * UNKNOWN_WORTH
    return worth * _nearest_angle(towards, earlier) / np.pi


def _unit(ways: Float) -> Float:
    """Return vectors, (..., 3), at unit length."""
    return np.asarray(ways / np.linalg.norm(ways, axis=-1, keepdims=True))
