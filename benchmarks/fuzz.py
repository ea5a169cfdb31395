"""Damage files and frames at random and take them: each must do or be refused in one sentence, soon and in little room.

    python benchmarks/fuzz.py --minutes 5 --seed 0
    python benchmarks/fuzz.py --count 200000 --kinds off obj ply stl glb

Each case runs in a process with a memory limit and a time limit. For each kind are counted the cases that were
read (loaded), were refused in one sentence (refused), ended their process (crash), ran into the time limit (hang), and
that raised anything else or printed more than sentences of nextview (error). The exit status is 1 if there was any of
the last three.

A case is told by its kind and number and is the same for the same seed: --case KIND NUMBER runs it alone, in this
process and without limits, and leaves what it reads in --keep FOLDER.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import fuzz_frames
import numpy as np
import tyro

MEMORY = 2 << 30
"""Bytes that a process may take beyond what it has when everything is imported."""
SECONDS, WAIT = 10, 300
"""Seconds of computing, and in all, that a case may take; the latter are for what waits for ever."""
BATCH = 20
"""Cases of a kind in a row."""
PRINTED = "printed"
"""Where the process that reads puts what it prints, in the folder of the sound inputs."""
GOOD, BAD = ("loaded", "refused"), ("crash", "hang", "error")

Change = Callable[[np.random.Generator, bytes], bytes]


@dataclass(frozen=True)
class Kind:
    """A kind of input.

    Attributes:
        make: writes sound inputs into a folder, and beside them what else they need.
        damage: writes a damaged one into a folder, made from one of the sound ones; returns its path. Of what is no
            file, it writes there what it is, and returns the thing itself.
        take: reads what ``damage`` returned, or a sound one; raises nothing but a NextviewError.
        inputs: pattern of the names of the inputs.
    """

    make: Callable[[Path], None]
    damage: Callable[[np.random.Generator, list[Path], Path], Any]
    take: Callable[[Any], None]
    inputs: str = "*"


# How files are damaged

WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e999",
    "9" * 30,
    "150000000",
    "4294967295",
    "1.5",
    "",
    " ",
    "\n",
    "x",
    "-0.0",
    "1_0",
)
JUNK: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 150_000_000, 10**40, 1e308, float("nan"), 0.5, "", "x", "..", "\x1b[1m", "\ud800",
    "x" * 5000, [], [[]], {}, [1, 2, 3], {"a": 1},
)  # fmt: skip


def change_bytes(rng: np.random.Generator, data: bytes) -> bytes:
    """A few times: a bit, a piece or a number of a file changed, taken out, or there many times; or its end cut off."""
    for _ in range(rng.integers(1, 5)):
        at, length = int(rng.integers(len(data) + 1)), int(rng.integers(1, 2 ** rng.integers(1, 12)))
        before, piece, after = data[:at], data[at : at + length], data[at + length :]
        changed = [
            before + bytes([byte ^ 1 << int(rng.integers(8)) for byte in piece[:1]]) + piece[1:] + after,
            before + rng.bytes(len(piece)) + after,
            before + after,
            before + piece * int(rng.integers(2, 100)) + after,
            before,
            before + str(rng.choice(WORDS)).encode() + data[at + int(rng.integers(8)) :],
            before + struct.pack(str(rng.choice(["<I", ">I", "<f", "<H"])), int(rng.integers(2**16))) + data[at + 4 :],
            before + bytes([rng.choice([0, 9, 10, 13, 32, 35, 255])]) * length + after,
        ]
        data = changed[rng.integers(len(changed))]
    return data


def change_json(rng: np.random.Generator, text: bytes) -> bytes:
    """A few values somewhere in JSON replaced by junk or taken out; now and then deep brackets, or bytes changed."""
    if rng.random() < 0.2:
        return change_bytes(rng, text)
    facts = json.loads(text)
    for _ in range(rng.integers(1, 4)):
        holder, inside = facts, facts
        while isinstance(inside, dict | list) and inside and (inside is facts or rng.random() < 0.8):
            holder, place = inside, int(rng.integers(len(inside)))
            key: Any = list(inside)[place] if isinstance(inside, dict) else place
            inside = holder[key]
        if holder and rng.random() < 0.2:
            del holder[key]
        elif holder:
            holder[key] = deepcopy(JUNK[rng.integers(len(JUNK))])
    if rng.random() < 0.02:
        facts = {"deep": "DEEP"} | facts if isinstance(facts, dict) else ["DEEP"]
    return json.dumps(facts).encode().replace(b'"DEEP"', b"[" * 100_000 + b"]" * 100_000)


def change_glb(rng: np.random.Generator, data: bytes) -> bytes:
    """Bytes of a GLB changed, or its JSON."""
    if rng.random() < 0.4:
        return change_bytes(rng, data)
    length = int.from_bytes(data[12:16], "little")
    text = change_json(rng, data[20 : 20 + length])
    rest = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + length :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(rest)) + rest


def change_arrays(rng: np.random.Generator, data: bytes) -> bytes:
    """Bytes of an .npz changed, or one of its arrays: its type, its shape, a value, or whether it is there."""
    if rng.random() < 0.5:
        return change_bytes(rng, data)
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    name = list(arrays)[rng.integers(len(arrays))]
    array = arrays[name]
    junk = np.array(str(rng.choice([*WORDS, "[" * 100_000, "null", '{"correlation": -1, "temperature_of_one": "x"}'])))
    flat = array.ravel().copy()
    if flat.size and flat.dtype.kind in "fiu":
        with np.errstate(all="ignore"):
            flat[rng.integers(flat.size)] = (
                rng.choice([np.nan, np.inf, -1.0, 1e38, 7.0]) if flat.dtype.kind == "f" else -1
            )
    others = [array[..., :-1] if array.ndim else array[None], array[:0] if array.ndim else junk, array[None], array.T]
    others += [array.astype("U"), np.zeros(array.shape, str(rng.choice(["f8", "c8", "i1", "?", "M8[s]", "V3"]))), junk]
    others += [flat.reshape(array.shape), arrays[list(arrays)[rng.integers(len(arrays))]]]
    arrays[name] = others[rng.integers(len(others))]
    if rng.random() < 0.1:
        arrays[f"{name}x"] = arrays.pop(name)
    written = io.BytesIO()
    np.savez(written, **arrays)  # type: ignore[arg-type]
    return written.getvalue()


def damage_file(change: Change, rng: np.random.Generator, sound: list[Path], case: Path) -> Path:
    """Change one of the sound files; what has its name but for the suffix is put beside it as it is."""
    chosen = sound[rng.integers(len(sound))]
    for path in chosen.parent.glob(f"{chosen.stem}.*"):
        if path != chosen:
            (case / path.name).symlink_to(path)
    (case / chosen.name).write_bytes(change(rng, chosen.read_bytes()))
    return case / chosen.name


def damage_folder(rng: np.random.Generator, sound: list[Path], case: Path) -> Path:
    """Change, empty or take out a file or two anywhere in one of the sound folders."""
    chosen = sound[rng.integers(len(sound))]
    shutil.copytree(chosen, case / chosen.name)
    files = sorted(path for path in (case / chosen.name).rglob("*") if path.is_file())
    for place in rng.permutation(len(files))[: rng.integers(1, 3)]:
        path = files[place]
        if rng.random() < 0.1:
            path.unlink()
        else:
            data = path.read_bytes()
            path.write_bytes((change_json if path.suffix == ".json" and data else change_bytes)(rng, data))
    return case / chosen.name


# What is damaged

PLY = """ply
format ascii 1.0
element vertex 5
property float x
property float y
property float z
property uchar red
element face 5
property list uchar int vertex_indices
property uchar flag
element edge 1
property int vertex1
property int vertex2
end_header
0 0 0 1
2 0 0 2
2 2 0 3
0 2 0 4
1 1 3 5
4 0 3 2 1 7
3 0 1 4 7
3 1 2 4 7
3 2 3 4 7
3 3 0 4 7
0 1
"""
OBJ = "o a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0 # c\nvt 0 0\nf 1/1/1 2//1 3/1 4\ng b\nv 0 0 1\nf -1 1 \\\n 2\n"
OFF = "COFF # c\n4 3 0\n\n0 0 0 255 0 0\n1 0 0 0 255 0\n1 1 0 1 2 3\n0 1 1 9 9 9\n4 0 1 2 3\n3 0 1 2 255 0 0\n2 0 1\n"


def make_meshes(suffix: str, folder: Path) -> None:
    """Small shapes in a format, as trimesh writes it and by hand."""
    import trimesh

    shape = trimesh.creation.box((1, 2, 3))
    scene = trimesh.Scene([shape, trimesh.creation.icosphere(0).apply_translation((3, 0, 0))])
    exports: dict[str, list[Any]] = {
        ".off": [shape.export(file_type="off"), OFF],
        ".obj": [shape.export(file_type="obj"), OBJ],
        ".ply": [shape.export(file_type="ply"), shape.export(file_type="ply", encoding="ascii"), PLY],
        ".stl": [shape.export(file_type="stl"), shape.export(file_type="stl_ascii")],
        ".glb": [shape.export(file_type="glb"), scene.export(file_type="glb")],
    }
    for i, content in enumerate(exports[suffix]):
        (folder / f"shape{i}{suffix}").write_bytes(content.encode() if isinstance(content, str) else content)


def take_mesh(path: Path) -> None:
    """Read a mesh and look at it."""
    from nextview.cameras.simulated import SimulatedCamera
    from nextview.mesh import load_mesh
    from nextview.viewsphere import ViewSphere

    mesh = load_mesh(path)
    assert np.isfinite(mesh.vertices).all()
    SimulatedCamera(mesh, 16).observe(ViewSphere.named("12").poses[0])


def make_predictions(folder: Path) -> None:
    """Predictions of two objects."""
    from nextview.belief import Calibration
    from nextview.data.predictions import Predictions
    from nextview.viewsphere import ViewSphere

    rng, sphere = np.random.default_rng(0), ViewSphere.named("12")
    shape = (2, len(sphere))
    Predictions(
        rng.normal(size=(*shape, 3)).astype(np.float32),
        {"lem": rng.random((*shape, sphere.rings, 3)).astype(np.float32)},
        rng.random(shape).astype(np.float32),
        ("a", "b"),
        np.array([0, 2]),
        ("ball", "box", "pillar"),
        np.array(["train", "test"]),
        np.zeros(2, bool),
        sphere,
        {"recogniser": ("r", "0" * 64), "lem": ("l", "1" * 64)},
        {"lem": ("box",)},
        Calibration(0.8, 0.3),
        rng.normal(size=(*shape, 3, 8)).astype(np.float32),
        rng.normal(size=(2, 3)).astype(np.float32),
    ).save(folder / "p.npz")


def take_predictions(path: Path) -> None:
    """Read predictions."""
    from nextview.data.predictions import Predictions

    Predictions.load(path)


def make_cards(package: str, folder: Path) -> None:
    """The cards that ship in a package, with what lies beside them."""
    from importlib.resources import files

    for path in Path(str(files(package))).joinpath("bundled").iterdir():
        (folder / path.name).symlink_to(path)


def take_model_card(path: Path) -> None:
    """Read the card of a model."""
    from nextview.models.model_card import read_card

    read_card(path)


def take_policy_card(path: Path) -> None:
    """Make the policy that a card describes."""
    from nextview.policies.policy_card import read_policy
    from nextview.viewsphere import ViewSphere

    read_policy(path, ViewSphere.named("40"))


def make_store(folder: Path) -> None:
    """A rendered store of three boxes."""
    import trimesh

    from nextview.data.rendering import render
    from nextview.viewsphere import ViewSphere

    with tempfile.TemporaryDirectory() as meshes:
        for i in range(3):
            path = Path(meshes, "box" if i else "slab", "train" if i else "test", f"thing_{i}.off")
            path.parent.mkdir(parents=True, exist_ok=True)
            trimesh.creation.box((1, 2, 1 + i)).export(path)
        list(render(Path(meshes), folder / "views.zarr", ViewSphere.named("12"), 16, workers=0))


def take_store(path: Path) -> None:
    """Open a store, read all that it holds, and check it."""
    from nextview.data.checking import check
    from nextview.data.store import ViewStore

    store = ViewStore.open(path)
    for name in ("names", "labels", "classes", "splits", "sphere", "intrinsics", "failures", "radii", "duplicates"):
        getattr(store, name)
    for name in store.measures:
        store.measure(name)
    for i in np.flatnonzero(store.done):
        store.image(int(i))
        store.depth(int(i))
        store.points(int(i))
    list(check(path, workers=0))


def _mesh(suffix: str, change: Change = change_bytes) -> Kind:
    return Kind(partial(make_meshes, suffix), partial(damage_file, change), take_mesh)


KINDS = {
    "off": _mesh(".off"),
    "obj": _mesh(".obj"),
    "ply": _mesh(".ply"),
    "stl": _mesh(".stl"),
    "glb": _mesh(".glb", change_glb),
    "predictions": Kind(make_predictions, partial(damage_file, change_arrays), take_predictions),
    "model card": Kind(
        partial(make_cards, "nextview.models"), partial(damage_file, change_json), take_model_card, "*.json"
    ),
    "policy card": Kind(
        partial(make_cards, "nextview.policies"), partial(damage_file, change_json), take_policy_card, "*.json"
    ),
    "store": Kind(make_store, damage_folder, take_store, "*.zarr"),
    "frame": Kind(fuzz_frames.make_frames, fuzz_frames.damage_frames, fuzz_frames.take_frames),
    "view": Kind(fuzz_frames.make_views, partial(fuzz_frames.damage, fuzz_frames.read_frame), fuzz_frames.take_views),
}


# How they are read


def run_case(kinds: dict[str, Kind], sound: Path, seed: int, name: str, number: int, case: Path) -> tuple[str, str]:
    """Damage a file in the folder ``case`` and read it; what came of it, and the sentence or the traceback."""
    from nextview.errors import NextviewError

    kind, rng = kinds[name], np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    damaged = kind.damage(rng, sorted((sound / name).glob(kind.inputs)), case)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a warning is printed, too
            warnings.simplefilter("ignore", DeprecationWarning)
            kind.take(damaged)
    except NextviewError as refusal:
        one_sentence = str(refusal).strip() and "\n" not in str(refusal)
        return ("refused", str(refusal)) if one_sentence else ("error", f"not one sentence: {refusal}")
    except Exception:
        return "error", traceback.format_exc()
    return "loaded", ""


def _work(connection: Connection, kinds: dict[str, Kind], sound: Path, seed: int, patience: float) -> None:
    """Run case after case, under the limits; this process may die at any of them."""
    from nextview.errors import NextviewError

    for name, kind in kinds.items():  # everything is imported now
        for path in (sound / name).glob(kind.inputs):
            with suppress(NextviewError):  # what is in a folder of meshes need not be sound
                kind.take(path)
    printed = (sound / PRINTED).open("w+b", buffering=0)
    for stream in (1, 2):
        os.dup2(printed.fileno(), stream)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    connection.send(("ready", ""))
    while (asked := connection.recv()) is not None:
        name, numbers = asked
        for number in numbers:
            with tempfile.TemporaryDirectory() as case:
                signal.setitimer(signal.ITIMER_PROF, patience)  # neither is caught: they end even what is lost in C
                signal.alarm(WAIT)
                outcome, told = run_case(kinds, sound, seed, name, number, Path(case))
                signal.alarm(0)
                signal.setitimer(signal.ITIMER_PROF, 0)
            if printed.tell():  # the place is one with that of the standard files
                printed.seek(0)
                lines = printed.read().decode(errors="replace").splitlines()
                printed.seek(0)
                printed.truncate()
                if any(not line.startswith("nextview: ") for line in lines):  # our own sentences may be printed
                    outcome, told = "error", f"it prints {lines[:20]}"
            connection.send((outcome, told if outcome in BAD else ""))


class Reader:
    """A process that runs cases, and is replaced when it dies."""

    def __init__(self, kinds: dict[str, Kind], sound: Path, seed: int, patience: float) -> None:
        self.arguments = (kinds, sound, seed, patience)
        self.start()

    def start(self) -> None:
        """A new process, which has read the sound inputs."""
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, *self.arguments), daemon=True)
        self.process.start()
        theirs.close()
        try:
            self.connection.recv()
        except EOFError:
            raise SystemExit("a sound input cannot be read") from None

    def run(self, name: str, numbers: range) -> Iterator[tuple[str, str]]:
        """What came of each of some cases."""
        while numbers:
            self.connection.send((name, numbers))
            try:
                while numbers:
                    yield self.connection.recv()
                    numbers = numbers[1:]
            except EOFError:
                yield self._death()
                numbers = numbers[1:]

    def _death(self) -> tuple[str, str]:
        """Why the process died; there is a new one then."""
        self.process.join()
        code = self.process.exitcode or 0
        printed = (self.arguments[1] / PRINTED).read_text(errors="replace")[-2000:]
        self.start()
        if -code in (signal.SIGPROF, signal.SIGALRM):
            took = f"{self.arguments[3]} s of computing" if -code == signal.SIGPROF else f"{WAIT} s in all"
            return "hang", f"more than {took}"
        return "crash", f"the process ended with status {code}: {printed}"


def fuzz(
    kinds: dict[str, Kind],
    seconds: float,
    seed: int,
    meshes: Path | None = None,
    patience: float = SECONDS,
    count: int | None = None,
) -> tuple[dict[str, Counter], list[str]]:
    """Run cases of all kinds in turn until the time is over, each kind at least once.

    Args:
        kinds: by name.
        seconds: how long.
        seed: decides the damage.
        meshes: a folder of more meshes to damage, each up to 200 kB.
        patience: seconds of computing that a case may take.
        count: instead of ``seconds``, so many cases of each kind; told on standard error as it goes on.

    Returns:
        How often what came of each kind, and a paragraph on each case that must not be.
    """
    counts: dict[str, Counter] = {name: Counter() for name in kinds}
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        sound = make_sound(kinds, Path(folder), meshes)
        reader, began, number = Reader(kinds, sound, seed, patience), time.monotonic(), 0

        def over() -> bool:
            return number > 0 and (number == count if count else time.monotonic() > began + seconds)

        while not over():
            batch = range(number, min(number + BATCH, count) if count else number + (BATCH if number else 1))
            for name in kinds:
                for case, (outcome, told) in zip(batch, reader.run(name, batch), strict=True):
                    counts[name][outcome] += 1
                    if outcome in BAD:
                        failures.append(f"--case {name!r} {case}: {outcome}: {told}")
                        if count:
                            print(failures[-1], file=sys.stderr, flush=True)
                if not count and over():
                    break
            number = batch.stop
            if count and number % (100 * BATCH) == 0:
                print(f"{number} of each kind", file=sys.stderr, flush=True)
        reader.connection.send(None)
        reader.process.join()
    return counts, failures


def make_sound(kinds: dict[str, Kind], folder: Path, meshes: Path | None) -> Path:
    """A folder with a folder of sound inputs of each kind."""
    for name, kind in kinds.items():
        (folder / name).mkdir()
        kind.make(folder / name)
        for path in sorted(meshes.rglob(f"*.{name}")) if meshes else ():
            if path.stat().st_size < 200_000:
                (folder / name / path.name).symlink_to(path.absolute())
    return folder


def main(
    minutes: float = 1.0,
    count: int | None = None,
    seed: int = 0,
    kinds: tuple[str, ...] = tuple(KINDS),
    meshes: Path | None = None,
    case: tuple[str, int] | None = None,
    keep: Path | None = None,
) -> None:
    """Damage files at random and read them.

    Args:
        minutes: how long.
        count: instead of that, so many cases of each kind.
        seed: decides the damage.
        kinds: only these.
        meshes: a folder of more meshes to damage, each up to 200 kB.
        case: run this one alone: its kind and number.
        keep: folder for what it reads.
    """
    chosen = {name: KINDS[name] for name in ([case[0]] if case else kinds)}
    if case:
        with tempfile.TemporaryDirectory() as folder:
            keep = keep or Path(tempfile.mkdtemp())
            keep.mkdir(parents=True, exist_ok=True)
            outcome, told = run_case(chosen, make_sound(chosen, Path(folder), meshes), seed, *case, keep)
        print(f"{outcome}: {told}\nwhat was read is in {keep}")
        sys.exit(outcome in BAD)
    counts, failures = fuzz(chosen, 60 * minutes, seed, meshes, count=count)
    print(f"{'':12}" + "".join(f"{outcome:>9}" for outcome in (*GOOD, *BAD)))
    for name, count in counts.items():
        print(f"{name:12}" + "".join(f"{count[outcome]:9}" for outcome in (*GOOD, *BAD)))
    print(*failures, sep="\n")
    sys.exit(bool(failures))


if __name__ == "__main__":
    tyro.cli(main)
