"""A simulated Panda looks at an object on a table until it is sure, and moves only as an arm can.

pip install './research[arm]'
python examples/panda.py samples/chair.off [--seed 0] [--film episode.gif]
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.errors import MissingExtraError
from nextview.sensing import ObservedObject

if TYPE_CHECKING:
    from research.arm import Arm

NEEDED = ("research", "mujoco", "mink", "gymnasium_robotics")


def recognise(
    arm: Arm, looked=lambda session: None, threshold: float = 0.97
) -> nextview.Recognition:
    """What a user writes; ``arm.run`` is the loop of ``arm_and_object.py``."""
    session = nextview.load(threshold=threshold).session(
        object=ObservedObject(life_size=False),
        distance=0.4,
    )
    return arm.run(session, lambda: looked(session))


def main(
    mesh: tyro.conf.Positional[Path],
    seed: int = 0,
    threshold: float = 0.97,
    azimuth: float = 215.0,
    film: Path | None = None,
) -> None:
    for package in NEEDED:
        if find_spec(package) is None:
            raise MissingExtraError(
                f"{sys.argv[0]} needs the package {package}: pip install './research[arm]'"
            )
    from films import ArmFilm

    from research.arm import Arm, first_joints, put_down

    rng = np.random.default_rng(seed)
    arm = Arm([put_down(nextview.load_mesh(mesh), rng)], rng)
    start = first_joints(arm, np.radians(35), np.radians(azimuth), 0.4)
    if start is None:
        raise SystemExit("the arm cannot look from there")
    arm.joints = start
    shown = ArmFilm(arm, film)
    result = recognise(arm, shown.looked, threshold)
    print(f"{result}; {arm.seconds:.2f} s of motion")
    shown.save()


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
