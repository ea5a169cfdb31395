"""A Panda empties a bin of machine parts: look, choose a part, grasp it, drop it into a box.

pip install './lab[arm]'
python examples/bin_picking.py [--parts 12] [--seed 0]

Parts of five generated kinds (``bin_parts.py``) are taught and poured into a bin (``bin_cell.py``).
The camera on the wrist looks from above, and from elsewhere while no grasp is free; what is held is
held by friction. Printed is each pick, and at the end how many parts are out, how many had another
name than was said, and how many views and seconds a pick took.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro
from bin_parts import bin_parts, write_parts

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.errors import MissingExtraError, NextviewError
from nextview.geometry.viewsphere import look_at_origin
from nextview.scene.grasps import FreeGrasp, Grasp, propose_grasps
from nextview.sensing.object_frame import Box

if TYPE_CHECKING:
    from bin_cell import Cell

NEEDED = ("mujoco", "mink", "gymnasium_robotics")
ACCURACY = (
    1.0,
    0.1,
)  # of the camera poses, millimetres and degrees: see bin_cell.SENSOR
GRASPS = 800  # of each part: it may lie in any way, and others around it
# significance of the test for strangers, about the lowest: only the bin itself is in view
FEW_STRANGERS = 0.01
DISTANCE = 0.48  # metres from the middle of the bin to the camera
FIRST_ELEVATION = np.radians(75)
# from lower, the nearest wall hides more than a quarter of the bottom
LOWEST_ELEVATION = np.radians(50)
MOST_LOOKS = 4  # views of one state of the bin
MOST_FAILURES = 3  # grasps in a row that hold nothing, after which the arm gives up
SAME_PLACE = (
    0.02  # metres from a grasp that held nothing within which none is tried again
)
BEFORE_GRASP = 0.10  # metres of the straight way to a grasp
LIFT = np.array([0, 0, 0.20])  # metres
OVER_BOX = 0.26  # metres above the table at which the fingers open
HELD = 0.5  # of the width of a grasp: closer fingers hold nothing
ROOM_ABOVE = 0.15  # metres above the bin that are looked at


@dataclass(frozen=True)
class Pick:
    """One grasp and what came of it.

    Attributes:
        said: name that was recognised.
        true: names of the parts that are out of the bin since then.
        views: frames that were taken for it.
        seconds: simulated time from the first of them to the end.
        thinking: CPU time for recognition and choice, seconds.
    """

    said: str
    true: tuple[str, ...]
    views: int
    seconds: float
    thinking: float


@dataclass(frozen=True)
class Motion:
    """Joints of the arm, (7,) each, on its ways to a grasp and from it.

    Attributes:
        there: from where the arm is to the begin of the straight way.
        down: to the grasp.
        up: with the part.
        over: to the box.
    """

    there: list[np.ndarray]
    down: list[np.ndarray]
    up: list[np.ndarray]
    over: list[np.ndarray]


def teach(folder: Path) -> tuple[nextview.System, dict[str, tuple[Grasp, ...]]]:
    """Learn the parts and where to grasp them.

    Args:
        folder: in which the meshes and the memory are written.
    """
    from bin_cell import GRIPPER

    scans = folder / "parts"
    write_parts(scans)
    nextview.learn(scans, folder / "taught", unit="mm", workers=0)
    grasps = {
        path.stem: propose_grasps(nextview.load_mesh(path, unit="mm"), GRIPPER, GRASPS)
        for path in sorted(scans.iterdir())
    }
    system = nextview.load(
        folder / "taught",
        camera_accuracy=ACCURACY,
        unknown=FEW_STRANGERS,
        max_views=MOST_LOOKS,
    )
    return system, grasps


class Picker:
    """The program of the robot.

    Args:
        cell: the robot, the bin and the box.
        system: that knows the parts.
        grasps: of each part, by its name.
    """

    def __init__(
        self,
        cell: Cell,
        system: nextview.System,
        grasps: Mapping[str, Sequence[Grasp]],
    ) -> None:
        from bin_cell import BIN, BIN_INSIDE

        self.cell = cell
        self.system = system
        self.grasps = grasps
        half = np.array([*BIN_INSIDE[:2] / 2, 0])
        middle = np.array([*BIN, 0.0])
        top = np.array([0, 0, ROOM_ABOVE])
        self.region = Box(middle - half - [0, 0, 0.01], middle + half + top)
        self.middle = np.add(middle, [0, 0, 0.03])
        self.first_pose = look_at_origin(FIRST_ELEVATION, np.pi, DISTANCE)
        self.first_pose[:3, 3] += self.middle
        self.thinking = 0.0
        self.looks = 0
        self.begin = cell.seconds
        self.picks: list[Pick] = []
        self.in_vain: list[np.ndarray] = []
        self._motions: dict[bytes, Motion] = {}

    def run(self) -> None:
        """Pick until the bin is empty, or nothing more can be done."""
        while len(self.in_vain) < MOST_FAILURES:
            begin = self.cell.seconds
            thought = self.thinking
            inside = set(self.still_inside)
            scene, grasp = self.choose()
            if grasp is None:
                return
            self.execute(grasp)
            out = sorted(inside - set(self.still_inside))
            pick = Pick(
                grasp.name,
                tuple(self.cell.names[row] for row in out),
                len(scene.frames),
                self.cell.seconds - begin,
                self.thinking - thought,
            )
            self.picks.append(pick)
            self.in_vain = [] if out else [*self.in_vain, grasp.pose[:3, 3]]
            print(f"{len(self.picks)}: {pick}", flush=True)

    @property
    def still_inside(self) -> list[int]:
        """Parts that are truly in the bin, by row; only to keep count."""
        from bin_cell import BIN, BIN_INSIDE

        return self.cell.inside(BIN, BIN_INSIDE)

    def choose(self) -> tuple[nextview.Scene, FreeGrasp | None]:
        """Look until a grasp is free."""
        from bin_cell import GRIPPER

        scene = nextview.Scene(
            self.system,
            region=self.region,
            distance=DISTANCE,
            reachable=self.can_see_from,
        )
        pose: np.ndarray | None = self.first_pose
        while pose is not None:
            self.move_camera(pose)
            frame = self.cell.look()
            self.looks += 1
            begin = time.process_time()
            scene.update(frame)
            self._motions.clear()
            free = scene.grasps(self.grasps, GRIPPER, self.can_grasp, most=1)
            self.thinking += time.process_time() - begin
            if free:
                return scene, free[0]
            if len(scene.frames) >= MOST_LOOKS or (scene.done and not scene.objects):
                break
            begin = time.process_time()
            pose = scene.target
            self.thinking += time.process_time() - begin
        return scene, None

    def can_see_from(self, pose: np.ndarray) -> bool:
        """Whether the camera sees over the walls from a pose, (4, 4), and can be brought there."""
        away = pose[:3, 3] - self.middle
        if away[2] < np.sin(LOWEST_ELEVATION) * np.linalg.norm(away):
            return False
        planner = self.cell.planner
        joints = planner.joints_for(pose, "camera", self.cell.joints)
        return joints is not None and planner.way(self.cell.joints, joints) is not None

    def move_camera(self, pose: np.ndarray) -> None:
        """Bring the camera to a pose, (4, 4)."""
        planner = self.cell.planner
        joints = planner.joints_for(pose, "camera", self.cell.joints)
        way = None if joints is None else planner.way(self.cell.joints, joints)
        if way is None:
            raise NextviewError(
                "the camera cannot be brought where it has to look from"
            )
        self.cell.follow(way)

    def can_grasp(self, pose: np.ndarray) -> bool:
        """Whether the arm can grasp at a pose of the gripper, (4, 4), and bring the part away.

        Where a grasp has just held nothing it is not tried again.
        """
        if any(np.linalg.norm(pose[:3, 3] - one) < SAME_PLACE for one in self.in_vain):
            return False
        motion = self.plan(pose)
        if motion is not None:
            self._motions[pose.tobytes()] = motion
        return motion is not None

    def plan(self, pose: np.ndarray) -> Motion | None:
        """Plan the ways to a grasp and from it; None if one is blocked or out of reach."""
        from bin_cell import BOX

        planner = self.cell.planner
        before = pose.copy()
        before[:3, 3] -= BEFORE_GRASP * pose[:3, 2]
        start = planner.joints_for(before, "grip", self.cell.joints)
        if start is None:
            return None
        down = planner.line(start, BEFORE_GRASP * pose[:3, 2])
        if down is None:
            return None
        up = planner.line(down[-1], LIFT)
        if up is None:
            return None
        there = planner.way(self.cell.joints, start)
        if there is None:
            return None
        drop = np.diag([1.0, -1.0, -1.0, 1.0])
        drop[:3, 3] = [*BOX, OVER_BOX]
        end = planner.joints_for(drop, "grip", up[-1])
        over = None if end is None else planner.way(up[-1], end)
        return None if over is None else Motion(there, down, up, over)

    def execute(self, grasp: FreeGrasp) -> None:
        """Grasp, and drop what is held into the box."""
        cell = self.cell
        motion = self._motions[grasp.pose.tobytes()]
        cell.open(grasp.opening)
        cell.follow(motion.there)
        cell.follow(motion.down, 0.15)
        cell.close()
        cell.wait(0.6)
        cell.follow(motion.up, 0.15)
        if cell.opening < HELD * grasp.width:  # nothing is held
            cell.open()
            return
        cell.follow(motion.over)
        cell.open()
        cell.wait(0.5)


def table(picker: Picker, poured: int) -> str:
    """Results as a Markdown table.

    Views and seconds are those of all looks and grasps, in vain or not, for each grasp that
    brought a part out. Seconds of motion are simulated time, those of thought CPU time.
    """
    done = [pick for pick in picker.picks if pick.true]
    wrong = sum(pick.said not in pick.true for pick in done)
    along = sum(len(pick.true) > 1 for pick in done)
    out = poured - len(picker.still_inside)
    count = max(len(done), 1)
    views = picker.looks / count
    seconds = (picker.cell.seconds - picker.begin) / count
    thinking = picker.thinking / count
    return "\n".join(
        [
            "| parts out | wrong | two at once | grasps | views | s of motion | s of thought |",
            "|---|---|---|---|---|---|---|",
            f"| {out} of {poured} | {wrong} | {along} | {len(picker.picks)} | {views:.2f} |"
            f" {seconds:.1f} | {thinking:.1f} |",
        ]
    )


def main(
    parts: int = 12,
    seed: int = 0,
) -> None:
    """Empty a bin.

    Args:
        parts: number of parts in the bin.
        seed: of their kinds and places, and of all errors.
    """
    for package in NEEDED:
        if find_spec(package) is None:
            raise MissingExtraError(
                f"{sys.argv[0]} needs the package {package}: pip install './lab[arm]'"
            )
    from bin_cell import Cell

    with tempfile.TemporaryDirectory() as folder:
        system, grasps = teach(Path(folder))
    rng = np.random.default_rng(seed)
    known = bin_parts()
    poured = [str(name) for name in rng.choice(sorted(known), parts)]
    cell = Cell(known, poured, rng)
    picker = Picker(cell, system, grasps)
    poured_in = len(picker.still_inside)
    picker.run()
    print(table(picker, poured_in))


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
