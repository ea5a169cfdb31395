"""Whether answers got better or worse: one command before and after a change of the recognition.

    python -m benchmarks.gate [DATA] [--out FILE] [--against FILE] [--only PART ...] [--quick]

DATA, by default the environment variable NEXTVIEW_DATA, holds the scans of the bundled memory,
YCB/NAME.ply, in metres, and three folders of real frames, real_taught, real_ycb and real_tables,
that ``nextview_lab.data.real_frames`` reads. All other frames are drawn once by
``benchmarks.gate_frames`` and kept in the folder ``--frames``. Only the public interface of
nextview is used.

| part | what |
|---|---|
| tables | 15 tables, three frames each: things 0 to 3 cm apart, some of them strangers; the last \
three with things in a bowl, on a box, and leaning |
| single | 30 things, each by its mask in one frame, in a session; two things of each table in its \
three frames |
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

import ast
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
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
    middle,
    moved,
    scan,
)
from nextview.sensing import Frame
from nextview_lab.benchmark.real import pixels_met
from nextview_lab.data.real_frames import (
    RealFrame,
    Shot,
    Told,
    real_frames,
    write_frames,
)

Part = Literal["tables", "single", "parts", "moves", "places", "real", "counts"]
Row = dict[str, Any]
Mask = NDArray[np.bool_]
Shapes = dict[str, tuple[Float, Float]]  # points on each scan and normals there

IN_VIEW = 500  # pixels of a thing, from which on it counts
NEAR = 0.03  # metres from the true middle
REAL = {  # folder: what is in it, intrinsics that it does not hold, and how many frames
    "real_taught": ("taught", None, 5),
    "real_ycb": ("labelled", (618.017, 618.003, 312.377, 232.375), 2),
    "real_tables": ("none taught", None, 12),
}
OF_TABLE = 2  # things of each table that a session is shown by their masks
CHANGED = 3  # number of the first frame after a move
SPREAD = ("mm", "seconds")  # columns of which median and worst are shown


@dataclass(frozen=True, eq=False)
class Bench:
    """What parts share: the folders of the data and of the drawn frames, and that each so manyth
    case is measured.
    """

    data: Path
    frames: Path
    every: int

    @property
    def scans(self) -> dict[str, Path]:
        """Files of the scans by their names."""
        return {path.stem: path for path in sorted((self.data / "YCB").glob("*.ply"))}

    def taught(self) -> tuple[nextview.System, Shapes]:
        """The bundled system, and the scans that it knows."""
        system = nextview.load("ycb", threads=1)
        missing = set(system.classes) - set(self.scans)
        if missing:
            sys.exit(f"{self.data}/YCB: holds no scan of {min(missing)}")
        return system, {name: cloud(scan(path)) for name, path in self.scans.items()}

    def cases(self, part: str) -> Iterator[tuple[str, Case]]:
        """The cases of a part, each with its name."""
        for number in range(0, DRAWS[part][1], self.every):
            yield f"{part} {number}", case(part, number, self.scans, self.frames)


def updated(scene: nextview.Session | nextview.Scene, frame: Frame) -> tuple[Any, Row]:
    """Give a frame to a scene or a session; what it returns, and the seconds that it took."""
    begun = time.process_time()
    told = None
    try:
        told = scene.update(frame)
    except nextview.NextviewError as error:
        print(f"    refused: {error}", file=sys.stderr)
    seconds = time.process_time() - begun
    return told, {"refused": int(told is None), "seconds": [seconds]}


def frame_of(seen: Case, number: int, mask: Mask | None = None) -> Frame:
    """A frame of a case."""
    return Frame(seen.depth[number], INTRINSICS, seen.told[number], mask)


def named_in(scene: nextview.Scene) -> list[Any]:
    """The objects to which a scene gives a name."""
    return [one for one in scene.objects if one.name != "unknown"]


def millimetres_off(true: Float, shape: tuple[Float, Float], pose: Float) -> float:
    """Mean distance of points on a thing from the surface of its posed scan."""
    points, normals = moved(shape[0], pose), shape[1] @ pose[:3, :3].T
    some = true[::8]  # enough for a mean
    nearest = cKDTree(points).query(some)[1]
    across = ((some - points[nearest]) * normals[nearest]).sum(1)
    return 1000 * float(np.abs(across).mean())


def compared(found: Sequence[Any], seen: Case, frame: int, shapes: Shapes) -> Row:
    """Compare the names that are given after a frame with the truth.

    Args:
        found: objects with a name, whether it is confident, and the pose of their scan.
        seen: the case.
        frame: number of the frame.
        shapes: points on the scans by their names.
    """
    names = seen.names.tolist()
    poses = seen.poses[frame]
    true = dict(zip(names, map(moved, seen.points, poses), strict=True))
    counts = [
        (seen.labels[: frame + 1] == n).sum((1, 2)).max()
        for n in range(1, len(names) + 1)
    ]
    known = {
        name
        for name, pose, pixels in zip(names, poses, counts, strict=True)
        if name in shapes and np.isfinite(pose).all() and pixels >= IN_VIEW
    }
    right: set[str] = set()
    judged = []
    on_strangers = []
    off = []
    for one in found:
        centre = middle(moved(shapes[one.name][0], one.pose))
        own = true.get(one.name, np.full((1, 3), np.inf))
        at = one.name not in right and np.linalg.norm(centre - middle(own)) < NEAR
        if not at or one.name in known:  # a thing that hardly shows counts neither way
            judged.append((one, bool(at)))
        if at:
            right.add(one.name)
            off.append(millimetres_off(own, shapes[one.name], one.pose))
        elif nearest_of(true, centre).startswith(STRANGER):
            on_strangers.append(one)
    return {
        **row_of(known, judged),
        "on strangers": len(on_strangers),
        "sure on strangers": sum(one.confident for one in on_strangers),
        "mm": off,
    }


def row_of(known: set[str], judged: Sequence[tuple[Any, bool]]) -> Row:
    """Count the names that are given, each of which is right or not."""
    right = [one for one, is_right in judged if is_right]
    wrong = [one for one, is_right in judged if not is_right]
    return {
        "known": len(known),
        "right": len(right),
        "named": len(judged),
        "sure right": sum(one.confident for one in right),
        "sure wrong": sum(one.confident for one in wrong),
        "missed": sorted(known - {one.name for one in right}),
        "wrong": [one.name + " (sure)" * one.confident for one in wrong],
    }


def nearest_of(true: dict[str, Float], place: Float) -> str:
    """The thing with the point that is nearest to a place; those that are gone have none."""
    distances = [
        np.linalg.norm(points - place, axis=1).min() for points in true.values()
    ]
    return list(true)[np.nanargmin(distances)]


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
            row = compared(named_in(scene), seen, frame, shapes)
            group = f"{seen.kind} {frame + 1}"
            yield {"group": group, "case": name, **row, **cost}


def tables(bench: Bench) -> Iterator[Row]:
    """Tables of taught things and strangers."""
    return in_scenes(bench, "tables", *bench.taught())


def places(bench: Bench) -> Iterator[Row]:
    """Things that are partly hidden or cut off."""
    return in_scenes(bench, "places", *bench.taught())


def single(bench: Bench) -> Iterator[Row]:
    """Single things by their masks: in one frame, and two of each table in all its frames."""
    system, shapes = bench.taught()
    cases = list(bench.cases("single"))
    for name, seen in bench.cases("tables"):
        cases += [(f"{name}, {one}", only(seen, one)) for one in range(OF_TABLE)]
    for name, seen in cases:
        session = system.session()
        for frame in range(len(seen.depth)):
            mask = seen.labels[frame] > 0
            cost: Row = {"refused": 0, "seconds": []}
            if mask.any() and not session.done:
                _, cost = updated(session, frame_of(seen, frame, mask))
            found = []
            said = session.result if session.views else None
            if said is not None and said.answer is not None:
                found.append(
                    SimpleNamespace(
                        name=said.answer, confident=said.confident, pose=said.pose
                    )
                )
            row = compared(found, seen, frame, shapes)
            group = f"{seen.kind}, view {frame + 1}"
            yield {"group": group, "case": name, **row, **cost}


def only(seen: Case, one: int) -> Case:
    """A case of which one thing counts."""
    return replace(
        seen,
        labels=(seen.labels == one + 1).astype(np.uint8),
        names=seen.names[one : one + 1],
        poses=seen.poses[:, one : one + 1],
        points=seen.points[one : one + 1],
    )


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
    system, shapes = bench.taught()
    for name, seen in bench.cases("moves"):
        scene = nextview.Scene(system)
        same = (seen.poses == seen.poses[0]).all((0, 2, 3))
        changed = seen.names[np.argmin(same)]
        told: list[str] = []  # of what was changed, once it was
        alarms: list[str] = []
        costs = []
        for frame in range(len(seen.depth)):
            before = {one.number: one.place for one in scene.objects}
            look, cost = updated(scene, frame_of(seen, frame))
            costs.append(cost)
            stood = map(moved, seen.points, seen.poses[max(frame - 1, 0)])
            true = dict(zip(seen.names.tolist(), stood, strict=True))
            said = {} if look is None else dict.fromkeys(look.gone, "removed")
            said |= {} if look is None else {one.number: "moved" for one in look.moved}
            for number, kind in said.items():
                right = frame >= CHANGED and nearest_of(true, before[number]) == changed
                (told if right else alarms).append(kind)
        yield {
            "group": str(seen.kind),
            "case": name,
            "changes": 1,
            "told": int(bool(told)),
            "kind right": int(str(seen.kind) in told),
            "false alarms": len(alarms),
            **compared(named_in(scene), seen, len(costs) - 1, shapes),
            "refused": sum(cost["refused"] for cost in costs),
            "seconds": [second for cost in costs for second in cost["seconds"]],
        }


def real(bench: Bench) -> Iterator[Row]:
    """Real frames, each alone and without a pose."""
    system, shapes = bench.taught()
    for group, seen in real_cases(bench):
        scene = nextview.Scene(system, up=None)
        cost = updated(scene, seen.read())[1]
        judged = []
        left = {
            one.name: one.pixels
            for one in seen.things()
            if one.name and one.pixels is not None
        }
        known = set(left)
        for one in named_in(scene):
            points = moved(shapes[one.name][0], one.pose)
            right = one.name in left and pixels_met(
                points, seen.captured.intrinsics, left[one.name]
            )
            judged.append((one, bool(right)))
            if right:
                del left[one.name]
        yield {"group": group, "case": seen.name, **row_of(known, judged), **cost}


def real_cases(bench: Bench) -> Iterator[tuple[str, RealFrame]]:
    """Real frames, each with its group."""
    for folder, (group, camera, most) in REAL.items():
        frames = real_frames(bench.data / folder, camera)
        for seen in frames[:: max(1, len(frames) // most)][: most : bench.every]:
            yield group, seen


def write_tables(bench: Bench, folder: Path) -> None:
    """Write the frames of all tables as ``nextview-lab real`` reads them."""
    shots: dict[str, Shot] = {}
    for name, seen in bench.cases("tables"):
        told = [
            Told(name="" if thing.startswith(STRANGER) else thing, label=number)
            for number, thing in enumerate(seen.names.tolist(), 1)
        ]
        for frame, (depth, labels) in enumerate(
            zip(seen.depth, seen.labels, strict=True)
        ):
            shots[f"{name}, {frame}"] = depth, labels, told
    write_frames(folder, INTRINSICS, shots)


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


def summed(rows: Sequence[Row]) -> dict[str, float]:
    """The figures of some rows."""
    figures: dict[str, float] = {}
    for column in dict.fromkeys(column for row in rows for column in row):
        values = [row[column] for row in rows if column in row]
        if column in SPREAD and any(values):
            each = np.concatenate(values)
            figures[f"{column}, median"] = round(float(np.median(each)), 2)
            figures[f"{column}, worst"] = round(float(each.max()), 2)
        elif isinstance(values[0], int):
            figures[column] = sum(values)
    if figures.get("named"):
        figures["precision %"] = round(100 * figures["right"] / figures["named"])
    return figures


def cell(now: float | None, before: float | None) -> str:
    """A figure, and how it was before if it has changed."""
    if before is None or now == before:
        return "" if now is None else f"{now:g}"
    if now is None:
        return f"{before:g} > none"
    return f"{before:g} > {now:g} ({now - before:+.3g})"


def table_of(figures: dict[str, Any], against: dict[str, Any]) -> str:
    """A table of the figures of a part, a row for each group, beside those of another run."""
    rows = [*figures.values(), *against.values()]
    columns = [*dict.fromkeys(name for figure in rows for name in figure)]
    lines = [["", *columns]]
    for group, now in figures.items():
        before = against.get(group, {})
        said = [cell(now.get(name), before.get(name)) for name in columns]
        lines.append([group, *said])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])])
        for line in lines
    )


def measured(part: Part, bench: Bench) -> dict[str, Any]:
    """The rows and the figures of a part, which is measured now."""
    rows = []
    for row in PARTS[part](bench):
        rows.append(row)
        print(f"{row['case']}: {row['group']}", file=sys.stderr)
    groups = dict.fromkeys(row["group"] for row in rows)
    figures = {
        name: summed([row for row in rows if row["group"] == name]) for name in groups
    }
    return {"figures": {**figures, "all": summed(rows)}, "rows": rows}


def run_in(file: Path | None, quick: bool) -> dict[str, Any]:
    """A run that is in a file, or that begins."""
    if file is None:
        return {"quick": quick, "parts": {}}
    run: dict[str, Any] = json.loads(file.read_text())
    if run["quick"] != quick:
        sys.exit(f"{file}: one of the two runs is quick, the other is not")
    return run


def main(
    data: tyro.conf.Positional[Path] = Path(os.environ.get("NEXTVIEW_DATA", "data")),
    out: Path | None = None,
    against: Path | None = None,
    only: tuple[Part, ...] = (),
    quick: bool = False,
    frames: Path = Path("~/.cache/nextview/gate"),
    write_to: Path | None = None,
) -> None:
    """Measure all parts, and print a table for each.

    Args:
        data: folder of the scans and of the real frames.
        out: JSON file of the results, which keeps finished parts.
        against: JSON file of another run, whose figures are printed as "other > this (change)".
        only: parts to measure.
        quick: measure a third of the cases.
        frames: folder of the drawn frames.
        write_to: write the frames of the tables to this folder, and measure nothing.
    """
    bench = Bench(data, frames.expanduser(), 3 if quick else 1)
    if write_to is not None:
        write_tables(bench, write_to)
        return
    kept, other = (
        run_in(out if out and out.exists() else None, quick),
        run_in(against, quick),
    )
    for part in only or PARTS:
        if part not in kept["parts"]:
            kept["parts"][part] = measured(part, bench)
            if out is not None:
                half = out.with_name(f"{out.name}.half")
                half.write_text(json.dumps(kept, indent=1))
                half.rename(out)
        before = other["parts"].get(part, {}).get("figures", {})
        table = table_of(kept["parts"][part]["figures"], before)
        print(f"\n{part}\n{table}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
