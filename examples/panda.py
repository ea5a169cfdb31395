"""A simulated Panda looks at an object on a table until it is sure, and moves only as an arm can.

pip install './research[arm]'
python examples/panda.py samples/chair.off [--seed 0] [--film episode.gif]
"""

from pathlib import Path

import numpy as np
import tyro
from panda_film import Film

import nextview
from nextview.sensing import ObservedObject
from research.arm import Arm, first_joints


def recognise(arm: Arm, looked=lambda session: None, threshold: float = 0.97) -> nextview.Recognition:
    """What a user writes; ``arm.run`` is the loop of ``arm_over_table.py``."""
    session = nextview.load(threshold=threshold).session(object=ObservedObject(life_size=False), distance=0.4)
    return arm.run(session, lambda: looked(session))


def main(
    mesh: tyro.conf.Positional[Path],
    seed: int = 0,
    threshold: float = 0.97,
    azimuth: float = 215.0,
    film: Path | None = None,
) -> None:
    arm = Arm(nextview.load_mesh(mesh), np.random.default_rng(seed))
    start = first_joints(arm, np.radians(35), np.radians(azimuth), 0.4)
    if start is None:
        raise SystemExit("the arm cannot look from there")
    arm.joints = start
    shown = Film(arm, film)
    result = recognise(arm, shown.looked, threshold)
    print(f"{result}; {arm.seconds:.2f} s of motion")
    shown.save()


if __name__ == "__main__":
    tyro.cli(main)
