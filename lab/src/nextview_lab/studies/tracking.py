"""Accuracy, losses and speed of the tracker on simulated trajectories of things in a gripper.

    python -m nextview_lab.studies.tracking SCANS OUT.jsonl [--trajectories 10] [--seed 0]

SCANS is a folder with scans of the things that the memory knows, in metres, by their names. Four of
them stand on a table, and a scene names them from three views. One whose pose it finds is then
followed: the camera stands still, 0.6 to 0.8 m away, and takes 640 x 480 pixels at 30 Hz through
the model of a stereo sensor for four seconds, while a gripper lifts the thing and moves it with up
to 0.2 m/s and 60 degrees/s. The gripper has the size of a Panda's, and leaves half of the thing
visible in the first frame; the tracker does not know it. For half a second a forearm hides the
thing.

Errors are those of the pose in the camera's frame: the distance of the middle of the scan from the
truth, and the angle of the rotation, or between the axes of a thing that is symmetric about one. A
frame is off if they exceed 20 mm or 15 degrees. Times are those of the processor.

OUT.jsonl gets a line for each trajectory.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from numpy.typing import NDArray
from rich.progress import track
from scipy.spatial.transform import Rotation

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console
from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles
from nextview.scene.objects import SceneObject
from nextview.scene.scene import Scene
from nextview.scene.tracker import Tracker
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS
from nextview.types import Float
from nextview_lab.studies.shared import mesh_of, scans_in
from nextview_lab.worlds.tables import (
    PlacedThing,
    SimulatedTable,
    TableCamera,
    poses_around,
    table_and_floor,
)

RATE = 30  # frames a second
SECONDS = 4.0
SPEED = 0.2  # metres a second, at most
TURN_SPEED = 60.0  # degrees a second, at most
LIFT = 0.12  # metres
THINGS = 4
MOST_TABLES = 30  # drawn until the pose of a thing is found
MOST_TRAJECTORIES = 8  # drawn for a thing
VISIBLE_AT_FIRST = 0.5  # share of the pixels of the thing
GAP = 0.10  # metres between neighbours, at most
NAMED_FROM = 3  # views
FINGER = (0.015, 0.02, 0.054)  # metres, along the opening, across and along the finger
HAND = (0.204, 0.063, 0.066)  # metres
DEEPEST_TIPS = 0.04  # metres below the top of a thing
HIDDEN_SECONDS = 0.5
HAND_FROM = 0.65  # share of the way from the camera to the thing
LOST_MILLIMETRES = 20.0
LOST_DEGREES = 15.0
CENTRE = np.array([0, 0, 0.08])
SENSOR = replace(SENSORS["stereo"], width=640, height=480)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A motion of one thing of a table, and what else moves.

    Attributes:
        table: at the start.
        row: of the thing that moves.
        camera: camera-to-world, (4, 4).
        poses: of the thing's file in the world at each frame, (F, 4, 4).
        gripper: triangles that move with the thing, at the start.
        hand: triangles of the forearm about its middle.
        hand_places: middle of the forearm at each frame, (F, 3).
    """

    table: SimulatedTable
    row: int
    camera: Float
    poses: Float
    gripper: tuple[Triangles, ...]
    hand: Triangles
    hand_places: Float

    @classmethod
    def draw(
        cls, table: SimulatedTable, row: int, rng: np.random.Generator
    ) -> Trajectory:
        """Draw the motion of a thing of a table."""
        thing = table.things[row]
        placed = thing.placed
        middle = (placed.min(0) + placed.max(0)) / 2
        azimuth = np.array([rng.uniform(0, 2 * np.pi)])
        camera = poses_around(
            azimuth, np.radians(rng.uniform(35, 55)), rng.uniform(0.6, 0.8), CENTRE
        )[0]

        times = np.arange(int(SECONDS * RATE)) / RATE
        begun = np.clip(times - 0.3, 0, None)
        waves = rng.uniform(0.25, 0.5, (2, 3))
        phases = rng.uniform(0, 2 * np.pi, (2, 3))
        size = rng.uniform(0.5, 1, (2, 3))

        # a wave that starts at rest
        ramp = begun**2 / (begun**2 + 0.3)
        angle = 2 * np.pi * waves[:, None] * begun[:, None] + phases[:, None]
        both = ramp[:, None] * size[:, None] * (np.sin(angle) - np.sin(phases)[:, None])

        shift, turn = both
        shift[:, 2] *= 0.3
        shift = _slowed(shift * 0.1, SPEED * 0.85, RATE)
        turn = _slowed(turn, np.radians(TURN_SPEED), RATE)
        shift[:, 2] += LIFT * begun**2 / (begun**2 + 1.0)
        shift = _slowed(shift, SPEED, RATE)

        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
        poses[:, :3, 3] = middle + shift - poses[:, :3, :3] @ middle

        sight = camera[:3, 3] + HAND_FROM * (middle + shift - camera[:3, 3])
        from_middle = (times - rng.uniform(1.5, 2.5)) / HIDDEN_SECONDS
        width = HAND_FROM * np.ptp(placed[:, :2], axis=0).max() + 0.09
        across = camera[:3, 0] * rng.choice([-1, 1])
        hand_places = sight + from_middle[:, None] * width * across
        return cls(
            table,
            row,
            camera,
            poses @ thing.pose,
            _gripper(placed),
            _forearm(camera),
            hand_places,
        )

    def cast(self, number: int) -> tuple[NDArray[np.float32], float]:
        """Take a frame without noise.

        Args:
            number: of the frame.

        Returns:
            Depth, (H, W), metres, 0 for holes, and the share of the thing's pixels that is visible.
        """
        pinhole = PinholeCamera.of(SENSOR.intrinsics, SENSOR.shape)
        rays = pinhole.rays.reshape(-1, 3) @ self.camera[:3, :3].T
        origin = self.camera[:3, 3]
        thing = self.table.things[self.row]
        pose = self.poses[number]
        since = pose @ np.linalg.inv(thing.pose)

        own = (thing.vertices @ pose[:3, :3].T + pose[:3, 3], thing.faces)
        moved = [
            (one @ since[:3, :3].T + since[:3, 3], faces) for one, faces in self.gripper
        ]
        hand = (self.hand[0] + self.hand_places[number], self.hand[1])
        others = [one for row, one in enumerate(self.table.things) if row != self.row]
        world = [*((one.placed, one.faces) for one in others), *table_and_floor()]

        alone, _ = RayCaster([own]).cast(origin, rays)
        depth, owner = RayCaster([own, *moved, hand, *world]).cast(origin, rays)

        clean = np.where(np.isfinite(depth), depth, 0).reshape(SENSOR.shape)
        share = np.count_nonzero(owner == 0) / max(1, np.isfinite(alone).sum())
        return clean.astype(np.float32), float(share)

    def frames(self, rng: np.random.Generator) -> Iterator[tuple[Frame, float]]:
        """Measure the frames, each with the share of the thing's pixels that is visible."""
        for number in range(len(self.poses)):
            clean, share = self.cast(number)
            measured, _ = SENSOR.measure(clean, rng.spawn(1)[0])
            frame = Frame(measured, SENSOR.intrinsics, self.camera, pixel_centre=0.5)
            yield frame, share


def _slowed(path: Float, speed: float, rate: int) -> Float:
    """Scale a path, (F, 3), so that its largest step is that of a speed."""
    fastest = np.linalg.norm(np.diff(path, axis=0), axis=1).max() * rate
    return path * min(1.0, speed / fastest)


def _gripper(placed: Float) -> tuple[Triangles, ...]:
    """Fingers and hand of the size of a Panda's, with the fingertips at a thing, in the world."""
    low, high = placed.min(0), placed.max(0)
    middle = (low + high) / 2
    side = int(np.argmin((high - low)[:2]))
    tips = max(middle[2], high[2] - DEEPEST_TIPS)
    parts = []
    for end, sign in ((low, -1), (high, 1)):
        place = middle.copy()
        place[side] = end[side] + sign * FINGER[0] / 2
        place[2] = tips + FINGER[2] / 2
        parts.append((FINGER, place))
    above = np.array([*middle[:2], tips + FINGER[2] + HAND[2] / 2])
    parts.append((HAND, above))

    boxes = []
    for size, place in parts:
        # sizes are given along the opening first
        turned = size if side == 0 else (size[1], size[0], size[2])
        boxes.append(
            trimesh.creation.box(
                turned, trimesh.transformations.translation_matrix(place)
            )
        )
    return tuple((np.asarray(box.vertices), np.asarray(box.faces)) for box in boxes)


def _forearm(camera: Float) -> Triangles:
    """A forearm with a hand about the origin, along the vertical of the image."""
    arm = trimesh.creation.cylinder(0.035, 0.3, sections=24)
    arm.apply_translation([0, 0, 0.2])
    hand = trimesh.creation.icosphere(3)
    hand.apply_scale([0.045, 0.03, 0.09])
    both = trimesh.util.concatenate([arm, hand])
    axes = np.column_stack([camera[:3, 0], camera[:3, 2], -camera[:3, 1]])
    return np.asarray(both.vertices) @ axes.T, np.asarray(both.faces)


def named(
    system: nextview.System, table: SimulatedTable, rng: np.random.Generator
) -> Scene:
    """Name the things of a table from three views."""
    camera = TableCamera(table, SENSOR, rng)
    scene = Scene(system)
    start = rng.uniform(0, 2 * np.pi)
    for step in range(NAMED_FROM):
        around = np.array([start + 2 * np.pi * step / NAMED_FROM])
        scene.update(
            camera.frame(poses_around(around, np.radians(45), 0.65, CENTRE)[0])
        )
    return scene


def errors(
    estimate: Float, truth: Float, vertices: Float, axis: Float | None
) -> tuple[float, float]:
    """Millimetres between the middles of a scan in two poses, and degrees between these.

    Args:
        estimate: pose of the scan, (4, 4), metres.
        truth: its true pose, (4, 4), metres.
        vertices: of the scan, (V, 3), metres.
        axis: about which any turn looks the same, (3,); None without one.
    """
    middle = (vertices.min(0) + vertices.max(0)) / 2
    apart = (estimate - truth)[:3, :3] @ middle + (estimate - truth)[:3, 3]
    if axis is None:
        turn = Rotation.from_matrix(estimate[:3, :3] @ truth[:3, :3].T).magnitude()
    else:
        cosine = abs(float((estimate[:3, :3] @ axis) @ (truth[:3, :3] @ axis)))
        turn = np.arccos(min(cosine, 1.0))
    return 1000 * float(np.linalg.norm(apart)), float(np.degrees(turn))


def axis_of(one: SceneObject) -> Float | None:
    """The axis about which an object looks the same after any turn, (3,); None without one."""
    axes = [np.asarray(each.axis) for each in one.symmetry or () if each.order == 0]
    return axes[0] if len(axes) == 1 else None


def _rightly_named(scene: Scene, thing: PlacedThing) -> SceneObject | None:
    """The object that is confidently named as a thing, in its pose; None if there is none."""
    for one in scene.objects:
        if one.name == thing.name and one.confident and one.pose is not None:
            off = errors(one.pose, thing.pose, thing.vertices, axis_of(one))
            if off[0] <= LOST_MILLIMETRES and off[1] <= LOST_DEGREES:
                return one
    return None


def _visible_trajectory(
    table: SimulatedTable, row: int, rng: np.random.Generator
) -> Trajectory | None:
    """Draw a trajectory in whose first frame half of the thing is visible; None if none is."""
    for _ in range(MOST_TRAJECTORIES):
        trajectory = Trajectory.draw(table, row, rng)
        if trajectory.cast(0)[1] >= VISIBLE_AT_FIRST:
            return trajectory
    return None


def _named_table(
    system: nextview.System,
    meshes: Sequence[Mesh],
    rng: np.random.Generator,
) -> tuple[Trajectory, Scene, SceneObject]:
    """Draw the trajectory of a thing on a table, the scene, and the object that is the thing.

    Raises:
        UsageError: none of MOST_TABLES tables has a visible thing whose pose is found.
    """
    for _ in range(MOST_TABLES):
        try:
            chosen = [meshes[k] for k in rng.choice(len(meshes), THINGS, replace=False)]
            table = SimulatedTable.draw(chosen, rng, GAP)
        except UsageError:
            continue

        scene = named(system, table, rng)
        row = int(rng.integers(THINGS))
        one = _rightly_named(scene, table.things[row])
        if one is None:
            continue

        trajectory = _visible_trajectory(table, row, rng)
        if trajectory is not None:
            return trajectory, scene, one
    raise UsageError(
        "on none of the tables a thing is visible in the gripper, and its pose found"
    )


def follow(
    system: nextview.System,
    meshes: Sequence[Mesh],
    seed: tuple[int, int],
) -> dict[str, Any]:
    """Track one thing along a trajectory.

    Args:
        system: that knows the things.
        meshes: of the things, metres.
        seed: of the table, the trajectory and the noise.

    Returns:
        Name and symmetry of the thing; of each frame the errors, the time and the visible share.
    """
    rng = np.random.default_rng(seed)
    trajectory, scene, one = _named_table(system, meshes, rng)
    table = trajectory.table
    thing = table.things[trajectory.row]
    axis = axis_of(one)

    tracker = Tracker(scene)
    steps = []
    for number, (frame, visible) in enumerate(trajectory.frames(rng)):
        began = time.process_time()
        every = tracker.update(frame, number / RATE)
        spent = time.process_time() - began

        mine = next(each for each in every if each.number == one.number)
        off = errors(mine.pose, trajectory.poses[number], thing.vertices, axis)

        still = [
            errors(each.pose, other.pose, other.vertices, None)[0]
            for each in every
            for other in table.things
            if each.name == other.name and other is not thing
        ]
        steps.append(
            {
                "mm": off[0],
                "degrees": off[1],
                "lost": bool(mine.lost),
                "name": mine.name_probability,
                "visible": visible,
                "seconds": spent,
                "things": len(every),
                "others_mm": max(still, default=0.0),
            }
        )
    return {"thing": thing.name, "symmetric": axis is not None, "steps": steps}


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """What the tracker kept, in words: a line for each trajectory, then for all."""
    said = [_of_trajectory(line["thing"], line["steps"]) for line in lines]
    every = [one for line in lines for one in line["steps"]]
    seen = [one for one in every if one["visible"] > 0.3]
    for unit in ("mm", "degrees"):
        values = [one[unit] for one in seen]
        middle, high = np.quantile(values, [0.5, 0.95])
        said.append(
            f"where a third is visible: {middle:.2f} {unit} (median), {high:.2f} (95 %)"
        )

    wrong = [one for one in every if _is_off(one) and one["visible"] > 0.3]
    said.append(
        f"off while visible: {len(wrong)} of {len(seen)} frames,"
        f" {sum(not one['lost'] for one in wrong)} of them not reported lost"
    )

    kept = [one for one in seen if not one["lost"]]
    said.append(
        f"name unlikely: {sum(one['name'] < 0.5 for one in kept)} of {len(kept)} frames"
        " that are not reported lost"
    )
    for unit in ("mm", "degrees"):
        share = np.mean([one[unit] <= 1 for one in kept])
        said.append(f"of those not reported lost: {100 * share:.0f} % within 1 {unit}")
    said.append(
        f"reported lost while on the thing:"
        f" {sum(one['lost'] and not _is_off(one) for one in every)}"
    )

    spent = np.array([one["seconds"] / one["things"] for one in every])
    said.append(
        f"{1000 * spent.mean():.1f} ms a thing and frame,"
        f" {1000 * np.quantile(spent, 0.99):.1f} at most (99 %)"
    )
    said.append(
        f"others off by {max(one['others_mm'] for one in every):.1f} mm at most"
    )
    return "\n".join(said)


def _of_trajectory(thing: str, steps: Sequence[dict[str, Any]]) -> str:
    """What the tracker kept of one thing, in words."""
    seen = [one for one in steps if one["visible"] > 0.3 and not one["lost"]]
    middle, high = (
        [np.quantile([one[unit] for one in seen], share) for unit in ("mm", "degrees")]
        for share in (0.5, 0.95)
    )
    return (
        f"{thing}: median {middle[0]:.1f} mm, {middle[1]:.1f} degrees;"
        f" 95 % {high[0]:.1f} mm, {high[1]:.1f} degrees;"
        f" {sum(map(_is_off, steps))} frames off,"
        f" {sum(one['lost'] for one in steps)} reported lost,"
        f" at the end {'off' if _is_off(steps[-1]) else 'on'} the thing"
    )


def _is_off(step: dict[str, Any]) -> bool:
    return bool(step["mm"] > LOST_MILLIMETRES or step["degrees"] > LOST_DEGREES)


def main(
    scans: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    trajectories: int = 10,
    seed: int = 0,
    models: str = "ycb",
) -> None:
    """Track things in a gripper.

    Args:
        scans: folder of the scans.
        out: file of JSON lines to write.
        trajectories: number.
        seed: of all draws.
        models: memory that knows the scans by their names.
    """
    system = nextview.load(models)
    paths = [path for name, path in scans_in(scans).items() if name in system.classes]
    if len(paths) < THINGS:
        raise UsageError(
            f"{scans}: fewer than {THINGS} scans have names of known things"
        )

    meshes = [mesh_of(path) for path in paths]
    lines = []
    with out.open("x") as file:
        every = range(trajectories)
        for number in track(every, "trajectories", console=console):
            lines.append(follow(system, meshes, (seed, number)))
            file.write(f"{json.dumps(lines[-1])}\n")
            file.flush()
    print(summary(lines))


if __name__ == "__main__":
    with orderly_end("the trajectories that were done are kept"):
        tyro.cli(main)
