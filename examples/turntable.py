"""What stands on the turntable? The camera stands still, the plate turns until it is clear.

    python examples/turntable.py samples/monitor.off [--seed 0]

Camera and turntable are simulated. The world is the plate's: when it turns by an angle, the camera
goes round the object by the same angle the other way. What was not there when the plate was empty
is the object.
"""

from pathlib import Path

import numpy as np
import tyro
from simulated_sensor import INTRINSICS, disc, look

import nextview
from nextview.geometry.viewsphere import look_at_origin
from nextview.sensing import Frame, ObservedObject

ELEVATION = 30.0
DISTANCE = 0.7
SPEED = 45.0
"""Of the camera, degrees over the plate and metres from its middle; and of the plate, degrees a
second.
"""


class Turntable:
    """A simulated plate with a camera beside it."""

    def __init__(self, mesh, rng):
        vertices = 0.12 * mesh.vertices
        vertices += [*rng.uniform(-0.02, 0.02, 2), -vertices[:, 2].min()]
        self.thing = (vertices, mesh.faces)
        self.rng = rng
        self.angle = rng.uniform(0, 360)

    def look(self, empty=False):
        """Depth, and where the camera is, seen from the plate."""
        pose = look_at_origin(np.radians(ELEVATION), np.radians(-self.angle), DISTANCE)
        pose[2, 3] += 0.08  # it aims a little over the plate
        return look(
            [disc(0.25), disc(9.0, -0.1), *([] if empty else [self.thing])],
            pose,
            self.rng,
        ), pose

    def turn_to(self, angle):
        self.angle = angle


def azimuth(pose):
    return np.degrees(np.arctan2(pose[1, 3], pose[0, 3]))


def seconds(here, there):
    return abs((azimuth(there) - azimuth(here) + 180) % 360 - 180) / SPEED


def recognise(turntable: Turntable) -> nextview.Recognition:
    """What a user writes."""
    # fills the holes of each other
    empty = np.fmax(turntable.look(empty=True)[0], turntable.look(empty=True)[0])
    thing = ObservedObject(support=False, life_size=False)
    session = nextview.load(viewpoints=f"rings:{ELEVATION}x24", threshold=0.99).session(
        object=thing,
        distance=DISTANCE,
    )
    session.travel_cost = seconds
    while not session.done:
        depth, pose = turntable.look()
        mask = np.nan_to_num(depth, nan=9.0) < np.nan_to_num(empty, nan=0.0) - 0.01
        session.update(Frame(depth, INTRINSICS, pose, mask))
        if not session.done:
            turntable.turn_to(-azimuth(session.target))
    return session.result


def main(
    mesh: tyro.conf.Positional[Path],
    seed: int = 0,
    figure: Path | None = None,
) -> None:
    result = recognise(Turntable(nextview.load_mesh(mesh), np.random.default_rng(seed)))
    print(result)
    if figure:
        result.plot(figure)


if __name__ == "__main__":
    tyro.cli(main)
