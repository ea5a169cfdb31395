"""A grasp point that was written down in the frame of a scan arrives in the robot's world.

    python examples/grasp_point.py

A mug and a carton are taught from their scans, which needs ``pip install 'nextview[teach]'``. The
mug then stands somewhere on a table, seen by a noisy depth camera, which is simulated here: on a
robot, ``look`` gives its frames.
"""

import tempfile
from pathlib import Path

import numpy as np
import trimesh
import tyro
from scipy.spatial.transform import Rotation

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import look_at_origin
from nextview.sensing import Frame

INTRINSICS = np.array([[520.0, 0, 320], [0, 520, 240], [0, 0, 1]])
SHAPE = 480, 640
NOISE = 0.001  # metres at a distance of one metre; it grows with the square
HANDLE = np.array([0.084, 0.0, 0.05])  # where to grasp, in the frame of mug.ply, metres


def mug() -> trimesh.Trimesh:
    """A mug whose scan has its origin in the middle of the bottom and the handle along x."""
    wall = trimesh.creation.annulus(0.036, 0.04, 0.1).apply_translation((0, 0, 0.05))
    bottom = trimesh.creation.cylinder(0.04, 0.006).apply_translation((0, 0, 0.003))
    handle = trimesh.creation.torus(0.03, 0.006)
    handle.apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    )
    handle.apply_translation((0.055, 0, 0.05))
    return trimesh.util.concatenate([wall, bottom, handle])


def teach(folder: Path) -> nextview.System:
    """A system that knows the mug and a carton."""
    scans = folder / "scans"
    scans.mkdir()
    mug().export(scans / "mug.ply")
    trimesh.creation.box((0.1, 0.06, 0.16)).export(scans / "carton.ply")
    nextview.learn(scans, folder / "mine", unit="m", upright=True, workers=0)
    return nextview.load(models=folder / "mine")


class Robot:
    """A depth camera over a table on which the mug stands, in a pose that only the simulation
    knows.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.true = np.eye(4)
        self.true[:3, :3] = Rotation.from_rotvec(
            [0, 0, rng.uniform(0, 2 * np.pi)]
        ).as_matrix()
        self.true[:3, 3] = *rng.uniform(-0.3, 0.3, 2), 0.0
        things = [
            mug().apply_transform(self.true),
            trimesh.creation.box((1.5, 1.5, 0.04)),
        ]
        things[1].apply_translation((0, 0, -0.02))
        self.caster = RayCaster(
            [(thing.vertices, thing.faces.astype(np.int32)) for thing in things]
        )

    def first_pose(self) -> np.ndarray:
        """Where the camera stands before it is told where to go: it sees the mug."""
        pose = look_at_origin(np.radians(35), np.radians(60), 0.5)
        pose[:3, 3] += self.true[:3, 3]
        return pose

    def look(self, pose: np.ndarray) -> Frame:
        """What the camera sees from a pose in the world, (4, 4), OpenCV axes, metres."""
        rays = PinholeCamera.of(INTRINSICS, SHAPE).rays.reshape(-1, 3) @ pose[:3, :3].T
        depth, _ = self.caster.cast(pose[:3, 3], rays.astype(np.float32))
        depth = np.where(np.isfinite(depth), depth, 0).reshape(SHAPE)
        depth += NOISE * depth**2 * self.rng.normal(size=SHAPE)
        return Frame(depth.astype(np.float32), INTRINSICS, pose, pixel_centre=0.5)


def recognise(system: nextview.System, robot: Robot) -> nextview.Recognition:
    """Look until it is clear what stands there, and where."""
    session = system.session(goal="pose", distance=0.5)
    session.update(robot.look(robot.first_pose()))
    while not session.done:
        session.update(robot.look(session.target))
    return session.result


def in_world(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point of a scan, (3,), metres, where its pose, (4, 4), puts it."""
    return pose[:3, :3] @ point + pose[:3, 3]


def main() -> None:
    """Teach, look, and say where the handle is."""
    with tempfile.TemporaryDirectory() as folder:
        system = teach(Path(folder))
        robot = Robot(np.random.default_rng(2))
        result = recognise(system, robot)
        print(result)

        grasp = in_world(result.pose, HANDLE)
        off = 1000 * np.linalg.norm(grasp - in_world(robot.true, HANDLE))
        print(f"grasp at {grasp.round(4)}, {off:.1f} mm from where the handle is")


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
