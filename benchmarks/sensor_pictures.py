"""Draw what each sensor makes of one view of a mesh.

    python benchmarks/sensor_pictures.py samples/chair.off docs/images/sensors.png [--view 17]

Above the depth that the sensor gives, below what the networks get, as it is and denoised.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure

from nextview import ViewSphere, load_mesh
from nextview.cameras.sensors import SensedCamera
from nextview.report.style import STYLE

SENSORS = ("none", "kinect", "stereo", "setup", "wrist", "kinect:2")


def main(mesh: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], view: int = 17, seed: int = 0) -> None:
    """Draw them."""
    thing, pose = load_mesh(mesh), ViewSphere.named("40").poses[view]
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure((1.5 * len(SENSORS), 4.4))
        axes = figure.subplots(3, len(SENSORS), gridspec_kw={"wspace": 0.03, "hspace": 0.03})
        for column, name in zip(axes.T, SENSORS, strict=True):
            camera = SensedCamera(thing, name, np.random.default_rng(seed))
            sensor = camera.sensor
            frame = camera.frame(pose)
            assert frame is not None, f"{name} sees nothing"
            half = int(1.2 * sensor.focal * sensor.radius / sensor.distance)
            middle = sensor.height // 2, sensor.width // 2
            around = tuple(slice(m - half, m + half) for m in middle)
            depth = np.where(frame.depth > 0, frame.depth, np.nan)[around]
            near, far = (sensor.distance + sign * sensor.radius for sign in (-1, 1))
            column[0].imshow(depth, cmap="viridis_r", vmin=near, vmax=far, interpolation="nearest")
            column[0].set_title(name, fontsize=9)
            for axis, denoise in zip(column[1:], (False, True), strict=True):
                again = SensedCamera(thing, name, np.random.default_rng(seed), denoise)  # draws the same
                axis.imshow(again.observe(pose).picture, cmap="gray", vmin=0, vmax=255)
        for axis, label in zip(axes[:, 0], ("depth", "as it is", "denoised"), strict=True):
            axis.set_ylabel(label)
        for axis in axes.flat:
            axis.set(xticks=[], yticks=[])
        figure.savefig(out, dpi=78, facecolor="white", bbox_inches="tight", pad_inches=0.05)


if __name__ == "__main__":
    tyro.cli(main)
