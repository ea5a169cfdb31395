"""Whether answers got better or worse: one command before and after a change of the recognition.

    python -m benchmarks.gate [DATA] [--out FILE] [--against FILE] [--only PART ...] [--quick]

DATA, by default the environment variable NEXTVIEW_DATA, holds the scans of the bundled memory,
YCB/NAME.ply, in metres, and real frames in the folders real_taught, real_ycb and real_tables, as
``benchmarks.real_frames`` reads them. All other frames are drawn once by ``benchmarks.gate_frames``
and kept in the folder ``--frames``. Only the public interface of nextview is used.

| part | what |
|---|---|
| tables | 15 tables, three frames each: things 0 to 3 cm apart, some of them strangers; the last \
three with things in a bowl, on a box, and leaning |
| single | 30 things, each by its mask in one frame, in a session |
| parts | five machine parts, which are taught first: alone, and together in a shallow box |
| moves | 8 tables of five things, three frames; then one is moved or removed, two frames |
| places | a thing behind a box (half, two thirds) or cut by the border of the picture |
| real | real frames of taught things, and of things that nobody taught |
| counts | statements, modules and named numbers of the package, by its folders |

A known thing counts as soon as 500 of its pixels were in a frame. A name is right if the thing has
that name and the middle of its posed scan is within 3 cm; in real frames if its posed scan meets
the given pixels. "mm" is the mean distance of points on the true thing from the surface of the
posed one. A name on a stranger is one that is wrong and nearest to a thing that is not taught.
Seconds are of CPU, for a frame.

FILE keeps each part as soon as it is finished; parts that it holds are not measured again.
"""

from __future__ import annotations

import ast
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

import nextview
from benchmarks.gate_frames import (
    DRAWS,
    INTRINSICS,
    STRANGER,
    Case,
    Float,
    case,
    cloud,
    machine_parts,
    moved,
    scan,
)
from nextview.sensing import Frame

Part = Literal["tables", "single", "parts", "moves", "places", "real", "counts"]
Row = dict[str, Any]
Mask = NDArray[np.bool_]

IN_VIEW = 500  # pixels of a thing, from which on it counts
NEAR = 0.03  # metres from the true middle
COMPARED = 8  # each so manyth point of a thing is compared with the posed scan
PIXELS_NEAR = 8  # of a given pixel in a real frame
LEAST_LABEL = 200  # pixels of a label in a real frame
UNKNOWN = "unknown"
REAL_YCB = np.array([[618.017, 0, 312.377], [0, 618.003, 232.375], [0, 0, 1]])
REAL_TABLES = 12
SPREAD = ("mm", "seconds")  # columns of which median and worst are shown
DEFAULT_FRAMES = Path("~/.cache/nextview/gate")


@dataclass(frozen=True, eq=False)
class Found:
    """A name that was given.

    Attributes:
        name: of the thing.
        confident: whether the name is.
        pose: scan-to-world, (4, 4), metres.
    """

    name: str
    confident: bool
    pose: Float


@dataclass(frozen=True, eq=False)
class Bench:
    """What parts share.

    Attributes:
        data: folder of the scans and of the real frames.
        frames: folder of the drawn frames.
        every: each so manyth case is measured.
    """

    data: Path
    frames: Path
    every: int

    @property
    def scans(self) -> dict[str, Path]:
        """Files of the scans by their names."""
        return {path.stem: path for path in sorted((self.data / "YCB").glob("*.ply"))}

    @property
    def shapes(self) -> Shapes:
        """Points and normals of all scans."""
        return {name: cloud(scan(path)) for name, path in self.scans.items()}

    def cases(self, part: str) -> Iterator[tuple[str, Case]]:
        """The cases of a part, each with its name."""
        for number in range(0, DRAWS[part][1], self.every):
            yield f"{part} {number}", case(part, number, self.scans, self.frames)

    def system(self) -> nextview.System:
        """The system of the scans."""
        system = nextview.load("ycb", threads=1)
        missing = set(system.classes) - set(self.scans)
        if missing:
            sys.exit(f"{self.data}/YCB: holds no scan of {sorted(missing)[0]}")
        return system


Shapes = dict[str, tuple[Float, Float]]


def frame_of(seen: Case, number: int, mask: Mask | None = None) -> Frame:
    """A frame of a case."""
    return Frame(seen.depth[number], INTRINSICS, seen.told[number], mask)


def updated(scene: nextview.Session | nextview.Scene, frame: Frame) -> tuple[Any, Row]:
    """Give a frame to a scene or a session; what it returns, and the seconds that it took."""
    begun = time.process_time()
    told: Any = None
    refused = 0
    try:
        told = scene.update(frame)
    except nextview.NextviewError as error:
        print(f"    refused: {error}", file=sys.stderr)
        refused = 1
    return told, {"refused": refused, "seconds": [time.process_time() - begun]}


def found_in(scene: nextview.Scene) -> list[Found]:
    """All names that a scene gives."""
    return [
        Found(one.name, one.confident, one.pose)
        for one in scene.objects
        if one.name != UNKNOWN and one.pose is not None
    ]


def middle(points: Float) -> Float:
    """The middle of some points, (3,)."""
    return np.asarray((points.min(0) + points.max(0)) / 2)


def millimetres_off(true: Float, shape: tuple[Float, Float], pose: Float) -> float:
    """Mean distance of points on a thing from the surface of its posed scan."""
    points, normals = moved(shape[0], pose), shape[1] @ pose[:3, :3].T
    compared = true[::COMPARED]
    nearest = cKDTree(points).query(compared)[1]
    across = ((compared - points[nearest]) * normals[nearest]).sum(1)
    return 1000 * float(np.abs(across).mean())


def compared(
    found: Sequence[Found],
    seen: Case,
    frame: int,
    shapes: Shapes,
) -> Row:
    """Compare the names that are given after a frame with the truth."""
    names = seen.names.tolist()
    there = np.isfinite(seen.poses[frame, :, 0, 0])
    true = [moved(*pair) for pair in zip(seen.points, seen.poses[frame], strict=True)]
    known = {
        number
        for number, name in enumerate(names)
        if there[number]
        and not name.startswith(STRANGER)
        and (seen.labels[: frame + 1] == number + 1).sum((1, 2)).max() >= IN_VIEW
    }

    row = tally(len(known))
    taken = set()
    for one in found:
        centre = middle(moved(shapes[one.name][0], one.pose))
        number = names.index(one.name) if one.name in names else None
        if (
            number is not None
            and number not in taken
            and np.linalg.norm(centre - middle(true[number])) < NEAR
        ):
            taken.add(number)
            if number in known:  # hardly visible things count neither way
                count(row, one, right=True)
                off = millimetres_off(true[number], shapes[one.name], one.pose)
                row["mm"].append(off)
            continue
        count(row, one, right=False)
        nearest = nearest_of(true, there, centre)
        if names[nearest].startswith(STRANGER):
            row["on strangers"] += 1
            row["sure on strangers"] += one.confident
    row["missed"] = [names[number] for number in sorted(known - taken)]
    return row


def tally(known: int) -> Row:
    """A row in which nothing is counted yet."""
    counted = ("right", "named", "sure right", "sure wrong", "on strangers")
    row: Row = {"known": known, **dict.fromkeys(counted, 0), "sure on strangers": 0}
    return {**row, "mm": [], "wrong": []}


def count(row: Row, one: Found, right: bool) -> None:
    """Count a name in a row."""
    row["named"] += 1
    row["right"] += right
    row["sure right"] += right and one.confident
    row["sure wrong"] += one.confident and not right
    if not right:
        row["wrong"].append(one.name + " (sure)" * one.confident)


def nearest_of(true: Sequence[Float], there: Mask, place: Float) -> int:
    """The thing with the point that is nearest to a place."""
    distances = [
        np.linalg.norm(points - place, axis=1).min() if is_there else np.inf
        for points, is_there in zip(true, there, strict=True)
    ]
    return int(np.argmin(distances))


def in_scenes(
    bench: Bench,
    part: str,
    system: nextview.System,
    shapes: Shapes,
) -> Iterator[Row]:
    """Show each case of a part to a scene of its own; a row for each frame."""
    for name, seen in bench.cases(part):
        scene = nextview.Scene(system)
        for frame in range(len(seen.depth)):
            cost = updated(scene, frame_of(seen, frame))[1]
            of_many = f", frame {frame + 1}" if len(seen.depth) > 1 else ""
            yield {
                "group": f"{seen.kind}{of_many}",
                "case": name,
                **compared(found_in(scene), seen, frame, shapes),
                **cost,
            }


def tables(bench: Bench) -> Iterator[Row]:
    """Tables of taught things and strangers."""
    yield from in_scenes(bench, "tables", bench.system(), bench.shapes)


def places(bench: Bench) -> Iterator[Row]:
    """Things that are partly hidden or cut off."""
    yield from in_scenes(bench, "places", bench.system(), bench.shapes)


def single(bench: Bench) -> Iterator[Row]:
    """Single things by their masks."""
    system = bench.system()
    shapes = bench.shapes
    for name, seen in bench.cases("single"):
        session = system.session()
        cost = updated(session, frame_of(seen, 0, seen.labels[0] == 1))[1]
        found = []
        if not cost["refused"]:
            said = session.result
            if said.answer is not None and said.pose is not None:
                found = [Found(said.answer, said.confident, said.pose)]
        row = compared(found, seen, 0, shapes)
        yield {"group": "by mask", "case": name, **row, **cost}


def parts(bench: Bench) -> Iterator[Row]:
    """Machine parts, taught and shown."""
    meshes = machine_parts()
    with tempfile.TemporaryDirectory() as folder:
        scans, memory = Path(folder, "scans"), Path(folder, "memory")
        scans.mkdir()
        for name, mesh in meshes.items():
            mesh.export(scans / f"{name}.ply")
        begun = time.process_time()
        nextview.learn(scans, memory, unit="m", workers=0)
        seconds = time.process_time() - begun
        yield {"group": "teaching", "case": "teaching", "seconds": [seconds]}
        system = nextview.load(str(memory), threads=1)
        shapes = {name: cloud(mesh) for name, mesh in meshes.items()}
        yield from in_scenes(bench, "parts", system, shapes)


def moves(bench: Bench) -> Iterator[Row]:
    """Things that are moved or removed between frames."""
    system = bench.system()
    shapes = bench.shapes
    for name, seen in bench.cases("moves"):
        scene = nextview.Scene(system)
        same = (seen.poses == seen.poses[0]).all((2, 3)).all(0)
        changed = int(np.argmin(same))
        row: Row = {"group": str(seen.kind), "case": name, "changes": 1}
        row |= {"told": 0, "kind right": 0, "false alarms": 0, "refused": 0}
        row["seconds"] = []
        for frame in range(len(seen.depth)):
            before = {one.number: one.place for one in scene.objects}
            look, cost = updated(scene, frame_of(seen, frame))
            row["refused"] += cost["refused"]
            row["seconds"] += cost["seconds"]
            if look is None:
                continue
            stood = seen.poses[max(frame - 1, 0)]
            there = np.isfinite(stood[:, 0, 0])
            true = [moved(*pair) for pair in zip(seen.points, stood, strict=True)]
            alarms = [("moved", one.number) for one in look.moved]
            alarms += [("removed", number) for number in look.gone]
            for kind, number in alarms:
                owner = nearest_of(true, there, before[number])
                if frame < 3 or owner != changed:
                    row["false alarms"] += 1
                    continue
                row["told"] = 1
                row["kind right"] |= kind == seen.kind
        last = len(seen.depth) - 1
        yield {**compared(found_in(scene), seen, last, shapes), **row}


def real(bench: Bench) -> Iterator[Row]:
    """Real frames, each alone and without a pose."""
    system = bench.system()
    shapes = bench.shapes
    for group, name, frame, things in real_frames(bench):
        scene = nextview.Scene(system, up=None)
        cost = updated(scene, frame)[1]
        row = tally(len(things))
        missed = dict(things)
        for one in found_in(scene):
            pixels = missed.get(one.name)
            right = pixels is not None and meets(one, pixels, frame, shapes)
            if right:
                del missed[one.name]
            count(row, one, right)
        yield {"group": group, "case": name, **row, "missed": [*missed], **cost}


def real_frames(
    bench: Bench,
) -> Iterator[tuple[str, str, Frame, list[tuple[str, Mask]]]]:
    """Group, name, frame, and the taught things in it with some of their pixels."""
    for group in ("real_taught", "real_ycb", "real_tables"):
        if not (bench.data / group).is_dir():
            sys.exit(f"{bench.data}: holds no folder {group}")

    folder = bench.data / "real_taught"
    truth = json.loads((folder / "truth.json").read_text())
    for name in sorted(truth)[:: bench.every]:
        frame = frame_in(folder / name)
        rows, columns = np.indices(frame.depth.shape)
        things = [
            (
                one["name"],
                np.hypot(rows - one["row"], columns - one["column"]) <= PIXELS_NEAR,
            )
            for one in truth[name]
        ]
        yield "taught", name, frame, things

    folder = bench.data / "real_ycb"
    names = (folder / "names.txt").read_text().split()
    for path in sorted(folder.glob("*.depth.png"))[:: bench.every]:
        name = path.name.split(".")[0]
        labels = np.asarray(Image.open(folder / f"{name}.labels.png"))
        things = [
            (names[number], labels == number)
            for number in range(1, len(names))
            if (labels == number).sum() >= LEAST_LABEL
        ]
        yield "labelled", name, Frame(np.asarray(Image.open(path)), REAL_YCB), things

    files = sorted((bench.data / "real_tables").glob("*/depth.png"))
    for path in files[:: len(files) // REAL_TABLES][: REAL_TABLES : bench.every]:
        yield "none taught", path.parent.name, frame_in(path.parent), []


def frame_in(folder: Path) -> Frame:
    """The frame in a folder, without a pose."""
    fx, fy, cx, cy = json.loads((folder / "K.json").read_text())
    depth = np.asarray(Image.open(folder / "depth.png"))
    scale = folder / "scale.json"
    if scale.exists():
        depth = depth.astype(np.float32) * json.loads(scale.read_text())
    return Frame(depth, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))


def meets(one: Found, pixels: Mask, frame: Frame, shapes: Shapes) -> bool:
    """Whether a posed scan shows in some of the pixels of a frame without a pose."""
    seen = moved(shapes[one.name][0], one.pose) @ frame.intrinsics.T
    columns, rows = np.floor(seen[:, :2] / seen[:, 2:]).astype(int).T
    height, width = pixels.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return bool(pixels[rows[inside], columns[inside]].any())


def counts(bench: Bench) -> Iterator[Row]:
    """What the package consists of, by its folders."""
    package = Path(nextview.__file__).parent
    for path in sorted(package.rglob("*.py")):
        tree = ast.parse(path.read_text())
        inside = path.relative_to(package).parts
        yield {
            "group": inside[0] if len(inside) > 1 else "(top)",
            "case": "/".join(inside),
            "statements": sum(isinstance(node, ast.stmt) for node in ast.walk(tree)),
            "modules": 1,
            "numbers": named_numbers(tree),
        }


def named_numbers(tree: ast.Module) -> int:
    """Constants of a module or a class, and defaults of arguments, that hold a number."""
    values: list[ast.expr | None] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef):
            values += [
                one.value
                for one in node.body
                if isinstance(one, ast.Assign | ast.AnnAssign)
            ]
        elif isinstance(node, ast.arguments):
            values += [*node.defaults, *node.kw_defaults]
    return sum(
        any(
            isinstance(one, ast.Constant) and type(one.value) in (int, float)
            for one in ast.walk(value)
        )
        for value in values
        if value is not None
    )


PARTS: dict[Part, Callable[[Bench], Iterator[Row]]] = {
    "tables": tables,
    "single": single,
    "parts": parts,
    "moves": moves,
    "places": places,
    "real": real,
    "counts": counts,
}


def summed(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The figures of each group of rows, and of all."""
    groups = {row["group"]: None for row in rows}
    figures = {}
    for group in [*groups, "all"]:
        own = [row for row in rows if group in (row["group"], "all")]
        figure: dict[str, float] = {}
        for column in dict.fromkeys(column for row in own for column in row):
            values = [row[column] for row in own if column in row]
            if column in SPREAD:
                each = [value for some in values for value in some]
                if each:
                    figure[f"{column}, median"] = round(float(np.median(each)), 2)
                    figure[f"{column}, worst"] = round(max(each), 2)
            elif isinstance(values[0], int):
                figure[column] = sum(int(value) for value in values)
        if figure.get("named"):
            figure["precision %"] = round(100 * figure["right"] / figure["named"])
        figures[group] = figure
    return figures


def table_of(figures: dict[str, Any], against: dict[str, Any] | None) -> str:
    """A table of the figures of a part, with those of another run in brackets."""
    columns = [*dict.fromkeys(name for figure in figures.values() for name in figure)]
    lines = [["", *columns]]
    for group, figure in figures.items():
        line = [group]
        for column in columns:
            value = figure.get(column)
            said = "" if value is None else f"{value:g}"
            before = None if against is None else against.get(group, {}).get(column)
            if value is not None and before is not None:
                said = f"{before:g} > {value:g} ({value - before:+.4g})"
            line.append(said)
        lines.append(line)
    widths = [max(map(len, some)) for some in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            [line[0].ljust(widths[0])]
            + [
                one.rjust(width)
                for one, width in zip(line[1:], widths[1:], strict=True)
            ]
        )
        for line in lines
    )


def measured(part: Part, bench: Bench) -> dict[str, Any]:
    """The rows and the figures of a part, which is measured now."""
    rows = []
    begun = time.process_time()
    for row in PARTS[part](bench):
        rows.append(row)
        if part != "counts":
            line = (
                f"{part}: {len(rows)} rows, {time.process_time() - begun:.0f} s of CPU"
            )
            print(line, file=sys.stderr)
    return {"figures": summed(rows), "rows": rows}


def main(
    data: tyro.conf.Positional[Path | None] = None,
    out: Path | None = None,
    against: Path | None = None,
    only: tuple[Part, ...] = (),
    quick: bool = False,
    frames: Path = DEFAULT_FRAMES,
) -> None:
    """Measure all parts, and print a table for each.

    Args:
        data: folder of the scans and of the real frames; by default NEXTVIEW_DATA.
        out: JSON file of the results, which keeps finished parts.
        against: JSON file of another run, whose figures are printed as "other > this (change)".
        only: parts to measure.
        quick: measure a third of the cases.
        frames: folder of the drawn frames.
    """
    folder = data or os.environ.get("NEXTVIEW_DATA")
    if folder is None:
        sys.exit("name the folder of the data, or set NEXTVIEW_DATA")
    bench = Bench(Path(folder), frames.expanduser(), 3 if quick else 1)
    kept: dict[str, Any] = {"quick": quick, "parts": {}}
    other: dict[str, Any] = {"quick": quick, "parts": {}}
    if out is not None and out.exists():
        kept = json.loads(out.read_text())
    if against is not None:
        other = json.loads(against.read_text())
    for file, run in ((out, kept), (against, other)):
        if run["quick"] != quick:
            sys.exit(f"{file}: one of the two runs is quick, the other is not")

    for part in only or PARTS:
        if part not in kept["parts"]:
            kept["parts"][part] = measured(part, bench)
            if out is not None:
                half = out.with_name(f"{out.name}.half")
                half.write_text(json.dumps(kept, indent=1))
                half.rename(out)
        before = other["parts"].get(part, {}).get("figures")
        print(
            f"\n{part}\n{table_of(kept['parts'][part]['figures'], before)}", flush=True
        )


if __name__ == "__main__":
    tyro.cli(main)
