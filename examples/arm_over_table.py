"""An arm looks at a full table until it knows everything on it, and says what is where.

pip install './research[arm]'
python examples/arm_over_table.py YCB [--seed 0] [--film table.gif] [--figure table.png]

YCB is a folder of scans in metres, a file a thing. Some of them, drawn at random, stand or lie on a
table at true size, and among them a toy that nextview does not know. A Panda with a depth camera on
its wrist looks where ``nextview.Scene`` asks for, as far as it can. The camera, the poses that the
arm believes in and its vertical have their errors. The table is the first of a series of draws in
which at least three things are hidden: the first frame shows less than half of each of them.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.data.samples import SAMPLE_MESHES, sample_mesh
from nextview.errors import MissingExtraError, UsageError
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.resting import resting_poses
from nextview.geometry.viewsphere import look_at_origin, rotation_z
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Look
from nextview.sensing.object_frame import Box
from nextview.simulation.sensor import SENSORS
from nextview_lab.worlds.scene import footprint, separation
from nextview_lab.worlds.tables import PlacedThing

if TYPE_CHECKING:
    from research.arm import Arm

NEEDED = ("research", "mujoco", "mink", "gymnasium_robotics")
MIDDLE = np.array([0.48, 0.0, 0.05])  # of the things, metres from the arm's base
WIDEST = 0.24  # metres from there within which things are put
AROUND = 0.36  # metres from the middle of the things within which is looked
# metres between a thing and what hides it; the first: between any two
GAPS = (0.01, 0.04)
ASIDE = 0.01  # metres by which a hidden thing stands beside the line of sight
TRIES = 50  # places that are tried for a thing
FIRST_VIEW = np.radians([30.0, 240.0])  # elevation and azimuth, seen from ``MIDDLE``
DISTANCE = 0.5  # metres from ``MIDDLE`` to the camera
STRANGER_RADIUS = 0.07  # metres
# share of its pixels of which a thing shows less that is hidden behind others
HIDDEN = 0.5
HIDDEN_THINGS = 3
SMALLEST = 0.05  # metres across: what is smaller shows on too few pixels
# share of the scans, the largest ones, of which those are that hide others
LARGE = 0.25
DRAWS = 500
FORMATS = (".ply", ".obj", ".stl", ".off", ".glb")
COARSE = 4  # only each so many-th pixel is looked at to see what is hidden


@dataclass(frozen=True)
class FullTable:
    """What stands on the table.

    Attributes:
        things: the last of them is the stranger.
        draw: how many tables were drawn before this one.
        shown: share of its pixels that the first frame shows of each thing, (N,).
    """

    things: tuple[PlacedThing, ...]
    draw: int
    shown: np.ndarray

    @property
    def hidden(self) -> list[str]:
        """Names of the things that others hide from the first frame."""
        return [
            one.name
            for one, share in zip(self.things, self.shown, strict=True)
            if share < HIDDEN
        ]


def recognise(
    arm: Arm,
    system: nextview.System,
    looked: Callable[[nextview.Scene, Look], None],
) -> nextview.Scene:
    """What a user writes: look, and go where the scene asks for, until it is done."""
    before = Box(MIDDLE - AROUND, MIDDLE + AROUND)  # not the arm's own base
    scene = nextview.Scene(
        system,
        region=before,
        distance=DISTANCE,
        reachable=arm.can_reach,
    )
    looked(scene, scene.update(arm.look(itself=False)))
    while not scene.done and scene.target is not None:
        arm.go_to(scene.target)
        looked(scene, scene.update(arm.look(itself=False)))
    return scene


def first_pose() -> np.ndarray:
    """Where the camera is at first, (4, 4)."""
    pose = look_at_origin(*FIRST_VIEW, DISTANCE)
    pose[:3, 3] += MIDDLE
    return pose


def draw_table(scans: Sequence[Path], count: int, seed: int) -> FullTable:
    """Draw tables until ``HIDDEN_THINGS`` of the things on one are hidden.

    Args:
        scans: files of known things, in metres.
        count: of the things on the table, with the stranger.
        seed: of the draws.

    Raises:
        UsageError: there are too few scans, or no such table is drawn.
    """
    if len(scans) < count - 1:
        raise UsageError(f"{count - 1} scans are needed, and here are {len(scans)}")
    rng = np.random.default_rng(seed)
    meshes = one_of_a_kind([named_scan(path) for path in scans], rng)
    meshes.sort(key=largest_side)
    split = len(meshes) - max(HIDDEN_THINGS, int(LARGE * len(meshes)))
    high = split + rng.choice(len(meshes) - split, HIDDEN_THINGS, replace=False)
    rest = rng.choice(split, count - 1 - HIDDEN_THINGS, replace=False)
    meshes = [meshes[k] for k in [*high, *rest]]
    meshes.append(toy(str(rng.choice(sorted(SAMPLE_MESHES)))))
    rests = [resting_poses(mesh) for mesh in meshes]
    for row in range(HIDDEN_THINGS):
        rests[row] = highest(meshes[row], rests[row])
    rests[-1] = np.eye(3)[None]  # the toy stands

    for draw in range(DRAWS):
        rng = np.random.default_rng([seed, draw])
        things = arranged(
            [lying(mesh, rest, rng) for mesh, rest in zip(meshes, rests, strict=True)],
            rng,
        )
        if things is None:
            continue
        table = FullTable(things, draw, shares_shown(things, first_pose()))
        if len(table.hidden) == HIDDEN_THINGS:
            return table
    raise UsageError(
        f"in {DRAWS} draws no {HIDDEN_THINGS} of {count} things hide behind others"
    )


def named_scan(path: Path) -> Mesh:
    """A scan in metres, by the name of its file."""
    return replace(load_mesh(path, unit="m"), name=path.stem)


def one_of_a_kind(meshes: Sequence[Mesh], rng: np.random.Generator) -> list[Mesh]:
    """Of scans that are named ``a_cups``, ``b_cups``, ... one that is drawn; none that is small."""
    kinds: dict[str, list[Mesh]] = {}
    for mesh in meshes:
        if 2 * mesh.radius > SMALLEST:
            kinds.setdefault(re.sub("^[a-z]_", "", mesh.name), []).append(mesh)
    return [same[rng.integers(len(same))] for same in kinds.values()]


def largest_side(mesh: Mesh) -> float:
    """Area of the largest side of a mesh's bounding box, square metres."""
    sides = np.sort(np.ptp(mesh.vertices, axis=0))
    return float(sides[1] * sides[2]) * mesh.radius**2


def highest(mesh: Mesh, rests: np.ndarray) -> np.ndarray:
    """Of the resting poses, (P, 3, 3), the one in which a mesh is highest, (1, 3, 3)."""
    return rests[np.ptp(mesh.vertices @ rests[:, 2].T, axis=0).argmax()][None]


def lying(mesh: Mesh, rests: np.ndarray, rng: np.random.Generator) -> PlacedThing:
    """A thing on the table in one of its resting poses, (P, 3, 3), turned; above the origin."""
    metres = mesh.vertices * mesh.radius + mesh.centre
    pose = np.eye(4)
    pose[:3, :3] = (
        rotation_z(rng.uniform(0, 2 * np.pi)) @ rests[rng.integers(len(rests))]
    )
    turned = metres @ pose[:3, :3].T
    low, high = turned.min(0), turned.max(0)
    pose[:3, 3] = -np.array([*(low + high)[:2] / 2, low[2]])
    return PlacedThing(mesh.name, metres, mesh.faces, pose)


def arranged(
    things: Sequence[PlacedThing],
    rng: np.random.Generator,
) -> tuple[PlacedThing, ...] | None:
    """Put things before the arm: the highest at random, the lowest behind them, then the rest.

    Args:
        things: above the origin.
        rng: draws where they stand.

    Returns:
        The things where they stand, in the same order; None if one finds no place.
    """
    heights = [float(thing.placed[:, 2].max()) for thing in things]
    high = list(range(HIDDEN_THINGS))
    others = sorted(range(HIDDEN_THINGS, len(things)), key=lambda row: heights[row])
    low = others[:HIDDEN_THINGS]
    outlines = [footprint(thing.placed) for thing in things]
    away = -np.array([np.cos(FIRST_VIEW[1]), np.sin(FIRST_VIEW[1])])
    places: dict[int, np.ndarray] = {}

    for row in [*high, *others]:
        for _ in range(TRIES):
            turn = rng.uniform(0, 2 * np.pi)
            place = MIDDLE[:2] + WIDEST * np.sqrt(rng.random()) * np.array(
                [np.cos(turn), np.sin(turn)]
            )
            if row in low:
                before = high[low.index(row)]
                depth = (
                    np.ptp(outlines[before] @ away) / 2
                    + np.ptp(outlines[row] @ away) / 2
                )
                behind = (depth + rng.uniform(*GAPS)) * away
                place = places[before] + behind + rng.normal(0, ASIDE, 2)
            apart = [
                separation(outlines[row] + place, outlines[k] + there)
                for k, there in places.items()
            ]
            if min(apart, default=np.inf) >= GAPS[0]:
                places[row] = place
                break
        else:
            return None

    placed = []
    for row, thing in enumerate(things):
        pose = thing.pose.copy()
        pose[:2, 3] += places[row]
        placed.append(replace(thing, pose=pose))
    return tuple(placed)


def toy(name: str) -> Mesh:
    """A sample, made as small as a toy: nothing that nextview knows looks like it."""
    mesh = sample_mesh(name)
    return replace(
        mesh,
        name=f"toy {name}",
        radius=STRANGER_RADIUS,
        centre=np.zeros(3),
        unit="m",
    )


def shares_shown(things: Sequence[PlacedThing], pose: np.ndarray) -> np.ndarray:
    """Share of its pixels that a camera at a pose, (4, 4), sees of each thing, (N,)."""
    sensor = SENSORS["wrist"]
    rays = (
        PinholeCamera.of(sensor.intrinsics, sensor.shape)
        .rays[::COARSE, ::COARSE]
        .reshape(-1, 3)
    )
    rays = rays @ pose[:3, :3].T
    triangles = [(thing.placed, thing.faces) for thing in things]
    _, owner = RayCaster(triangles).cast(pose[:3, 3], rays)
    shown = np.bincount(owner[owner >= 0], minlength=len(things))
    alone = [
        np.isfinite(RayCaster([one]).cast(pose[:3, 3], rays)[0]).sum()
        for one in triangles
    ]
    return shown / np.maximum(alone, 1)


@dataclass(frozen=True)
class Verdict:
    """An object, and what it truly is.

    Attributes:
        found: the object.
        row: of the thing that it truly is; -1 for none.
        true: the thing; None for none.
        known: whether nextview knows the thing.
    """

    found: SceneObject
    row: int
    true: PlacedThing | None
    known: bool

    @property
    def right(self) -> bool:
        """Whether it has the right name, or is a stranger and called unknown."""
        if self.found.name == UNKNOWN_NAME:
            return self.true is not None and not self.known
        return self.true is not None and self.found.name == self.true.name

    @property
    def wrong(self) -> bool:
        """Whether it has a wrong name."""
        return self.found.name != UNKNOWN_NAME and not self.right

    def line(self, lean: np.ndarray) -> str:
        """What is printed of it.

        Args:
            lean: of the table in the arm's world, (4, 4).
        """
        name = "none of the things" if self.true is None else self.true.name
        if not self.right:
            return f"{self.found}: {'WRONG' if self.wrong else 'not recognised'}, it is {name}"
        if self.found.pose is None or self.true is None:
            return f"{self.found}: right, it is {name}"
        vertices = self.true.vertices
        middle = np.append((vertices.min(0) + vertices.max(0)) / 2, 1.0)
        off = float(np.linalg.norm((self.found.pose - lean @ self.true.pose) @ middle))
        return f"{self.found}: right, {1000 * off:.0f} mm off"


def verdicts(
    scene: nextview.Scene,
    table: FullTable,
    truly: Sequence[np.ndarray],
) -> list[Verdict]:
    """What each object truly is: what most of its pixels show.

    Args:
        scene: what was found.
        table: what stands there.
        truly: row of the thing that each pixel shows, -1 for none, (H, W), of each frame.
    """
    found = []
    for thing in scene.objects:
        shown = np.concatenate(
            [truly[frame][mask] for frame, mask in thing.pixels.items()]
        )
        row = int(np.bincount(shown + 1).argmax()) - 1
        true = table.things[row] if row >= 0 else None
        found.append(Verdict(thing, row, true, 0 <= row < len(table.things) - 1))
    return found


def summary(found: Sequence[Verdict], table: FullTable) -> list[str]:
    """The end in a few lines: how many are right, and what is not."""
    right = {one.row: one for one in found if one.right}
    known = len(table.things) - 1
    named = [one for row, one in right.items() if row < known]
    sure = sum(one.found.confident for one in named)
    said = [
        f"{len(named)} of {known} things named right, {sure} of them with confidence"
    ]
    if known in right:
        said.append(f"the stranger, a {table.things[-1].name}, is told as unknown")
    wrong = {one.row: one for one in found if one.wrong}
    if wrong:
        names = [
            f"{one.found.name} ({one.true.name if one.true else 'nothing'})"
            for one in wrong.values()
        ]
        said.append(f"wrong: {', '.join(names)}")
    missed = [
        thing.name
        for row, thing in enumerate(table.things)
        if row not in right and row not in wrong
    ]
    if missed:
        said.append(f"not recognised: {', '.join(missed)}")
    return [line.replace("_", " ") for line in said]


def main(
    scans: tyro.conf.Positional[Path],
    seed: int = 0,
    things: int = 10,
    looks: int = 6,
    film: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Look at a full table.

    Args:
        scans: folder of scans of known things, in metres, by their names.
        seed: of the table, and of all errors.
        things: on the table, one of them a stranger.
        looks: at most.
        film: GIF that is written; one of that name is replaced.
        figure: picture of the end that is written (PNG, PDF or SVG); one of that name is replaced.
    """
    for package in NEEDED:
        if find_spec(package) is None:
            raise MissingExtraError(
                f"{sys.argv[0]} needs the package {package}: pip install './research[arm]'"
            )
    from research.arm import Arm

    if not scans.is_dir():
        raise UsageError(f"{scans}: this is no folder of scans")
    files = sorted(path for path in scans.iterdir() if path.suffix.lower() in FORMATS)
    table = draw_table(files, things, seed)
    print(f"on the table: {', '.join(thing.name for thing in table.things)}")
    print(
        f"draw {table.draw} of seed {seed}; hidden from the first look: {', '.join(table.hidden)}"
    )
    standing = [(thing.placed, thing.faces) for thing in table.things]
    arm = Arm(standing, np.random.default_rng(seed), sensor=SENSORS["wrist"])
    start = arm.solve(first_pose())
    if start is None:
        raise UsageError(
            "the arm cannot look from where it is to begin: try another --seed"
        )
    arm.joints = start

    shown = None
    if film is not None:
        from films import TableFilm

        title = f"{things} things on a table, {HIDDEN_THINGS} of them hidden"
        shown = TableFilm(arm, MIDDLE, title, film)
    truly: list[np.ndarray] = []

    def looked(scene: nextview.Scene, look: Look) -> None:
        if look.taken:
            truly.append(arm.owner)
        sure = sum(thing.confident for thing in scene.objects)
        print(
            f"look {len(truly)}: {len(scene.objects)} objects, {sure} with a sure name"
        )
        if shown is not None and look.taken:
            found = verdicts(scene, table, truly)
            wrong = {
                one.found.number for one in found if one.wrong and one.found.confident
            }
            shown.looked(scene, {one.found.number: one.row for one in found}, wrong)

    scene = recognise(arm, nextview.load("ycb", max_views=looks), looked)
    found = verdicts(scene, table, truly)
    print(
        "\n".join([*(one.line(arm.lean) for one in found), "", *summary(found, table)])
    )
    print(f"{arm.seconds:.2f} s of motion")
    if shown is not None:
        shown.end(summary(found, table))
    if figure is not None:
        scene.plot(figure, f"{things} things before an arm")


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
