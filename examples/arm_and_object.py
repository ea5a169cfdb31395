"""What stands on the table? An arm with a depth camera on its wrist looks until it is sure.

    python examples/arm_and_object.py samples/chair.off [--seed 0]

Arm, camera and table are simulated; the object is made 24 cm across and put somewhere on the table.
Replace ``Arm`` by yours: all that the session needs is ``look``, ``can_reach``, ``seconds`` and
``go_to``.
"""

from pathlib import Path

import numpy as np
import tyro
from simulated_sensor import INTRINSICS, look, square

import nextview
from nextview.geometry.viewsphere import look_at_origin
from nextview.sensing import Frame, ObservedObject

BASE = np.array([-0.55, 0.0, 0.0])
REACH = 1.1
CLEARANCE = 0.08
"""Where the arm stands, how far it reaches, and how near to the table it goes; metres."""


class Arm:
    """A simulated arm with a camera on its wrist."""

    def __init__(self, mesh, rng):
        turn = rng.uniform(0, 2 * np.pi)
        where = rng.uniform(-0.1, 0.1, 2)
        c = np.cos(turn)
        s = np.sin(turn)
        vertices = 0.12 * mesh.vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
        vertices += [*where, -vertices[:, 2].min()]
        self.things = [(vertices, mesh.faces), square(0.8), square(4.0, -0.75)]
        self.rng = rng
        # home: it looks at the middle of the table
        self.pose = look_at_origin(np.radians(35), np.radians(160), 0.6)
        self.refused = 0

    def look(self):
        return look(self.things, self.pose, self.rng), self.pose

    def can_reach(self, pose):
        return np.linalg.norm(pose[:3, 3] - BASE) < REACH and pose[2, 3] > CLEARANCE

    def seconds(self, here, there):
        return 1.0 + 2.0 * np.linalg.norm(there[:3, 3] - here[:3, 3])

    def go_to(self, target):
        """It misses by some millimetres; and one way in five it finds blocked."""
        if self.rng.random() < 0.2:
            self.refused += 1
            return False
        self.pose = target.copy()
        self.pose[:3, 3] += self.rng.normal(0, 0.004, 3)
        return True


def recognise(arm: Arm) -> nextview.Recognition:
    """What a user writes."""
    session = nextview.load(threshold=0.99).session(
        object=ObservedObject(life_size=False, alone=True),
        distance=0.6,
    )
    session.reachable = arm.can_reach
    session.travel_cost = arm.seconds
    depth, pose = arm.look()
    session.update(Frame(depth, INTRINSICS, pose))
    while not session.done:
        if arm.go_to(session.target):
            depth, pose = arm.look()
            session.update(Frame(depth, INTRINSICS, pose))
        else:
            session.failed()
    return session.result


def main(
    mesh: tyro.conf.Positional[Path],
    seed: int = 0,
    figure: Path | None = None,
) -> None:
    result = recognise(Arm(nextview.load_mesh(mesh), np.random.default_rng(seed)))
    print(result)
    if figure:
        result.plot(figure)


if __name__ == "__main__":
    tyro.cli(main)
