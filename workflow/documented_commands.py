"""Run every command that the pages show, on small inputs made here, and compare what it prints and
draws with the page: what no machine runs is wrong some day.

    python workflow/documented_commands.py [PAGE or PICTURE ...] [--data FOLDER] [--update]

Takes README.md, docs/*.md and what stands above the code of examples/*.py apart
into commands and Python blocks, and runs them page by page, in the order of the page, each page in
a folder of its own with what its commands need: a few box meshes under the names of ModelNet10, a
store of their views and predictions. ``SMALL`` makes a command quick; ``NOT_RUN`` says what is not
run, and why. What fails is printed with the end of its output, and the exit status is 1.

A fenced block without a language is the output of the step before it, which has to print just that;
if it has lines "...", each other line has to be printed, in this order. ``PICTURES`` has the
command of each picture of the pages, and ``NOT_DRAWN`` what is not drawn, and why. A difference is
a failure, and is shown as a diff; ``--update`` changes the page and the pictures instead. With
``--data``, a folder of real scans, the pictures are made that need them, a browser, or minutes.

Each command runs where nothing is installed but what a reader of the page has: the base
installation, and the extras that ``NEEDS`` names for it, which the page has to name, too. Such an
environment is linked from that of this script.
"""

from __future__ import annotations

import ast
import difflib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np
import trimesh
import tyro
from matplotlib import font_manager, get_data_path
from PIL import Image, ImageSequence
from scipy.ndimage import uniform_filter

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs/images"
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "examples"), str(ROOT)]

PAGES = (
    "README.md",
    *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")),
    *sorted(f"examples/{path.name}" for path in (ROOT / "examples").glob("*.py")),
)
PROGRAMS = (
    "nextview ",
    "nextview-lab ",
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
WIDTH = 110  # columns of the terminal
SQUARE = 32  # pixels, side of the squares in which pictures are compared
TOLERANCE = (
    6.0  # of 255: mean difference in a square; edges of letters and lines stay below it
)

NOT_RUN = {  # commands by how they begin, or what is in them; the reason
    r"lmo": "needs a dataset of BOP: lab/tests/test_bop.py writes one and runs it",
    r"benchmarks\.gate|studies\.(segmentation|confidence|distances)|^nextview-lab real": (
        "needs scans and real frames, which are not here: lab/tests/test_real.py writes some"
    ),
    r"^nextview-lab benchmark tables|studies\.tracking": (
        "needs scans of all things that the bundled memory knows"
    ),
    r"^python3 -m venv": ".ci/base_installation makes such an environment, and uses it",
    r"^make ": "the workflow is run by lab/tests/test_workflow.py",
    r"^(pip|python3 -m pip) ": "installs; each command runs where only the extras of its page are",
    r"^nextview-lab download": (
        "473 MB from a server of others; lab/tests/test_download.py has a server of its own"
    ),
    r"^nextview(-lab)? explore": (
        "serves until it is stopped; tests/test_explore_page.py clicks through the page"
    ),
    r"\bimport robot\b": "needs a robot; tests/test_grasps.py runs the loop with a stand-in",
    r"pyrealsense2": (
        "needs a camera; tests/test_pages.py runs the script with a stand-in and looks at its shots"
    ),
    r"^rerun ": "opens a window",
    r"^dask ": "serves until it is stopped; lab/tests/test_render.py has a cluster of its own",
    r"--scheduler": "needs the scheduler of the line before",
    r"^(ros2|rosdep|colcon|cp -r ros2|cd |source |python3.11 ros2|export AMENT_PREFIX)": (
        "needs ROS 2; make test-ros runs the node, and the first steps of its page"
    ),
    r"my_(recordings?|folder)": (
        "needs a recording of the reader's; tests/test_bags.py writes such and reads them"
    ),
    r"-m zipfile|efficientnet|resnet34-b627a593": "weights of others, which are fetched first",
    r"studies\.frozen|nextview-bench|submit ARCHIVE|^for policy in": (
        "needs the YCB scans, and hours; lab/tests/test_submit.py runs methods on a small archive"
    ),
    r"NpzDepth": "a part of a reader that is to be put into nextview itself",
    r"SceneRecorder\(": "a part of a loop; tests/test_scene_viewers.py records scenes",
    r"look_alikes|(benchmark things|studies\.strangers) (YCB|HALF_SCANS)": (
        "needs the YCB scans, and minutes"
    ),
    r"agent_on_things": (
        "needs things that were taught; lab/tests/test_thing_environment.py lets it learn"
    ),
    r"nextview_ros": "takes messages of ROS 2; tests/test_ros2.py has recorded ones",
    r"--ensemble runs/second": "needs the run of the line before",
}
NEEDS = {  # what a command or a Python block needs besides the base installation, by what is in it
    r"nextview learn |\blearn\(|grasp_point": "nextview[teach]",
    r"nextview-lab |nextview_lab|site/pictures|bin_parts": "nextview-lab",
    r"nextview-lab (train|export) ": "nextview-lab[train]",
    r"nextview-lab (benchmark|evaluate|report) ": "nextview-lab[benchmark]",
    r"thesis\.measure_study": "nextview-lab[benchmark]",
    r"--record|viewers\.(scene_)?recording|explorer_pictures": "nextview[record]",
    r"--explorer|viewers\.scene_page|explorer_pictures": "nextview[explore]",
    r"explorer_pictures": "nextview[browser]",
    r"examples/bin_picking": "nextview-lab[arm]",
}
SMALL = {  # options that make a command quick
    "nextview-lab render": "--workers 1",
    "nextview-lab predict": "--workers 1 --overwrite",
    "nextview-lab measure": "--workers 1",
    "nextview learn": "--workers 1",
    "nextview-lab train recogniser": (
        "--epochs 1 --views-per-object 2 --batch 8 --validation-share 0.4"
    ),
    "nextview-lab train map": "--epochs 1 --views-per-object 2 --batch 8 --validation-share 0.4",
    "nextview-lab train segmentation": "--frames 8 --epochs 1 --batch 4 --width 4 --workers 1",
    "nextview-lab train gain": "--folds 2 --epochs 1 --episodes 1 --networks-per-fold 1",
    "nextview-lab fit calibration": "--delta 0.2",
    "nextview-lab benchmark classes": "--runs 2 --samples 100",
    "nextview-lab benchmark things": (
        "--views 1 2 --policies random geometry --repeats 1 --samples 100 --workers 1"
    ),
    "python examples/bin_picking.py": "--parts 1",
}
FEWER = {  # what a page says of the published runs, and how many it is here
    r"--objects \d+": "--objects 2",
    r"--runs \d+": "--runs 2",
    r"--epochs \d+": "--epochs 1",
    r"--views-per-object \d+": "--views-per-object 2",
    r"--batch \d+": "--batch 8",
}
TABLE_OF_THINGS = """
from dataclasses import replace

import numpy as np

from nextview.data.samples import sample_mesh
from nextview.simulation.sensor import SENSORS
from nextview_lab.worlds.tables import SimulatedTable, TableCamera, poses_around
from nextview.things.memory import taught_meshes

rng = np.random.default_rng(4)
meshes = taught_meshes("ycb", ("cracker_box", "mug", "banana"))
toy = replace(sample_mesh("monitor"), radius=0.07, centre=np.zeros(3), unit="m")
table = TableCamera(SimulatedTable.draw([*meshes, toy], rng), SENSORS["stereo"], rng)
"""
BEFORE = {  # what Python blocks of a page take for granted
    "README.md": """
import nextview

my_camera = nextview.SimulatedCamera(nextview.load_mesh("samples/chair.off"))
""",
    "docs/your_camera.md": (
        """
import nextview
from nextview.sensing import Frame
from stand_ins import arm, intrinsics

system = nextview.load()
session = system.session(distance=0.6)
depth, pose = arm.look()
my_camera = nextview.SimulatedCamera(nextview.load_mesh("samples/chair.off"))
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


def my_network(colour):
    return table.owner + 1
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
from nextview_lab.worlds.tables import SimulatedTable, TableCamera, poses_around
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
    import sys

    import numpy as np

    sys.path.insert(0, "examples")
    from grasp_point import Robot

    robot = Robot(np.random.default_rng(0))
    session.update(robot.look(robot.first_pose()))
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
        output: lines that the page shows after it.
        output_at: the line at which they begin, counted from 1.
    """

    page: str
    line: int
    text: str
    python: bool = False
    output: tuple[str, ...] = ()
    output_at: int = 0

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


def steps_of(page: str) -> list[Step]:
    """The commands and Python blocks of a page, in order, each with the output that follows it.

    Blocks of doctest are run by the tests.

    Raises:
        ValueError: an output follows no step.
    """
    steps: list[Step] = []
    for step in _steps_and_outputs(page):
        if step.text:
            steps.append(step)
        elif not steps or steps[-1].output:
            raise ValueError(f"{page}:{step.output_at}: the output of what?")
        else:
            steps[-1] = replace(steps[-1], output=step.output, output_at=step.output_at)
    return steps


def _steps_and_outputs(page: str) -> Iterator[Step]:
    """The same, with each output as a step without a text."""
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
            elif kind == "" and not any(
                [*_commands(page, n, lines)] for n in range(begun + 1, number)
            ):
                yield Step(page, begun, "", output=tuple(block), output_at=begun + 1)
            kind = None if kind is not None else line.removeprefix("```").strip()
            begun = number
            block = []
        elif kind is not None:
            block.append(line)
            if kind not in ("python", "text", "json"):
                yield from _commands(page, number, lines)
        elif line.startswith("    "):
            yield from _commands(page, number, lines)


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


def make_inputs(folder: Path) -> None:
    """What the commands of the pages find in their working folder."""
    from grasp_point import mug

    from nextview.data.samples import SAMPLE_MESHES, boxes_mesh
    from nextview.recognition.model_card import find_card

    for name in ("samples", "examples", "docs", "workflow"):
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
        ("mug", mug()),
        ("box", trimesh.creation.box((0.1, 0.2, 0.06))),
    ):
        (folder / "scans").mkdir(exist_ok=True)
        mesh.export(folder / f"scans/{name}.ply")
    shutil.copy(folder / "scans/mug.ply", folder)
    for name, content in FILES.items():
        (folder / name).write_text(content)
    recording = ROOT / "src/nextview/captured/bundled/table"
    for name in ("recording", "shot_0"):  # three frames of a table, and one
        shutil.copytree(recording, folder / name)
    for path in (folder / "shot_0").rglob("00000[12].*"):
        path.unlink()
    shutil.copy(recording / "depth/000000.png", folder / "depth.png")
    shutil.copy(recording / "intrinsics.json", folder / "camera.json")


def make_rig(folder: Path) -> None:
    """Frames of two cameras, of which the right one errs."""
    from test_several_cameras import an_error, moments_of, write_rig

    rng = np.random.default_rng(11)
    write_rig(folder, moments_of(rng, an_error(rng), 6))


# modules that pages name as a reader's own, and what their Python blocks take for granted
FILES = {
    "mine.py": (
        """
from nextview_lab.data.measures import Measure

def clutter(view):
    return float(view.seen.mean())

uprightness = Measure(lambda view: float(len(view.pixels[0])), needs="mesh", good="peak")
"""
    ),
    "mymodule.py": (
        """
import numpy as np

class Mine:
    classes = ("box", "mug")

    def belief(self, observations):
        high = np.ptp(np.concatenate([seen.points for seen in observations])[:, 2])
        return np.array([0.9, 0.1] if high < 1 else [0.1, 0.9])
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
    "docs/add_a_recogniser.md": (
        "cp test.npz mine.npz; mkdir models; python own_recogniser.py models/linear"
    ),
    "docs/training.md": "cp -r views.zarr mine.zarr",
    "docs/your_table.md": "nextview learn samples mine --unit cm",
}
# pages of which each Python block runs by itself
ALONE = ("README.md", "docs/your_camera.md", "docs/your_objects.md")
# pages whose Python blocks do again what their commands did: in a folder of its own
BESIDE = ("docs/your_objects.md", "docs/your_table.md")
MADE_FROM_STORES = re.compile(r"\.zarr|\.npz|ViewStore|modelnet10")
STORES = (  # made once, for all pages that need them
    "nextview-lab render data/ModelNet10 views.zarr --workers 1",
    "nextview-lab predict views.zarr validation.npz --held-out recogniser-modelnet10 --workers 1",
    "nextview-lab predict views.zarr test.npz --split test --workers 1",
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
                "nextview-lab[train]".
        """
        if self.base is not None:
            return self.base
        from linked_environment import installation

        if needs not in self._made:
            projects: dict[str, set[str]] = {"nextview": set()}
            for text in needs:
                name, _, extra = text.rstrip("]").partition("[")
                projects.setdefault(name, set()).update(filter(None, [extra]))
            try:
                python = installation(self.folder / str(len(self._made)), projects)
            except PackageNotFoundError as missing:
                raise SystemExit(
                    f"{', '.join(sorted(needs))}: not installed here, {missing.name} is missing"
                ) from None
            self._made[needs] = python.parent
        return self._made[needs]

    @cached_property
    def own_fonts(self) -> Path:
        """A configuration of Matplotlib that has the fonts in it, and none of this machine."""
        folder = self.folder / "matplotlib"
        folder.mkdir(parents=True)
        fonts = font_manager.FontManager()
        fonts.ttflist = [
            font for font in fonts.ttflist if font.fname.startswith(get_data_path())
        ]
        name = f"fontlist-v{font_manager.FontManager.__version__}.json"
        font_manager.json_dump(fonts, folder / name)
        return folder

    def run(
        self,
        command: str,
        folder: Path,
        needs: frozenset[str] = frozenset(),
        limit: float = LIMIT,
    ) -> subprocess.CompletedProcess[str]:
        """Run a command of a shell in a folder, for at most some seconds."""
        setting = (
            f"export PATH={shlex.quote(str(self.programs(needs)))}:$PATH; set -e; "
        )
        surroundings = {
            name: value for name, value in os.environ.items() if name != "PYTHONPATH"
        }
        surroundings |= {"COLUMNS": str(WIDTH), "MPLCONFIGDIR": str(self.own_fonts)}
        shell = ["bash", "-c", setting + command]
        try:
            return subprocess.run(
                shell,
                cwd=folder,
                env=surroundings,
                capture_output=True,
                text=True,
                timeout=limit,
            )
        except subprocess.TimeoutExpired:
            said = f"took longer than {limit} s"
            return subprocess.CompletedProcess(command, 124, "", said)

    def run_or_end(self, command: str, folder: Path) -> None:
        """Run what others need; the program ends where it fails."""
        done = self.run(command, folder, needs_of(command))
        if done.returncode != 0:
            raise SystemExit(f"{command}\n{done.stdout}{done.stderr}")


def run_page(
    page: str,
    environments: Environments,
    folder: Path,
    beside: Path | None = None,
    update: bool = False,
) -> list[str]:
    """Run what a page shows; returns what failed, a line each.

    Args:
        page: of the repository.
        environments: those of its commands.
        folder: in which the commands run.
        beside: in which the Python blocks run, if not there.
        update: write into the page what its steps print.
    """
    failed = []
    if page in PREPARED:
        environments.run_or_end(PREPARED[page], folder)
    python: list[str] = [BEFORE[page]] if page in BEFORE else []
    needs_of_python = needs_of(BEFORE.get(page, ""))
    printed: list[tuple[Step, list[str]]] = []
    for step in steps_of(page):
        where = f"{step.page}:{step.line}"
        why_not = step.why_not
        missing = step.needs - {"nextview[teach]"}  # which a base that is given has
        if environments.base is not None and missing and why_not is None:
            why_not = f"needs {', '.join(sorted(missing))}"
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

        begun = time.monotonic()
        done = environments.run(command, place, needs)
        ended = "ok" if done.returncode == 0 else "FAILED"
        installed = ", ".join(sorted(needs)) or "base"
        print(
            f"{ended:>9}  {where}  {time.monotonic() - begun:.0f} s  ({installed})  {command}",
            flush=True,
        )
        if done.returncode != 0:
            said = (done.stdout + done.stderr).splitlines()
            print("\n".join(said[-12:]), flush=True)
            failed.append(f"{where}  {step.text.splitlines()[0]}")
        elif step.output:
            printed.append((step, as_shown(step.output, done.stdout or done.stderr)))
    return failed + changed_page(page, printed, update)


def as_shown(block: Sequence[str], output: str) -> list[str]:
    """The lines of an output that a page shows, long ones in several.

    Args:
        block: what the page shows now. If it has lines "...", each other line becomes the printed
            one, of those that follow, that is most like it.
        output: what was printed.
    """
    lines = [
        part.rstrip()
        for line in output.strip("\n").splitlines()
        for part in textwrap.wrap(line, WIDTH, break_long_words=False) or [""]
    ]
    if "..." not in block:
        return lines
    shown = []
    for line in block:
        if line != "..." and lines:
            like = [difflib.SequenceMatcher(None, line, one).ratio() for one in lines]
            at = int(np.argmax(like))
            line, lines = lines[at], lines[at + 1 :]
        shown.append(line)
    return shown


def changed_page(
    page: str,
    printed: Sequence[tuple[Step, list[str]]],
    update: bool,
) -> list[str]:
    """Compare a page with what its steps print; returns the outputs that differ, a line each.

    Args:
        page: of the repository; the difference is printed.
        printed: steps with an output, and the lines that it has to have.
        update: write them into the page.
    """
    old = (ROOT / page).read_text(encoding="utf-8").splitlines()
    new = list(old)
    for step, shown in reversed(printed):
        begin = step.output_at - 1
        new[begin : begin + len(step.output)] = shown
    print(
        "\n".join(
            difflib.unified_diff(old, new, page, f"{page}, as printed", "", "", 1, "")
        ),
        flush=True,
    )
    if update and new != old:
        (ROOT / page).write_text("\n".join(new) + "\n", encoding="utf-8")
    return [
        f"{page}:{step.output_at}  shows another output"
        for step, shown in printed
        if shown != [*step.output]
    ]


# pictures of docs/images, by the commands that leave them where they run
PICTURES = {
    "nextview demo && mv nextview_demo/table.png demo_table.png": "demo_table.png",
    "nextview recognise samples/table.off --start 33 --figure episode.png": "episode.png",
    "nextview recognise samples/chair.off --start 3 --figure gallery_chair.png": (
        "gallery_chair.png"
    ),
    "nextview look recording --frames 2 --figure table.png": "table.png",
    "python docs/site/pictures.py .": (
        "concept_belief.png concept_calibration.png concept_gain.png concept_maps.png"
        " concept_viewpoints.png gallery_samples.png sensors.png sizes.png"
    ),
    "python docs/site/explorer_pictures.py --out .": (
        "explore.png explore_compared.png recording.png table_page.png"
    ),
    (
        "mkdir eight && cp YCB/{b_lego_duplo,f_lego_duplo,flat_screwdriver,g_cups,h_cups,mug,"
        "phillips_screwdriver,power_drill}.ply eight && nextview learn eight taught --unit m"
        " && mv taught/learned.png ."
    ): "learned.png",
}
SLOW = r"YCB|ModelNet10|examples/|explorer_pictures"  # made only with --data
SLOW_LIMIT = 7200  # seconds for one of them
NOT_DRAWN = {  # pictures that no command of PICTURES makes, and why
    "confidence.png": "needs real frames, which are not here",
    "measures.png": "drawn by an earlier version of nextview_lab.thesis.measure_study",
    "picking.gif": "drawn by an earlier version, whose script is gone",
    "real_frame.webp": "needs a real frame, which is not here: workflow/film.py",
    "segmentation_worst.png": "its labelled frames are not among the data",
}


def check_pictures(
    wanted: Collection[str],
    environments: Environments,
    inputs: Path,
    data: Path | None,
    update: bool,
) -> list[str]:
    """Make pictures anew and compare them; returns what failed or differs, a line each.

    Args:
        wanted: names of pictures in docs/images.
        environments: those of their commands.
        inputs: folder in which the commands run.
        data: folder of real scans; without it, slow pictures are not made.
        update: replace the pictures that differ.
    """
    failed = []
    for command, names in PICTURES.items():
        chosen = [name for name in names.split() if name in wanted]
        needs = needs_of(command)
        slow = re.search(SLOW, command) is not None
        if not chosen or (environments.base is not None and needs):
            continue
        if slow and data is None:
            print(f"  not run  {', '.join(chosen)}  {command}  (slow: give --data)")
            continue
        for name in ("YCB", "ModelNet10") if slow and data is not None else ():
            shutil.rmtree(inputs / name, ignore_errors=True)
            (inputs / name).unlink(missing_ok=True)
            (inputs / name).symlink_to(data.resolve() / name)

        done = environments.run(command, inputs, needs, SLOW_LIMIT if slow else LIMIT)
        print(f"{'FAILED' if done.returncode else 'ok':>9}  {command}", flush=True)
        if done.returncode != 0:
            print("\n".join((done.stdout + done.stderr).splitlines()[-12:]))
            failed.append(f"{', '.join(chosen)}  {command}")
            continue
        for name in chosen:
            found = picture_difference(inputs / name, IMAGES / name)
            print(
                f"           {name}: {found:.2f} of 255 in the worst square", flush=True
            )
            if found > TOLERANCE:
                failed.append(f"docs/images/{name}  is another picture")
                if update:
                    shutil.copy(inputs / name, IMAGES / name)
    return failed


def picture_difference(made: Path, kept: Path) -> float:
    """The largest mean absolute difference in a square of two pictures or films, of 255.

    It is 255 if one is missing, or has another size or number of frames.
    """
    if not kept.exists():
        return 255.0
    with Image.open(made) as new, Image.open(kept) as old:
        frames = [getattr(each, "n_frames", 1) for each in (new, old)]
        if new.size != old.size or frames[0] != frames[1]:
            return 255.0
        worst = 0.0
        for one, other in zip(
            ImageSequence.Iterator(new), ImageSequence.Iterator(old), strict=True
        ):
            pixels = [np.asarray(each.convert("RGB"), float) for each in (one, other)]
            apart = np.abs(pixels[0] - pixels[1]).mean(2)
            worst = max(worst, float(uniform_filter(apart, SQUARE).max()))
    return worst


def main(
    chosen: tyro.conf.Positional[tuple[str, ...]] = (),
    base: Path | None = None,
    data: Path | None = None,
    update: bool = False,
    only_list: bool = False,
) -> None:
    """Run the commands of pages, and compare what they print and draw.

    Args:
        chosen: pages, or pictures in docs/images; all by default.
        base: the folder of the programs of a base installation: all that needs no more is run
            there, and nothing else.
        data: folder with YCB and ModelNet10: slow pictures are made, too.
        update: change pages and pictures to what is printed and drawn.
        only_list: only show what would be run, and what not and why.
    """
    pages = [name for name in chosen or PAGES if not name.startswith("docs/images/")]
    if only_list:
        for step in (step for page in pages for step in steps_of(page)):
            print(f"{step.page}:{step.line}  {step.why_not or step.command}")
        return

    failed = []
    with tempfile.TemporaryDirectory(prefix="documented-") as place:
        environments = Environments(Path(place) / "environments", base)
        inputs = Path(place) / "inputs"
        inputs.mkdir()
        make_inputs(inputs)
        if base is None:  # which has nothing of the tests
            make_rig(inputs / "my_rig")
        texts = [
            PREPARED.get(page, "") + step.text
            for page in pages
            for step in steps_of(page)
        ]
        for command in STORES if any(map(MADE_FROM_STORES.search, texts)) else ():
            environments.run_or_end(command, inputs)

        for page in pages:
            folder = Path(place) / page.replace("/", "_")
            shutil.copytree(inputs, folder)
            print(page, flush=True)
            beside = Path(place) / "beside" if page in BESIDE else None
            if beside is not None:
                shutil.copytree(inputs, beside, dirs_exist_ok=True)
            failed += run_page(page, environments, folder, beside, update)
            shutil.rmtree(folder)

        shown = {Path(name).name for name in chosen} | pictures_on(pages)
        failed += check_pictures(shown, environments, inputs, data, update)
    if failed:
        raise SystemExit("\n".join([f"{len(failed)} failed:", *failed]))


def pictures_on(pages: Iterable[str]) -> set[str]:
    """Names of the pictures that pages show or link."""
    return {
        name
        for page in pages
        for name in re.findall(
            r"\]\((?:docs/)?images/([^)]+)\)", (ROOT / page).read_text(encoding="utf-8")
        )
    }


if __name__ == "__main__":
    tyro.cli(main)
