"""Single things on a table before several sensors at several distances.

    python -m nextview_lab.studies.distances YCB FRAMES
    nextview-lab real FRAMES/* --out distances.csv

Each folder FRAMES/SENSOR-DISTANCE has a frame of each thing as it may come to rest, seen from 40
degrees above, by each sensor from the same side at each distance, with its pixels and its pose.
"""

from pathlib import Path

import numpy as np
import tyro
from rich.progress import track

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console
from nextview.simulation.sensor import SENSORS
from nextview_lab.data.real_frames import Shot, Told, write_frames
from nextview_lab.studies.shared import mesh_of, scans_in
from nextview_lab.worlds.tables import SimulatedTable, TableCamera, poses_around

ELEVATION = np.radians(40.0)  # of the camera above the table


def main(
    scans: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    sensors: tuple[str, ...] = ("kinect", "stereo"),
    distances: tuple[float, ...] = (0.5, 0.8, 1.2),
    every: int = 3,
    seed: int = 0,
) -> None:
    """Write the frames.

    Args:
        scans: folder of the scans, in metres.
        out: folder to write into.
        sensors: names of simulated cameras.
        distances: of the camera from the middle of the thing, metres.
        every: each so manyth scan is shown.
        seed: of how things lie and from where they are seen, and of the noise.
    """
    shots: dict[tuple[str, float], dict[str, Shot]] = {}
    paths = [*scans_in(scans).values()][::every]
    for number, path in enumerate(track(paths, "things", console=console)):
        rng = np.random.default_rng([seed, number])
        table = SimulatedTable.draw([mesh_of(path)], rng, 0.0)
        placed = table.things[0].placed
        middle = (placed.min(0) + placed.max(0)) / 2

        azimuth = rng.uniform(0, 2 * np.pi, 1)
        for name in sensors:
            camera = TableCamera(table, SENSORS[name], rng)
            for distance in distances:
                (pose,) = poses_around(azimuth, ELEVATION, distance, middle)
                frame = camera.frame(pose)
                scan = np.linalg.inv(camera.true_pose) @ table.things[0].pose
                told = Told(name=path.stem, label=1, pose=scan.tolist())
                depth = np.rint(1000 * frame.depth).astype(np.uint16)
                own = (camera.owner == 0).astype(np.uint8)
                shots.setdefault((name, distance), {})[path.stem] = depth, own, [told]

    for (name, distance), frames in shots.items():
        matrix = SENSORS[name].intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        write_frames(out / f"{name}-{distance:g}", matrix, frames)


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
