"""Run every command that the pages show, on small inputs made here: a command that no machine runs
is wrong some day.

    python workflow/documented_commands.py [PAGE ...] [--only-list]

Takes README.md, docs/*.md, research/README.md and what stands above the code of examples/*.py apart
into commands and Python blocks, and runs them page by page, in the order of the page, each page in
a folder of its own with what its commands need: a few box meshes under the names of ModelNet10, a
store of their views and predictions. ``SMALL`` makes a command quick; ``NOT_RUN`` says what is not
run, and why. What fails is printed with the end of its output, and the exit status is 1.

Each command runs where nothing is installed but what a reader of the page has: the base
installation, and the extras that ``NEEDS`` names for it, which the page has to name, too. Such an
environment is linked from that of this script.
"""

from __future__ import annotations

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np
import trimesh
import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

PAGES = (
    "README.md",
    *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")),
    "research/README.md",
    *sorted(f"examples/{path.name}" for path in (ROOT / "examples").glob("*.py")),
)
PROGRAMS = (
    "nextview ",
    "python",
    "make ",
    "pip ",
    "rerun ",
    "dask ",
    "ros2 ",
    "rosdep ",
    "colcon ",
    "for ",
    "cp -r ros2",
)
LIMIT = 900  # seconds for one command

NOT_RUN = {  # commands by how they begin, or what is in them; the reason
    r"^nextview look ": "needs frames of a table: tests/test_scene.py makes some and runs it",
    r"lmo": "needs a dataset of BOP: tests/test_bop.py writes one and runs it",
    r"examples/arm_over_table": (
        "needs the YCB scans; research/tests/test_arm_over_table.py has files of a few"
    ),
    r"benchmarks\.(real_frames|segmentation)": "needs real frames, which are not part of this",
    r"^nextview benchmark tables|benchmarks\.moves": (
        "needs scans of all things that the bundled memory knows"
    ),
    r"^make ": "the workflow is run by tests/test_workflow.py",
    r"^(pip|python3 -m pip) ": "installs; tests/test_wheel.py installs the wheel with each extra",
    r"^nextview download": (
        "473 MB from a server of others; tests/test_download.py has a server of its own"
    ),
    r"^nextview explore": (
        "serves until it is stopped; tests/test_explore_page.py clicks through the page"
    ),
    r"pyrealsense2|shot_0": (
        "needs a camera; tests/test_pages.py runs the script with a stand-in and looks at its shots"
    ),
    r"^rerun ": "opens a window",
    r"^dask ": "serves until it is stopped; tests/test_render.py has a cluster of its own",
    r"--scheduler": "needs the scheduler of the line before",
    r"^(ros2|rosdep|colcon|cp -r ros2|cd |source |python3.11 ros2|export AMENT_PREFIX)": (
        "needs ROS 2; make test-ros runs the node, and the first steps of its page"
    ),
    r"my_rig": (
        "needs frames of several cameras; tests/test_several_cameras.py writes such and checks them"
    ),
    r"my_(recordings?|folder)": (
        "needs a recording of the reader's; tests/test_recordings.py writes such and reads them"
    ),
    r"-m zipfile|efficientnet|resnet34-b627a593": "weights of others, which are fetched first",
    r"research\.(film|point_pairs)|verified_things|made_things stretched": (
        "needs the YCB scans, and minutes"
    ),
    r"benchmarks\.(frozen|poses_alone)|nextview-bench": (
        "needs the YCB scans, and hours; tests/test_submit.py runs methods on a small archive"
    ),
    r"benchmarks\.places": "needs the YCB scans, and an hour; tests/test_places.py shows a thing",
    r"look_alikes|benchmark things (YCB|HALF_SCANS)|joined_things": (
        "needs the YCB scans, and minutes"
    ),
    r"peers/monty\.py|peers\.beside_monty": "needs an environment of its own, and an hour",
    r"research\.(train_grid|thing_features)": "trains for hours",
    r"research\.simulated_arm": "takes an hour; research/tests/test_arm.py has episodes of it",
    r"benchmarks\.(render|replay|latency)": "measures time, on a quiet machine",
    r"research/tests": "they are in make test",
    r"benchmarks\.scenes judge": (
        "needs 200 scenes of each level; tests/test_scene_policies.py judges few"
    ),
    r"SceneLayout\.load": (
        "names one of the drawn scenes; tests/test_scenes.py looks into one of its own"
    ),
    r"nextview scenes YCB ": "needs the YCB scans; tests/test_room_scenes.py draws tables",
    r"RoomLayout\.load": "names one of the drawn rooms; tests/test_room_scenes.py looks into some",
    r"agent_on_things": (
        "needs things that were taught; tests/test_thing_environment.py lets it learn"
    ),
    r"nextview_ros": "takes messages of ROS 2; tests/test_ros2.py has recorded ones",
    r"--ensemble runs/second": "needs the run of the line before",
    r"agents/(ppo|mvselect)\.json .*agents/": "needs two agents of a million steps each",
}
NEEDS = {  # what a command or a Python block needs besides the base installation, by what is in it
    r"nextview (train|export) ": "nextview[train]",
    r"nextview (benchmark|evaluate|report) ": "nextview[benchmark]",
    r"benchmarks\.views|research\.(measure_study|example_maps)": (
        "nextview[benchmark]"
    ),
    r"--record|viewers\.(scene_)?recording": "nextview[record]",
    r"--explorer|viewers\.scene_page": "nextview[explore]",
    r"(?<![.:])\b(volumetric|coverage)\b": "research",  # by their short names
    r"research\.train_agent": "research[rl]",
    r"research\.arm|examples/(panda|bin_picking)": "research[arm]",
}
SMALL = {  # options that make a command quick
    "nextview render": "--workers 1",
    "nextview predict": "--workers 1 --overwrite",
    "nextview measure": "--workers 1",
    "nextview learn": "--workers 1",
    "nextview scenes": "--scenes 4 --workers 1",
    "nextview train recogniser": "--epochs 1 --views-per-object 2 --batch 8 --validation-share 0.4",
    "nextview train map": "--epochs 1 --views-per-object 2 --batch 8 --validation-share 0.4",
    "nextview train segmentation": "--frames 8 --epochs 1 --batch 4 --width 4 --workers 1",
    "nextview train gain": "--folds 2 --epochs 1 --episodes 1 --networks-per-fold 1",
    "nextview fit calibration": "--delta 0.2",
    "nextview benchmark classes": "--runs 2 --samples 100",
    "nextview benchmark things": (
        "--views 1 2 --policies random geometry --repeats 1 --samples 100 --workers 1"
    ),
    "python -m research.train_agent": "--steps 2000",
    "python examples/bin_picking.py": "--parts 1",
    "python -m research.measure": "--workers 1",
    "python -m research.plan": "--workers 1",
    "python -m benchmarks.views": "--runs 2",
    "python -m benchmarks.fixed_cameras": "--seeds 100 101 --moments 1",
}
FEWER = {  # what a page says of the published runs, and how many it is here
    r"--scenes \d+": "--scenes 4",
    r"--objects \d+": "--objects 2",
    r"--runs \d+": "--runs 2",
    r"--epochs \d+": "--epochs 1",
    r"--views-per-object \d+": "--views-per-object 2",
    r"--batch \d+": "--batch 8",
}
TABLE_OF_THINGS = """
import numpy as np

from nextview.simulation.sensor import SENSORS
from nextview.simulation.tables import SimulatedTable, TableCamera, poses_around
from nextview.things.memory import taught_meshes

rng = np.random.default_rng(4)
meshes = taught_meshes("ycb", ("cracker_box", "mug", "banana"))
table = TableCamera(SimulatedTable.draw(meshes, rng), SENSORS["stereo"], rng)
"""
BEFORE = {  # what Python blocks of a page take for granted
    "docs/your_camera.md": (
        """
import nextview
from nextview.sensing import Frame
from stand_ins import arm, intrinsics

system = nextview.load()
session = system.session(distance=0.6)
depth, pose = arm.look()
"""
    ),
    "docs/your_table.md": (
        TABLE_OF_THINGS
        + """
class Arm:
    def __init__(self):
        self.pose = poses_around(np.radians([30]), np.radians(45), 0.6, np.zeros(3))[0]

    def look(self):
        return table.frame(self.pose).depth, self.pose

    def go_to(self, pose):
        self.pose = pose


arm = Arm()
intrinsics = table.sensor.intrinsics
"""
    ),
    "docs/tracking.md": (
        TABLE_OF_THINGS
        + """
class Camera:
    def read(self):
        pose = poses_around(np.radians([30]), np.radians(45), 0.6, np.zeros(3))[0]
        return table.frame(pose).depth, pose, 0.0

    def __iter__(self):
        for number in range(5):
            depth, pose, _ = self.read()
            yield depth, pose, (number + 1) / 30


camera = Camera()
intrinsics = table.sensor.intrinsics
"""
    ),
    "docs/several_cameras.md": (
        """
from types import SimpleNamespace

import numpy as np

from nextview.simulation.sensor import SENSORS
from nextview.simulation.tables import SimulatedTable, TableCamera, poses_around
from nextview.things.memory import taught_meshes

rng = np.random.default_rng(4)
meshes = taught_meshes("ycb", ("cracker_box", "mug", "mustard_bottle"))
upright = SimulatedTable.draw(meshes, rng, resting=lambda mesh: np.eye(3)[None])
camera = TableCamera(upright, SENSORS["stereo"], rng)
intrinsics = camera.sensor.intrinsics
poses = poses_around(np.radians([30, 110]), np.radians(45), 0.65, np.zeros(3))
left, right = (
    SimpleNamespace(depth=camera.frame(pose).depth, intrinsics=intrinsics, pose=pose)
    for pose in poses
)
camera.change(SimulatedTable(upright.things[1:]))
later = SimpleNamespace(depth=camera.frame(poses[0]).depth)
"""
    ),
    "docs/see_it.md": "import nextview",
    "docs/your_objects.md": (
        """
from pathlib import Path

import nextview

if Path("mine").exists():  # what the first block has made
    system = nextview.load(models="mine", unknown=0.02)
    session = system.session(distance=0.5)
    from nextview.sensing import Frame
    from stand_ins import arm, intrinsics

    depth, pose = arm.look()
    session.update(Frame(depth, intrinsics, pose))
    poses = session.poses
"""
    ),
}


@dataclass(frozen=True)
class Step:
    """A command or a Python block of a page.

    Attributes:
        page: its path in the repository.
        line: where it begins, counted from 1.
        text: as it stands there, without comments of a shell.
        python: whether it is a block of Python.
    """

    page: str
    line: int
    text: str
    python: bool = False

    @property
    def needs(self) -> frozenset[str]:
        """What has to be installed besides the base installation, as pip is told."""
        return needs_of(self.text)

    @property
    def why_not(self) -> str | None:
        """Why it is not run; None if it is."""
        return next(
            (why for pattern, why in NOT_RUN.items() if re.search(pattern, self.text)),
            None,
        )

    @property
    def command(self) -> str:
        """What is run: with the options that make it quick, unless the page gives them itself."""
        text = self.text
        for pattern, fewer in FEWER.items():
            text = re.sub(pattern, fewer, text)
        if "--help" in text:
            return text
        for begin, options in SMALL.items():
            if text.startswith(f"{begin} "):
                for option in options.split(" --"):
                    name = f"--{option.removeprefix('--').split()[0]}"
                    text += "" if name in text else f" --{option.removeprefix('--')}"
        return text


def needs_of(text: str) -> frozenset[str]:
    """What the commands or the Python code of a text need besides the base installation."""
    return frozenset(
        wanted for pattern, wanted in NEEDS.items() if re.search(pattern, text)
    )


def steps_of(page: str) -> Iterator[Step]:
    """The commands and Python blocks of a page, in order.

    Blocks of doctest are run by the tests.
    """
    text = (ROOT / page).read_text(encoding="utf-8")
    if page.endswith(".py"):
        # What may be given or not stands in brackets there.
        about = re.sub(
            r"\[(--[^\]]+)\]",
            r"\1",
            ast.get_docstring(ast.parse(text), clean=False) or "",
        )
        lines = about.splitlines()
        for number in range(1, 1 + len(lines)):
            yield from _commands(page, number, lines)
        return

    lines = text.splitlines()
    block: list[str] = []
    begun = 0
    kind = None
    for number, line in enumerate(lines, 1):
        if line.startswith("```"):
            if kind == "python" and not block[0].startswith(">>>"):
                yield Step(page, begun + 1, "\n".join(block), python=True)
            kind = (
                None if kind is not None else line.removeprefix("```").strip() or "sh"
            )
            begun = number
            block = []
        elif kind == "python":
            block.append(line)
        elif kind is not None or line.startswith("    "):
            yield from _commands(page, number, lines)
        else:
            yield from _in_table(page, number, line)


def _commands(page: str, number: int, lines: list[str]) -> Iterator[Step]:
    """The command on a line, with the lines that go on after a backslash."""
    text = lines[number - 1].strip()
    if not text.startswith(PROGRAMS) or lines[number - 2].endswith("\\"):
        return
    while text.endswith("\\"):
        text = f"{text[:-1].strip()} {lines[number].strip()}"
        number += 1
    text = re.sub(r"\s+#.*", "", text)
    if " " in text:
        yield Step(page, number, text)


def _in_table(page: str, number: int, line: str) -> Iterator[Step]:
    """The last cell of a row of research/README.md: how a file is run."""
    cells = (
        re.findall(r"`((?:nextview|python) [^`]+)`", line)
        if line.startswith("|")
        else []
    )
    for text in cells[-1:] if page == "research/README.md" else ():
        yield Step(page, number, text)


def make_inputs(folder: Path) -> None:
    """What the commands of the pages find in their working folder."""
    from nextview.data.samples import SAMPLE_MESHES, boxes_mesh
    from nextview.recognition.model_card import find_card

    for name in ("samples", "benchmarks", "research", "examples", "docs", "workflow"):
        shutil.copytree(
            ROOT / name,
            folder / name,
            ignore=shutil.ignore_patterns("__pycache__", "tests"),
        )
    held_out = find_card("recogniser-modelnet10").held_out
    rng = np.random.default_rng(0)
    test = {
        "chair": ("chair_0890", "chair_0917"),
        "table": ("table_0399", "table_0400"),
    }
    for label in SAMPLE_MESHES:
        learned = [name for name in held_out if name.rpartition("_")[0] == label][:3]
        names = [
            (name, "train") for name in (*learned, f"{label}_0001", f"{label}_0002")
        ]
        names += [
            (name, "test")
            for name in test.get(label, (f"{label}_0470", f"{label}_0471"))
        ]
        for name, split in names:
            scale = rng.uniform(0.8, 1.25, 3)
            boxes = [
                tuple(tuple(np.multiply(corner, scale)) for corner in box)
                for box in SAMPLE_MESHES[label]()
            ]
            mesh = boxes_mesh(boxes, label)
            inches = trimesh.Trimesh(
                rng.uniform(15, 30) * mesh.vertices,
                mesh.faces,
                process=False,
            )
            path = folder / "data/ModelNet10" / label / split / f"{name}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            inches.export(path)
    for copy in ("ModelNet10", "DATASET/ModelNet10"):
        shutil.copytree(folder / "data/ModelNet10", folder / copy)
    for label in SAMPLE_MESHES:  # of classes that no recogniser knows
        shutil.copytree(
            folder / "data/ModelNet10" / label / "test",
            folder / "PSB" / f"strange_{label}",
        )
    shutil.copytree(folder / "data/ModelNet10/chair/test", folder / "chairs")
    shutil.copy(folder / "samples/chair.off", folder)
    for name, mesh in (
        ("mug", trimesh.creation.cylinder(0.04, 0.1)),
        ("box", trimesh.creation.box((0.1, 0.2, 0.06))),
    ):
        (folder / "scans").mkdir(exist_ok=True)
        mesh.export(folder / f"scans/{name}.ply")
    shutil.copy(folder / "scans/mug.ply", folder)
    for name, content in FILES.items():
        (folder / name).write_text(content)


# modules that pages name as a reader's own, and what their Python blocks take for granted
FILES = {
    "mine.py": (
        """
from nextview.data.measures import Measure

def clutter(view):
    return float(view.seen.mean())

uprightness = Measure(lambda view: float(len(view.pixels[0])), needs="mesh", good="peak")
"""
    ),
    "spread.py": (
        """
import numpy as np

class Spread:
    needs = ()

    def __init__(self, sphere):
        self.sphere = sphere

    def next_views(self, state, rng):
        far = np.where(state.visited[:, None, :], self.sphere.arc[None], np.inf).min(2)
        return np.where(state.free, far, -1.0).argmax(1)
"""
    ),
    "stops.py": (
        """
def clear_lead(seen, threshold):
    return (seen.margin >= threshold) & (seen.n_views >= 2)
"""
    ),
    "own_recogniser.py": (
        """
import shutil
import sys
from pathlib import Path

from nextview.recognition.model_card import BUNDLED_MODELS

for path in BUNDLED_MODELS.glob("recogniser-modelnet10*"):
    shutil.copy(path, Path(f"{sys.argv[1]}{path.name.removeprefix('recogniser-modelnet10')}"))
"""
    ),
    "stand_ins.py": (
        """
import sys

import numpy as np

sys.path.insert(0, "examples")
from arm_and_object import Arm
from simulated_sensor import INTRINSICS as intrinsics

import nextview

arm = Arm(nextview.load_mesh("samples/chair.off"), np.random.default_rng(0))
"""
    ),
}
PREPARED = {  # what a page takes as made before, by commands or pages that it names
    "docs/add_a_measure.md": "mkdir models; python own_recogniser.py models/recogniser",
    "docs/add_a_policy.md": "cp -r views.zarr modelnet10.zarr",
    "docs/add_a_recogniser.md": (
        "cp test.npz mine.npz; mkdir models; python own_recogniser.py models/linear"
    ),
    "docs/cluttered_scenes.md": "python own_recogniser.py recogniser",
    "docs/training.md": "cp -r views.zarr mine.zarr",
    # Predictions name their store: those that are planned for have to be of the one in this folder.
    "research/README.md": (
        "nextview predict views.zarr test.npz --split test --workers 1 --overwrite; nextview train"
        " map views.zarr runs/lem --epochs 1 --views-per-object 2 --batch 8 --validation-share 0.4"
    ),
}
# pages of which each Python block runs by itself
ALONE = ("docs/your_camera.md", "docs/your_objects.md")
# pages whose Python blocks do again what their commands did: in a folder of its own
BESIDE = ("docs/your_objects.md",)
STORES = (  # made once, for all pages
    "nextview render data/ModelNet10 views.zarr --workers 1",
    "nextview predict views.zarr validation.npz --held-out recogniser-modelnet10 --workers 1",
    "nextview predict views.zarr test.npz --split test --workers 1",
)


@dataclass
class Environments:
    """Environments with nothing but what is asked for, each made when it is first needed.

    Attributes:
        folder: in which they lie.
        base: the folder of the programs of a base installation that is there already, to be used
            instead; if it is given, there are no others.
    """

    folder: Path
    base: Path | None = None
    _made: dict[frozenset[str], Path] = field(default_factory=dict)

    def programs(self, needs: frozenset[str]) -> Path:
        """The folder of the programs of one of them: Python, nextview.

        Args:
            needs: what is installed besides the base installation, as pip is told:
                "nextview[train]", "research".
        """
        if self.base is not None:
            return self.base
        from linked_environment import installation

        if needs not in self._made:
            extras = {
                text.partition("[")[2].rstrip("]")
                for text in needs
                if text.startswith("nextview[")
            }
            research = [
                text.partition("[")[2].rstrip("]")
                for text in needs
                if text.startswith("research")
            ]
            wanted = set(filter(None, research)) if research else None
            try:
                python = installation(
                    self.folder / str(len(self._made)),
                    extras,
                    wanted,
                )
            except PackageNotFoundError as missing:
                raise SystemExit(
                    f"{', '.join(sorted(needs))}: not installed here, {missing.name} is missing"
                ) from None
            self._made[needs] = python.parent
        return self._made[needs]

    def run(
        self,
        command: str,
        folder: Path,
        needs: frozenset[str] = frozenset(),
    ) -> tuple[int, str, float]:
        """Exit status, output and seconds of a command of a shell in a folder."""
        begun = time.monotonic()
        setting = (
            f"export PATH={shlex.quote(str(self.programs(needs)))}:$PATH; set -e; "
        )
        surroundings = {
            name: value for name, value in os.environ.items() if name != "PYTHONPATH"
        }
        shell = ["bash", "-c", setting + command]
        try:
            done = subprocess.run(
                shell,
                cwd=folder,
                env=surroundings,
                capture_output=True,
                text=True,
                timeout=LIMIT,
            )
        except subprocess.TimeoutExpired:
            return 124, f"took longer than {LIMIT} s", time.monotonic() - begun
        return done.returncode, done.stdout + done.stderr, time.monotonic() - begun


def run_page(
    page: str,
    environments: Environments,
    folder: Path,
    beside: Path | None = None,
) -> list[str]:
    """Run what a page shows; returns what failed, a line each.

    Args:
        page: of the repository.
        environments: those of its commands.
        folder: in which the commands run.
        beside: in which the Python blocks run, if not there.
    """
    failed = []
    if page in PREPARED:
        status, said, _ = environments.run(
            PREPARED[page],
            folder,
            needs_of(PREPARED[page]),
        )
        if status != 0:
            raise SystemExit(f"{page}: {PREPARED[page]}\n{said}")
    python: list[str] = [BEFORE[page]] if page in BEFORE else []
    needs_of_python: frozenset[str] = frozenset()
    for step in steps_of(page):
        where = f"{step.page}:{step.line}"
        why_not = step.why_not
        if environments.base is not None and step.needs and why_not is None:
            why_not = f"needs {', '.join(sorted(step.needs))}"
        if why_not is not None:
            print(f"  not run  {where}  {step.text}  ({why_not})", flush=True)
            continue

        command = step.command
        needs = step.needs
        place = folder
        if step.python:
            place = beside or folder
            python = [*(python[:1] if page in ALONE else python), step.text]
            needs_of_python |= needs
            needs = needs_of_python
            (place / "page_block.py").write_text(
                "\n\n".join(python) + "\n",
                encoding="utf-8",
            )
            command = "python page_block.py"

        status, said, seconds = environments.run(command, place, needs)
        ended = "ok" if status == 0 else "FAILED"
        installed = ", ".join(sorted(needs)) or "base"
        print(
            f"{ended:>9}  {where}  {seconds:.0f} s  ({installed})  {command}",
            flush=True,
        )
        if status != 0:
            print("\n".join(said.splitlines()[-12:]), flush=True)
            failed.append(f"{where}  {step.text.splitlines()[0]}")
    return failed


def main(
    pages: tyro.conf.Positional[tuple[str, ...]] = (),
    base: Path | None = None,
    only_list: bool = False,
) -> None:
    """Run the commands of pages.

    Args:
        pages: of the repository; all that have commands by default.
        base: the folder of the programs of a base installation: all that needs no more is run
            there, and nothing else.
        only_list: only show what would be run, and what not and why.
    """
    chosen = pages or PAGES
    if only_list:
        for step in (step for page in chosen for step in steps_of(page)):
            print(f"{step.page}:{step.line}  {step.why_not or step.command}")
        return

    failed = []
    with tempfile.TemporaryDirectory(prefix="documented-") as place:
        environments = Environments(Path(place) / "environments", base)
        inputs = Path(place) / "inputs"
        inputs.mkdir()
        make_inputs(inputs)
        for command in STORES:
            status, said, _ = environments.run(command, inputs)
            if status != 0:
                raise SystemExit(f"{command}\n{said}")

        for page in chosen:
            folder = Path(place) / page.replace("/", "_")
            shutil.copytree(inputs, folder)
            print(page, flush=True)
            beside = Path(place) / "beside" if page in BESIDE else None
            if beside is not None:
                shutil.copytree(inputs, beside)
            failed += run_page(page, environments, folder, beside)
            shutil.rmtree(folder)
    if failed:
        raise SystemExit("\n".join([f"{len(failed)} commands failed:", *failed]))


if __name__ == "__main__":
    tyro.cli(main)
