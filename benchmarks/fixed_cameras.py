"""How exactly an error of a camera's pose is told from what two fixed cameras see.

Four YCB things stand on a table at random, anew at each moment. Two cameras of the simulated
``stereo`` sensor, 60 to 110 degrees apart, see them. The pose of the second one is exact, or has an
error of 4 mm and 0.6 degrees in a random direction.

    python -m benchmarks.fixed_cameras --seeds 100 120 --moments 4
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks.shared import progress
from nextview.geometry.mesh import Mesh
from nextview.sensing.camera_offsets import CameraOffset, camera_offsets
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS
from nextview.things.memory import taught_meshes
from nextview.types import Float
from nextview_lab.worlds.tables import SimulatedTable, TableCamera, poses_around

NAMES = ("cracker_box", "mug", "mustard_bottle", "tomato_soup_can", "power_drill")
THINGS = 4
MILLIMETRES = 4.0
DEGREES = 0.6


def main(seeds: tuple[int, int] = (100, 120), moments: int = 4) -> None:
    """Print what is told of exact poses, and of poses with an error.

    Args:
        seeds: first seed of the rigs, and the one after the last.
        moments: of each rig.
    """
    meshes = taught_meshes("ycb", NAMES)

    found = [told(meshes, seed, moments) for seed in progress(range(*seeds), "rigs")]
    exact, wrong = zip(*found, strict=True)
    off = np.array(
        [(one.millimetres - MILLIMETRES, one.degrees - DEGREES) for one in wrong]
    )
    worst = np.abs(off).max(0)
    within = (np.abs(off) < [1.0, 0.15]).all(1)
    print(f"{len(found)} rigs, {moments} moments each")
    print(f"exact poses: {sum(one.noticed for one in exact)} are reported")
    print(
        f"poses off by {MILLIMETRES:g} mm and {DEGREES:g} degrees:"
        f" {sum(one.noticed for one in wrong)} are reported,"
        f" {within.sum()} within 1 mm and 0.15 degrees; mean error"
        f" {np.abs(off[:, 0]).mean():.2f} mm and {np.abs(off[:, 1]).mean():.3f} degrees, largest"
        f" {worst[0]:.2f} mm and {worst[1]:.3f} degrees"
    )


def told(
    meshes: Sequence[Mesh],
    seed: int,
    moments: int,
) -> tuple[CameraOffset, CameraOffset]:
    """Return what is told of the second camera's exact pose, and of one with an error."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(0, 2 * np.pi)
    apart = np.radians(rng.uniform(60, 110))
    poses = [
        poses_around(
            np.array([at]),
            np.radians(rng.uniform(40, 60)),
            rng.uniform(0.6, 0.8),
            np.array([0, 0, 0.03]),
        )[0]
        for at in (azimuth, azimuth + apart)
    ]
    error = np.eye(4)
    turn = np.radians(DEGREES) * direction(rng)
    error[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    error[:3, 3] = MILLIMETRES / 1000 * direction(rng)
    stated = poses[1] @ np.linalg.inv(error)

    frames = []
    for _ in range(moments):
        some = [meshes[k] for k in rng.permutation(len(meshes))[:THINGS]]
        table = SimulatedTable.draw(some, rng, resting=lambda _: np.eye(3)[None])
        camera = TableCamera(table, SENSORS["stereo"], rng)
        frames.append([camera.frame(pose) for pose in poses])
    (exact,) = camera_offsets([named(pair, poses[1]) for pair in frames])
    (wrong,) = camera_offsets([named(pair, stated) for pair in frames])
    return exact, wrong


def named(pair: Sequence[Frame], stated: Float) -> list[Frame]:
    """Return the frames of two cameras with their names, and a stated pose of the second one."""
    left, right = pair
    return [
        replace(left, camera="left"),
        replace(right, camera="right", pose=stated),
    ]


def direction(rng: np.random.Generator) -> Float:
    """Return a random unit vector, (3,)."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


if __name__ == "__main__":
    tyro.cli(main)
