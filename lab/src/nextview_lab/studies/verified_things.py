"""Taught things recognised by outline and size, and verified by their geometry, at true size.

    python -m nextview_lab.studies.verified_things SCANS [--models ycb] [--draws 0 1] [--every 3]
        [--poses thrown] [--any-orientation] [--known even]

SCANS holds the scans of the things that the memory knows, in metres, by their names: they are what
is looked at. Each draw shows every thing once, with an azimuth, views and errors of the sensor of
its own. The camera stands five object radii away, between 25 cm from the surface and 45 cm from the
centre. Things stand as they were scanned (``--poses scanned``), as they fall (``thrown``: on any
face of the convex hull, as often as throws end on it) or as people stand them up (``stood``: the
pose with the highest centre in which at least a thousandth of the throws end). With
``--any-orientation`` they hang in the middle of a round room, turned at random about all axes; the
error of the rotation, modulo the symmetries of the thing, stands in the place of those of azimuth
and resting pose.

Prints after 1, 2, 3 and 5 random views: the share that is named right by outline and size, and
with the geometry; the expected calibration error (ten bins) and the share that is wrong with a
belief of 0.97 and more; of the things that are named right the error of the azimuth (things without
a symmetry about the vertical; a box counts modulo half a turn), of the place of the centre in the
camera's frame, ADD-S below a tenth of the diameter in the same frame (Hinterstoisser et al. 2012;
the definitions of the BOP toolkit), and the share in the right resting pose, or one that looks the
same; and the milliseconds of one core from a further frame to the decision.

With ``--known even`` or ``odd`` every other thing is known, as if the others had been removed from
the memory, and all are shown: printed is how many are called unknown, by a p-value below 0.02.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
import tyro
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.observation import Observation
from nextview.geometry.resting import rotated, stable_poses
from nextview.geometry.viewsphere import (
    ViewSphere,
    azimuth_of,
    direction_of,
    rotation_z,
)
from nextview.recognition.belief import log_evidence_of
from nextview.recognition.model_card import Symmetry
from nextview.recognition.protocol import JointBelief
from nextview.simulation.sensed_camera import BARE_TABLE_RADIUS, SensedCamera
from nextview.things.recogniser import VerifiedRecogniser
from nextview.things.surface import Surface
from nextview.types import Float
from nextview_lab.studies.shared import markdown, progress, scans_of

SPHERE = ViewSphere((0.0, 18.0, 36.0, 54.0, 72.0), 8)
Poses = Literal["scanned", "thrown", "stood"]
# share of the throws that end in a pose in which people can stand a thing
STABLE = 0.001
CONFIDENT = 0.97
REJECTED = 0.02  # p-value below which a thing is called unknown
POINTS = 1000  # of a surface, for symmetries and ADD-S
# largest distance to a turned copy, diameters, of a symmetric thing, as in BOP
SYMMETRIC = 0.1
# degrees that the vertical of a thing in the right resting pose may be off
UPRIGHT = 20.0
COLUMNS = (
    "views",
    "by outline",
    "verified",
    "calibration error",
    "sure and wrong",
    "azimuth, degrees: median, 95 %",
    "rotation, degrees: median, 95 %",
    "place, mm, camera's frame: median, 95 %",
    "in the world: median",
    "ADD-S < 0.1 d",
    "resting pose",
    "ms of CPU: median, worst",
)
OF_HELD_THINGS = ("rotation, degrees: median, 95 %",)  # columns
OF_STANDING_THINGS = ("azimuth, degrees: median, 95 %", "resting pose")
POSE_ERRORS = ("azimuth", "rotation", "place", "place_in_world", "add_s", "resting")
ROOM = 1.5  # metres from a thing that hangs in the air to the wall
FARTHEST = 25.0  # object radii from a small one
ORDERS = (1, 2, 3, 4, 5, 6, 7, 8)  # of symmetries about the vertical
ROUND = 6  # order from which a thing looks the same from all azimuths: fruit is not exactly round


@dataclass(frozen=True)
class Setting:
    """How things are shown.

    Attributes:
        sensor: what the views are taken with.
        views: how many views are taken.
        poses: how they rest: as they were scanned, as they fall, or as people stand them up.
        any_orientation: whether they hang in a room, turned at random about all axes.
    """

    sensor: str
    views: int
    poses: Poses
    any_orientation: bool


@dataclass(frozen=True, eq=False)
class Episode:
    """A thing, and some views of it.

    Attributes:
        thing: number of the thing.
        observations: the views.
        true_pose: of the scan file's frame in the object frame, (4, 4), metres.
        in_cameras: of the scan file's frame in the frame of each camera, (V, 4, 4), metres.
    """

    thing: int
    observations: list[Observation]
    true_pose: Float
    in_cameras: Float


@dataclass(frozen=True)
class Outcome:
    """What was found of a thing after some views; ``None`` where it was not named right.

    Attributes:
        thing: number of the thing.
        views: after how many.
        by_outline: whether outline and size alone name it right.
        answer: the thing believed most.
        confidence: belief in it.
        seconds: of CPU from the last frame to the decision.
        p_value: by which it is called unknown.
        azimuth: error, degrees; None for a thing with every symmetry, and in another resting pose
            that looks the same, too.
        rotation: error about any axis, degrees, modulo the thing's symmetries; None for a ball.
        place: error of the centre in the last camera's frame, metres.
        place_in_world: the same in the robot's world, in which the cameras' places have errors.
        add_s: mean distance of the surface's points, diameters.
        resting: whether the resting pose is right.
    """

    thing: int
    views: int
    by_outline: bool
    answer: int
    confidence: float
    seconds: float
    p_value: float
    azimuth: float | None
    rotation: float | None
    place: float | None
    place_in_world: float | None
    add_s: float | None
    resting: bool | None

    @property
    def right(self) -> bool:
        """Whether the thing is named right."""
        return self.answer == self.thing


@dataclass(frozen=True, eq=False)
class Taught:
    """The things of a memory, and their scans, which are looked at.

    Attributes:
        orders: of the symmetry about the vertical; 0 for any azimuth.
    """

    recogniser: VerifiedRecogniser
    names: tuple[str, ...]
    meshes: list[Mesh]
    surfaces: list[Surface]
    points: list[Float]
    orders: list[int]

    @classmethod
    def load(cls, models: str, scans: Path) -> Taught:
        """Read a memory, and the scans of what it knows."""
        recogniser = VerifiedRecogniser(models, threads=1)
        names = recogniser.library.names
        if len(names) < len(recogniser.classes):
            raise UsageError(
                f"{models}: does not know the geometry of all its things; teach it with --unit"
            )
        meshes = [load_mesh(path, unit="m") for path in scans_of(scans, names)]
        whole = [
            Surface.from_mesh(mesh, name)
            for mesh, name in zip(meshes, names, strict=True)
        ]
        points = [surface.sample(POINTS, np.random.default_rng(0)) for surface in whole]
        orders = [symmetry_order(*both) for both in zip(whole, points, strict=True)]
        surfaces = list(recogniser.library.caster.surfaces)
        return cls(recogniser, names, meshes, surfaces, points, orders)

    def things(self, some: NDArray[np.int64]) -> VerifiedRecogniser:
        """A recogniser of some of the things, as if the others had been removed."""
        own = self.recogniser
        left = np.setdiff1d(np.arange(len(own.classes)), own.labels[some])
        return own.without([own.classes[label] for label in left])


def symmetry_order(surface: Surface, points: Float) -> int:
    """How many azimuths a thing looks the same from; 0 if all of them."""
    centred = points - surface.centre
    tree = cKDTree(centred)
    nearest = np.asarray(tree.query(centred, k=2)[0])
    apart = nearest[:, 1].mean() / 2  # of the points themselves
    same = []
    for order in ORDERS:
        turn = rotation_z(2 * np.pi / order)
        distance = np.quantile(tree.query(centred @ turn.T)[0], 0.99) - apart
        same.append(distance < SYMMETRIC * surface.diameter)
    highest = max(
        order for order, alike in zip(ORDERS, same, strict=True) if alike or order == 1
    )
    return 0 if highest >= ROUND else highest


def shown(
    taught: Taught,
    thing: int,
    draw: int,
    setting: Setting,
) -> Episode:
    """Look at a thing from random viewpoints through a sensor, at its true size.

    Args:
        taught: the things.
        thing: number of the one that is shown.
        draw: number of the draw.
        setting: how it is shown.
    """
    rng = np.random.default_rng([thing, draw])
    turn = rotation_z(rng.uniform(0, 2 * np.pi))
    mesh = taught.meshes[thing]
    if setting.poses != "scanned":
        turn = turn @ lying(
            mesh, setting.poses, np.random.default_rng([thing, draw, 1])
        )
    if setting.any_orientation:
        turn = Rotation.random(rng=np.random.default_rng([thing, draw, 3])).as_matrix()
    standing = rotated(mesh, turn)
    around = None
    if setting.any_orientation:
        around = room_around(standing)
    camera = SensedCamera(
        standing,
        setting.sensor,
        np.random.default_rng([thing, draw, 7]),
        around=around,
        table=0.0 if setting.any_orientation else BARE_TABLE_RADIUS,
    )
    observations = []
    cameras = []
    for view in rng.permutation(len(SPHERE)):
        observation = camera.observe(SPHERE.poses[view])
        if observation.seen and observation.scene is not None:
            assert camera.true_pose is not None
            observations.append(observation)
            cameras.append(camera.true_pose)
        if len(observations) == setting.views:
            break

    in_truth = np.eye(4)
    in_truth[:3, :3] = turn
    in_truth[:3, 3] = -(turn @ mesh.centre + standing.centre)
    frame = camera.object_frame
    to_object = np.eye(4)
    to_object[:3, :3] = frame.axes
    to_object[:3, 3] = -frame.axes @ frame.centre
    in_cameras = np.linalg.inv(np.stack(cameras)) @ in_truth
    return Episode(thing, observations, to_object @ in_truth, in_cameras)


def lying(mesh: Mesh, poses: Poses, rng: np.random.Generator) -> Float:
    """A rotation into a pose in which a thing was thrown or stood up, (3, 3)."""
    stable = stable_poses(mesh)
    if poses == "thrown":
        return stable.rotations[rng.choice(len(stable.shares), p=stable.shares)]
    high = [-(mesh.vertices @ turn[2]).min() for turn in stable.rotations]
    return stable.rotations[int(np.where(stable.shares >= STABLE, high, 0).argmax())]


def room_around(mesh: Mesh) -> Mesh:
    """The wall of a round room in whose middle a thing hangs: something is behind it everywhere."""
    assert mesh.metres is not None
    wall = trimesh.creation.icosphere(3, min(ROOM / mesh.metres, FARTHEST))
    return replace(
        mesh,
        vertices=wall.vertices,
        faces=wall.faces.astype(np.int32),
        name="room",
    )


def judged(
    things: VerifiedRecogniser,
    taught: Taught,
    episode: Episode,
    views: int,
) -> Outcome:
    """Recognise the thing of an episode after some views.

    Args:
        things: recogniser of some of the things.
        taught: all things.
        episode: what was seen.
        views: number of views.
    """
    observations = episode.observations[:views]
    said = things(observations)
    directions = np.stack([direction_of(one.pose) for one in observations])
    total = log_evidence_of(said.logits, said.azimuth_bins, azimuth_of(directions)).sum(
        0
    )
    by_outline = things.calibration.belief(total, views, len(things.classes))
    by_outline[things.ruled_out] = 0

    begun = time.process_time()
    found = things.together(observations, total, views)
    seconds = time.process_time() - begun

    truth = things.labels[episode.thing]
    label = int(found.belief.argmax())
    answer = int(np.flatnonzero(things.labels == label)[0])
    errors: dict = dict.fromkeys(POSE_ERRORS)
    if answer == episode.thing and found.poses:
        errors = pose_errors(taught, found, episode, views)
    return Outcome(
        thing=episode.thing,
        views=views,
        by_outline=int(by_outline.argmax()) == truth,
        answer=answer,
        confidence=float(found.belief.max()),
        seconds=seconds,
        p_value=1.0 if found.p_value is None else found.p_value,
        **errors,
    )


def pose_errors(
    taught: Taught, found: JointBelief, episode: Episode, views: int
) -> dict[str, float | bool | None]:
    """Errors of the pose of the thing that was named right, by the names of an outcome's fields.

    Args:
        taught: the things.
        found: what was found.
        episode: what was seen.
        views: how many of the views were taken.
    """
    name = taught.names[episode.thing]
    pose = next(one.pose for one in found.poses if one.thing == name)
    surface = taught.surfaces[episode.thing]
    points = taught.points[episode.thing]

    # As the last camera sees it: what the view is displaced by belongs to the place of the camera.
    world = found.found[0]
    in_camera = np.linalg.inv(world.views[views - 1].camera) @ pose
    true_in_camera = episode.in_cameras[views - 1]

    centre = np.append(surface.centre, 1)
    tree = cKDTree(moved(points, true_in_camera))
    add_s = np.mean(tree.query(moved(points, in_camera))[0]) / surface.diameter
    turn = pose[:3, :3] @ episode.true_pose[:3, :3].T
    azimuth = np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    order = taught.orders[episode.thing]
    step = 360 / order if order else 0
    up = pose[2, :3] @ episode.true_pose[2, :3]
    same_pose = up > np.cos(np.radians(UPRIGHT))
    symmetries = taught.recogniser.library.symmetries[name]
    return {
        "azimuth": abs((azimuth + step / 2) % step - step / 2)
        if order and same_pose
        else None,
        "rotation": rotation_error(pose[:3, :3], episode.true_pose[:3, :3], symmetries),
        "place": float(np.linalg.norm((in_camera - true_in_camera) @ centre)),
        "place_in_world": float(np.linalg.norm((pose - episode.true_pose) @ centre)),
        "add_s": float(add_s),
        "resting": bool(same_pose or add_s < 0.1),
    }


def rotation_error(
    found: Float,
    true: Float,
    symmetries: Sequence[Symmetry],
) -> float | None:
    """The angle between two rotations of a thing that its symmetries leave.

    Args:
        found: rotation from the axes of its scan, (3, 3).
        true: the same, (3, 3).
        symmetries: of the thing.

    Returns:
        Degrees; None for a ball, which looks the same in all rotations.
    """
    apart = Rotation.from_matrix(true.T @ found)  # about the axes of the scan
    free = [np.array(symmetry.axis) for symmetry in symmetries if symmetry.order == 0]
    if len(free) > 1:
        return None

    same = [apart]
    for symmetry in symmetries:
        angles = 2 * np.pi * np.arange(symmetry.order) / max(symmetry.order, 1)
        turns = [
            Rotation.from_rotvec(angle * np.array(symmetry.axis)) for angle in angles
        ]
        same = [each * turn for each in same for turn in turns] or same
    if free:
        cosine = max(float(free[0] @ each.apply(free[0])) for each in same)
        return float(np.degrees(np.arccos(min(cosine, 1.0))))
    return float(np.degrees(min(each.magnitude() for each in same)))


def moved(points: Float, pose: Float) -> Float:
    """Points, (N, 3), in another frame."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def calibration_error(outcomes: Sequence[Outcome]) -> float:
    """Expected calibration error of the belief in the answer, ten bins."""
    right = np.array([outcome.right for outcome in outcomes])
    confidence = np.array([outcome.confidence for outcome in outcomes])
    bins = np.minimum((10 * confidence).astype(int), 9)
    gaps = [abs((right - confidence)[bins == k].sum()) for k in range(10)]
    return float(sum(gaps) / len(right))


def table(
    outcomes: Sequence[Outcome],
    views: Sequence[int],
    held: bool,
) -> str:
    """The results as a table.

    Args:
        outcomes: of all draws.
        views: after how many views things were judged.
        held: whether things hang in a room in any orientation.
    """
    left_out = OF_STANDING_THINGS if held else OF_HELD_THINGS
    kept = [number for number, name in enumerate(COLUMNS) if name not in left_out]
    rows = (row([one for one in outcomes if one.views == k], k) for k in views)
    return markdown(
        [COLUMNS[number] for number in kept],
        [[cells[number] for number in kept] for cells in rows],
    )


def row(some: Sequence[Outcome], views: int) -> tuple[str, ...]:
    """The results after so many views, by ``COLUMNS``."""
    right = [outcome for outcome in some if outcome.right]
    placed = [outcome for outcome in right if outcome.place is not None]
    places = 1000 * np.array([o.place for o in placed], float)
    in_world = 1000 * np.array([o.place_in_world for o in placed], float)
    milliseconds = 1000 * np.array([o.seconds for o in some])
    wrong = np.mean([not o.right and o.confidence >= CONFIDENT for o in some])
    return (
        f"{views}",
        f"{np.mean([o.by_outline for o in some]):.3f}",
        f"{len(right) / len(some):.3f}",
        f"{calibration_error(some):.3f}",
        f"{wrong:.3f}",
        median_and_most([o.azimuth for o in right]),
        median_and_most([o.rotation for o in right]),
        f"{np.median(places):.1f}, {np.quantile(places, 0.95):.1f}",
        f"{np.median(in_world):.1f}",
        f"{np.mean([o.add_s is not None and o.add_s < 0.1 for o in right]):.3f}",
        f"{np.mean([bool(o.resting) for o in right]):.3f}",
        f"{np.median(milliseconds):.0f}, {milliseconds.max():.0f}",
    )


def median_and_most(errors: Sequence[float | None]) -> str:
    """Median and 95 % quantile of the errors that are known."""
    known = np.array([error for error in errors if error is not None])
    return (
        f"{np.median(known):.1f}, {np.quantile(known, 0.95):.1f}" if len(known) else "-"
    )


def unknown_table(
    outcomes: Sequence[Outcome],
    known: NDArray[np.int64],
    views: Sequence[int],
) -> str:
    """How many of the things that were not taught, and of those that were, are called unknown."""
    rows = []
    for k in views:
        some = [o for o in outcomes if o.views == k]
        strangers = [o for o in some if o.thing not in known]
        taught = [o for o in some if o.thing in known]
        refused = np.mean([unknown(o) for o in strangers])
        wrongly = np.mean([unknown(o) for o in taught])
        sure = np.mean(
            [not unknown(o) and o.confidence >= CONFIDENT for o in strangers]
        )
        rows.append((k, f"{refused:.3f}", f"{wrongly:.3f}", f"{sure:.3f}"))
    columns = (
        "views",
        "strangers unknown",
        "known unknown",
        "strangers named with confidence",
    )
    return markdown(columns, rows)


def unknown(outcome: Outcome) -> bool:
    """Whether a thing is called unknown."""
    return outcome.p_value < REJECTED


def main(
    scans: tyro.conf.Positional[Path],
    models: str = "ycb",
    draws: tuple[int, ...] = (0,),
    views: tuple[int, ...] = (1, 2, 3, 5),
    sensor: str = "wrist",
    every: int = 1,
    known: Literal["all", "even", "odd"] = "all",
    poses: Poses = "scanned",
    any_orientation: bool = False,
) -> None:
    """Show the things, recognise them, and print the tables.

    Args:
        scans: folder of the scans.
        models: memory of the things.
        draws: numbers of the draws; each is another azimuth, views and noise.
        views: after how many views things are judged.
        sensor: what the views are taken with.
        every: show every so many things only.
        known: which of the things are taught; all are shown.
        poses: show things as they were scanned, as they fall, or as people stand them up.
        any_orientation: show things that hang in a room, turned at random about all axes.
    """
    taught = Taught.load(models, scans)
    setting = Setting(sensor, max(views), poses, any_orientation)
    everything = np.arange(len(taught.names))
    some = {"all": everything, "even": everything[::2], "odd": everything[1::2]}[known]
    things = taught.things(some)

    outcomes: list[Outcome] = []
    for draw in draws:
        for thing in progress(everything[draw % every :: every], f"draw {draw}"):
            episode = shown(taught, int(thing), draw, setting)
            counts = [k for k in views if k <= len(episode.observations)]
            outcomes += [judged(things, taught, episode, k) for k in counts]
    if known == "all":
        print(table(outcomes, views, any_orientation))
    else:
        print(unknown_table(outcomes, some, views))


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
