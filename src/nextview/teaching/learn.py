"""Teaching of things: from scans or captured frames to a memory, without PyTorch."""

import glob
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from msgspec.structs import replace as replace_record
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from nextview.checks import check_extras, one_line
from nextview.data.pool import GivenItem, Result, WorkerDied, each
from nextview.data.pool import count as count_workers
from nextview.data.progress import TrackProgress, in_lines, silently
from nextview.errors import DatasetError, NextviewError, UsageError, option
from nextview.files import (
    check_new,
    new_file,
    new_folder,
    only_one,
    sha256_of,
    unfinished,
)
from nextview.recognition.model_card import (
    MEMORY_SUFFIX,
    SHORT_HASH,
    ModelCard,
    memory_path,
    read_card,
    write_card,
)
from nextview.teaching.learned_picture import draw_learned
from nextview.teaching.memory_card import (
    MEMORY_NAME,
    PER_THING,
    Pair,
    card_of,
    memory_of,
    with_scores,
)
from nextview.teaching.shown_views import (
    VIEWS_SHOWN,
    NeverConfident,
    Shown,
    ShownThings,
    show,
    summary,
    to_be_shown,
)
from nextview.teaching.sizes import check_sizes, check_unit, refuse_without_unit
from nextview.teaching.symmetries import named_symmetries
from nextview.teaching.thing_sources import (
    Found,
    ThingSource,
    find_things,
    is_of_frames,
)
from nextview.teaching.thing_views import (
    CONTENT,
    FACES,
    LEFT_OUT,
    NEAR_SYMMETRIES,
    SYMMETRIES,
    UPRIGHT,
    VERTICES,
    Arrays,
    TeachingOptions,
    rows_of,
    teach,
)
from nextview.teaching.unfinished_things import finished, part_of, stamp_of
from nextview.things.memory import Memory, open_memory

CARD = f"{MEMORY_NAME}.json"
MEMORY_FILE = f"{MEMORY_NAME}{MEMORY_SUFFIX}"
LEARNED_PICTURE = "learned.png"
# folder of the preliminary memory that recognises the things during the test
JUDGED = "judged"
# key of the things that an interrupted run has taught, see ``files.unfinished``
PARTS = "things"
MOST_NEVER = 10  # most things for which the summary says why they are never confident


@dataclass(frozen=True)
class Work:
    """Execution of a run.

    Attributes:
        how: options of the teaching.
        part: folder of unfinished results.
        workers: see ``pool.each``.
        scheduler: see ``pool.each``.
        track: progress callback.
    """

    how: TeachingOptions
    part: Path
    workers: int | None
    scheduler: str | None
    track: TrackProgress


@dataclass(frozen=True)
class Learned:
    """Result of teaching.

    Attributes:
        out: folder of the memory.
        things: number of things.
        classes: number of their classes.
        accuracy: share of correct answers after 1, 2 and 3 simulated views; () if nothing was seen.
        confused: pairs of things that are most often confused, with the share of the cases.
        notes: notes for the user, a sentence each.
        left_out: what could not be learned and why, a phrase each.
        judged: number of things in this test.
        never_confident: things that no test names with confidence after all its views, and why: a
            sentence about each.
    """

    out: Path
    things: int
    classes: int
    accuracy: tuple[float, ...]
    confused: tuple[tuple[str, str, float], ...]
    notes: tuple[str, ...]
    left_out: tuple[str, ...]
    judged: int = 0
    never_confident: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        """Summary in words."""
        classes = "" if self.classes == self.things else f" of {self.classes} classes"
        thing = "thing" if self.things == 1 else "things"
        told = f"; {self._how_often()}" if self.accuracy else ""
        lines = [f"{self.things} {thing}{classes} learned{told}"]

        lines += [
            f"confused: {a} and {b} ({share:.0%} of the cases)"
            for a, b, share in self.confused[:5]
        ]
        if len(self.confused) > 5:
            lines.append(f"and {len(self.confused) - 5} pairs less often")

        lines += [
            f"never confident: {name}, {why}"
            for name, why in self.never_confident[:MOST_NEVER]
        ]
        if len(self.never_confident) > MOST_NEVER:
            rest = self.never_confident[MOST_NEVER:]
            lines.append(f"nor {', '.join(name for name, _ in rest)}")
        return "\n".join(
            lines + [*self.notes] + [f"left out: {phrase}" for phrase in self.left_out]
        )

    def _how_often(self) -> str:
        """Accuracy in words."""
        views = ", ".join(str(k) for k in VIEWS_SHOWN[: len(self.accuracy)])
        named = f"named right after {views} views: {_percent(self.accuracy)}"
        if self.judged in (0, self.things):
            return named
        return f"{named} ({self.judged} of them were tested)"


def _percent(shares: Sequence[float]) -> str:
    return ", ".join(f"{share:.0%}" for share in shares)


class LearnOptions(TypedDict, total=False):
    """Options of ``learn``.

    Attributes:
        unit: of the mesh files, which need one: "mm", "cm", "inch", "foot" or "m"; depth frames are
            in metres.
        up: up axis of the mesh files, "y" or "z"; by default z, and y for GLB.
        upright: whether the things stand only as in their files; by default they may also lie.
        sensor: camera that will look at them, NAME or NAME:STRENGTH; "wrist" by default.
        largest_part: whether to keep only the largest connected part of each mesh.
        any_size: whether to accept things of very different sizes.
        one_class: whether things that are all in one folder are one class.
        symmetry: symmetries that replace the detected ones, such as "flange=z:6", see
            ``teaching.symmetries.named_symmetries``.
        turntable: direction in which a turntable turned, "ccw" or "cw", seen from above.
        depth_scale: metres per step of captured depth images; by default from their files.
        depth_topic: topic of the depth images of ROS 2 bags with several.
        world_frame: tf frame of the world in ROS 2 bags, z up; by default the root of the tree.
        seed: seed of all random draws; 0 by default.
        add: whether to add the things to an existing memory.
        remove: names of things to remove from the memory.
        workers: number of processes; None for one on each core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.
        overwrite: whether to replace an existing memory.
        track: progress callback; by default it prints lines on standard error.
    """

    unit: Literal["mm", "cm", "inch", "foot", "m"] | None
    up: Literal["y", "z"] | None
    upright: bool
    sensor: str
    largest_part: bool
    any_size: bool
    one_class: bool
    symmetry: tuple[str, ...]
    turntable: Literal["ccw", "cw"] | None
    depth_scale: float | None
    depth_topic: str | None
    world_frame: str | None
    seed: int
    add: bool
    remove: tuple[str, ...]
    workers: int | None
    scheduler: str | None
    overwrite: bool
    track: TrackProgress


def learn(
    folder: str | Path,
    out: str | Path,
    **options: Unpack[LearnOptions],
) -> Learned:
    """Teach the things in a folder and write a memory that recognises them.

    Each mesh file is a thing, as is each folder of captured depth frames. An interrupted run
    resumes.

    Args:
        folder: mesh files, folders of captured frames, or folders of meshes as classes.
        out: folder of the memory, for ``nextview.load(models=out)``.
        **options: see ``LearnOptions``.

    Returns:
        What was learned, with the accuracy in simulated views.

    Raises:
        DatasetError: nothing can be taught.
        ResultsError: ``out`` exists, and neither ``add`` nor ``overwrite`` is set.
        UsageError: an option is not valid, or the unit of mesh files is missing.

    Example:
        >>> nextview.learn("scans", "mine", unit="m")  # doctest: +SKIP
        >>> nextview.load(models="mine").recognise("scans/mug.ply", unit="m")  # doctest: +SKIP
    """
    given: dict[str, Any] = {"track": in_lines, **options}
    names = TeachingOptions.__dataclass_fields__
    how = {name: given.pop(name) for name in names if name in given}
    return learn_things(Path(folder), Path(out), TeachingOptions(**how), **given)


def learn_things(
    folder: Path,
    out: Path,
    how: TeachingOptions = TeachingOptions(),
    add: bool = False,
    remove: tuple[str, ...] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> Learned:
    """Teach the things in a folder, and write a memory that recognises them.

    Each mesh file is a thing, as is each ROS 2 bag and each folder of depth frames with poses (BOP,
    TUM RGB-D, 7-Scenes or RealSense) or from a turntable. Any other folder is a class, and the
    meshes in it are its things. An interrupted run resumes. Use the memory with --models OUT, or
    with ``nextview.load(models=OUT)``.

    Args:
        folder: folder of meshes, bags and folders of captured frames.
        out: folder of the memory to write.
        add: add the things to those in OUT, which are not processed again; FOLDER contains only the
            new things.
        remove: names of things to remove from OUT; if FOLDER is OUT, nothing is added: only
            this and --symmetry change OUT.
        workers: number of processes; by default one for each core; 0 uses this process.
        scheduler: address of a dask.distributed scheduler to use instead, whose workers see the
            same files.
        overwrite: replace the memory in OUT.
        track: progress callback.

    Returns:
        What was learned, with the accuracy in simulated views.

    Raises:
        DatasetError: nothing can be taught.
        ResultsError: ``out`` exists, and neither ``add`` nor ``overwrite`` is set.
        UsageError: an option is not valid, or the unit of mesh files is missing.
    """
    folder = Path(folder)
    out = Path(out)
    how.check()
    check_extras("teach")
    count_workers(workers)  # rejects an invalid number
    changes = bool(remove or how.symmetry)
    nothing_new = changes and folder.resolve() == out.resolve()
    keeps = add or bool(remove) or nothing_new
    _check_places(out, keeps, overwrite)
    found = (
        Found([], []) if nothing_new else find_things(folder, out, how.one_class or add)
    )
    left_out = list(found.left_out)
    meshes = [one.path for one in found.things if not is_of_frames(one.path)]
    if meshes and how.unit is None:
        refuse_without_unit(meshes[0], how.up)
    if meshes and not how.any_size:
        check_unit(meshes[:5], how.up, how.unit)

    with only_one(out), unfinished(out, PARTS) as part:
        # Read under the lock: another run may have changed it before.
        old = _before(out, keeps)
        taught = [] if old is None else _known(*old, remove)
        _check_names(found.things, taught, how.symmetry)

        work = Work(how, part, workers, scheduler, track)
        (track if found.things else silently)(
            _teach(found.things, work, taught, left_out),
            len(found.things),
            "teaching things",
        )
        if not taught and nothing_new:
            raise UsageError(
                f"{out}: no thing would be left; delete the folder instead"
            )
        if not taught:
            raise DatasetError(
                f"{folder}: none of its things could be taught ({'; '.join(left_out[:3])})"
            )
        taught.sort(key=lambda pair: (pair[0].label, pair[0].name))
        _name_symmetries(taught, how.symmetry)
        if not how.any_size:
            radii = np.concatenate([arrays["radii"] for _, arrays in taught])
            check_sizes([source.path for source, _ in taught], radii, how.unit)
        learned = _write(out, taught, left_out, None if old is None else old[0], work)
    return replace(learned, notes=found.notes + learned.notes)


def _check_places(out: Path, keeps: bool, overwrite: bool) -> None:
    """Check, before any work, that the outputs can be written.

    Raises:
        UsageError: a memory exists, and no option keeps or replaces it.
        ResultsError: see ``files.check_new``.
    """
    card = out / CARD
    if card.exists() and not keeps and not overwrite:
        raise UsageError(
            f"{out}: already knows things; {option('add', True)} adds others,"
            f" {option('overwrite', True)} replaces them"
        )
    check_new(out, keeps or overwrite, folder=True)
    for place in (card, out / LEARNED_PICTURE):
        check_new(place, overwrite=True)


def _before(out: Path, keeps: bool) -> tuple[ModelCard, Memory] | None:
    """The memory whose things are kept; None without one."""
    if not keeps:
        return None
    return open_memory(out / CARD)


def _check_names(
    things: Sequence[ThingSource], taught: Sequence[Pair], symmetry: Sequence[str]
) -> None:
    """Refuse things with the name of a known thing, and symmetries of unknown things.

    Raises:
        UsageError: a name is taken, or unknown.
    """
    names = {source.name for source, _ in taught}
    for thing in things:
        if thing.name in names:
            raise UsageError(
                f"{thing.path}: something called {thing.name} is known already;"
                f" {option('remove')} it, or rename it"
            )
    names |= {thing.name for thing in things}
    for name in named_symmetries(symmetry):
        if name not in names:
            raise UsageError(
                f"{option('symmetry')}: nothing is called {one_line(name)}"
            )


def _known(card: ModelCard, memory: Memory, remove: Sequence[str]) -> list[Pair]:
    """The things of a memory, except those to be removed.

    Raises:
        UsageError: a thing to be removed is not in the memory.
    """
    assert card.memory is not None
    names = {thing.name for thing in card.memory.things}
    missing = sorted(set(remove) - names)
    if missing:
        raise UsageError(f"{card.card_path}: knows nothing called {missing[0]!r}")

    kept = []
    for index, thing in enumerate(card.memory.things):
        if thing.name in remove:
            continue
        label = card.classes[card.calibration.hypotheses[index]]
        surface = memory.surfaces.surface(index, thing.name)
        arrays = {name: getattr(memory, name)[[index]] for name in PER_THING} | {
            UPRIGHT: np.array([thing.upright]),
            VERTICES: surface.vertices,
            FACES: surface.faces,
            SYMMETRIES: rows_of(thing.symmetries),
            NEAR_SYMMETRIES: rows_of(thing.near_symmetries),
        }
        if thing.sha256 is not None:
            arrays[CONTENT] = np.frombuffer(bytes.fromhex(thing.sha256), np.uint8)
        kept.append((ThingSource(thing.name, label, Path(thing.source)), arrays))
    return kept


def _name_symmetries(taught: Sequence[Pair], given: Sequence[str]) -> None:
    """Replace detected symmetries by those of the user."""
    known = {source.name: arrays for source, arrays in taught}
    for name, symmetries in named_symmetries(given).items():
        if name in known:  # and could be taught
            known[name][SYMMETRIES] = rows_of(symmetries)


def _teach(
    sources: Sequence[ThingSource],
    work: Work,
    taught: list[Pair],
    left_out: list[str],
) -> Iterator[int]:
    """Teach things in parallel, each into its own file; finished files are reused."""
    waiting = []
    for source in sources:
        stamp = stamp_of(source, work.how)
        arrays = finished(part_of(work.part, source), stamp)
        if arrays is not None:
            taught.append((source, _without_phrase(source, arrays, left_out)))
        else:
            waiting.append((source, stamp))
    # the largest first, so that none remains alone at the end
    waiting.sort(key=lambda item: -item[0].path.stat().st_size)
    teach_one = partial(_teach_one, work.how, work.part)

    before = len(sources) - len(waiting)
    yield before
    results = each(teach_one, waiting, work.workers, work.scheduler)
    for count, ((source, _), result) in enumerate(results, before + 1):
        if isinstance(result, str | WorkerDied):
            left_out.append(f"{source.name}: {result}")
        else:
            taught.append((source, _without_phrase(source, result, left_out)))
        yield count


def _without_phrase(source: ThingSource, arrays: Arrays, left_out: list[str]) -> Arrays:
    """The arrays of a thing; the phrase about its unused frames moves to ``left_out``."""
    phrase = arrays.get(LEFT_OUT)
    if phrase is not None:
        left_out.append(f"{source.name}: {bytes(phrase.tobytes()).decode()}")
    return {name: values for name, values in arrays.items() if name != LEFT_OUT}


def _teach_one(
    how: TeachingOptions,
    part: Path,
    item: tuple[ThingSource, str],
) -> Arrays | str:
    """Arrays of one thing; a sentence if it cannot be taught."""
    source, stamp = item
    try:
        arrays = teach(source.path, source.name, how)
    except NextviewError as error:
        return str(error)
    arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    noted = np.frombuffer(stamp.encode(errors="surrogateescape"), np.uint8)
    with new_file(part_of(part, source), overwrite=True) as file:
        save_file(arrays | {"stamp": noted}, file)
    return arrays


def _write(
    out: Path,
    taught: Sequence[Pair],
    left_out: Sequence[str],
    old: ModelCard | None,
    work: Work,
) -> Learned:
    """Test all things together, and write memory and card.

    The file name of the new memory contains its hash. Renaming the card switches to the new memory
    atomically, so that an interrupted run leaves the old memory or the new one. The old file is
    removed last.
    """
    classes = tuple(dict.fromkeys(source.label for source, _ in taught))
    label = np.array([classes.index(source.label) for source, _ in taught])
    memory = memory_of(taught)
    card = card_of(
        taught,
        classes,
        label,
        memory,
        () if old is None else old.training.commands,
        work.how.sensor,
    )
    tested = _tested(card, memory, work)
    if tested.accuracy:
        card = with_scores(card, tested)
    names = [source.name for source, _ in taught]
    first = [names[label.tolist().index(c)] for c in range(len(classes))]
    confused = tuple((first[a], first[b], share) for a, b, share in tested.confused)

    with new_folder(out, overwrite=True, last=CARD) as part:
        weights = _save(part, card, memory)
        draw_learned(
            part / LEARNED_PICTURE,
            {source.name: arrays["pictures"][0] for source, arrays in taught},
            tested.accuracy,
            confused,
        )
        # the memory has not changed
        if _is_intact(out / weights.name, read_card(part / CARD).sha256):
            weights.unlink()
    _remove_old(out, weights.name)

    return Learned(
        out,
        len(taught),
        len(classes),
        tested.accuracy,
        confused,
        _notes(taught, set(tested.unseen)),
        tuple(left_out),
        judged=tested.things,
        never_confident=tuple(
            (names[one.thing], _why_never(one, classes)) for one in tested.never
        ),
    )


def _why_never(one: NeverConfident, classes: Sequence[str]) -> str:
    """Reason why a thing is never named with confidence, in words."""
    views = max(VIEWS_SHOWN)
    tests = "its test" if one.tests == 1 else f"any of {one.tests} tests"
    after = f"not in {tests} of {views} views"
    if one.confused is not None:
        return f"{after}: it looks like {classes[one.confused]}"
    return f"{after}: {one.doubt}"


def _save(folder: Path, card: ModelCard, memory: Memory) -> Path:
    """Write a memory and its card with the hash; return the path of the memory."""
    sha256 = memory.save(folder / MEMORY_FILE)
    weights = memory_path(folder / CARD, sha256)
    (folder / MEMORY_FILE).rename(weights)
    write_card(folder / CARD, replace_record(card, sha256=sha256))
    return weights


def _tested(card: ModelCard, memory: Memory, work: Work) -> ShownThings:
    """Recognise rendered views of all things, or of a random sample of very many."""
    folder = work.part / JUDGED
    shutil.rmtree(folder, ignore_errors=True)  # left by an earlier run
    folder.mkdir()
    _save(folder, card, memory)
    about = card.memory
    assert about is not None
    names = [thing.name for thing in about.things]
    items = to_be_shown(len(names), np.random.default_rng(work.how.seed))
    show_one = partial(show, folder / CARD, work.how.sensor, work.how.seed)
    found = dict(_all_done(show_one, items, work, "testing simulated views"))
    shown: list[Shown] = [one for item in sorted(found) for one in found[item]]
    unseen = {thing for thing, _ in items} - {one.thing for one in shown}
    return summary(shown, [names[thing] for thing in sorted(unseen)])


def _all_done(
    function: Callable[[GivenItem], Result],
    items: Sequence[GivenItem],
    work: Work,
    what: str,
) -> list[tuple[GivenItem, Result]]:
    """Results of a function for some items, in parallel, in any order.

    Raises:
        DatasetError: a process died.
    """
    found = list[tuple[GivenItem, Result]]()

    def watched() -> Iterator[int]:
        results = each(function, items, work.workers, work.scheduler)
        for count, (item, result) in enumerate(results, 1):
            if isinstance(result, WorkerDied):
                raise DatasetError(f"{what} did not end ({result})")
            found.append((item, result))
            yield count

    if items:
        work.track(watched(), len(items), what)
    return found


def _is_intact(weights: Path, sha256: str) -> bool:
    return weights.is_file() and sha256_of(weights) == sha256


def _remove_old(out: Path, kept: str) -> None:
    """Remove memory files that the card no longer names.

    These are files whose name contains their hash, and the file of earlier versions, whose name has
    no hash, if it is a memory. A link is removed, but never its target.
    """
    for file in out.glob(f"{glob.escape(MEMORY_NAME)}-*{MEMORY_SUFFIX}"):
        digits = file.stem.removeprefix(f"{MEMORY_NAME}-")
        if (
            file.name != kept
            and len(digits) == SHORT_HASH
            and file.is_file()
            and sha256_of(file).startswith(digits)
        ):
            file.unlink()

    earlier = out / MEMORY_FILE
    if earlier.is_file() and _is_memory(earlier):
        earlier.unlink()


def _is_memory(file: Path) -> bool:
    """Whether a file is a memory of an earlier version, by the names of its arrays."""
    try:
        with safe_open(file, "numpy") as arrays:
            return {"views", "thing", "held_out", "pictures"} <= set(arrays.keys())
    except SafetensorError:
        return False


def _notes(taught: Sequence[Pair], unseen: set[str]) -> tuple[str, ...]:
    """Notes on the things for the user, a sentence each.

    ``unseen`` are the names of things that the sensor does not see.
    """
    names = [source.name for source, _ in taught]
    notes = []
    if len(taught) == 1:
        notes.append(
            f"{names[0]} is all it knows: every object is {names[0]} or unknown; teach what it may"
            " be mistaken for, too"
        )

    first: dict[bytes, str] = {}

    for source, arrays in taught:
        # The picture is an exact rendering: only the same mesh gives an identical one.
        look = (
            arrays["pictures"].tobytes()
            + np.round(np.log(arrays["radii"]), 3).tobytes()
        )
        if (twin := first.setdefault(look, source.name)) != source.name:
            notes.append(
                f"{twin} and {source.name} look the same: one thing under two names?"
            )
    for source, arrays in taught:
        # doubts about the mesh files of this run
        doubts = arrays.get("doubts", np.zeros(0, np.uint8))
        notes.extend(
            f"{source.name}: {doubt}"
            for doubt in doubts.tobytes().decode().splitlines()
        )

    notes += [
        f"{name}: the sensor sees nothing of it; is it in another unit?"
        for name in names
        if name in unseen
    ]

    return tuple(notes)
