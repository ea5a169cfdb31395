"""Teach things: from a folder of meshes or captured frames to a memory that recognises them, without PyTorch."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace as replace_record
from safetensors.numpy import load_file, save_file

from nextview.data.pool import WorkerDied, each
from nextview.data.pool import count as count_workers
from nextview.data.progress import Track, silently
from nextview.errors import DatasetError, NextviewError, UsageError
from nextview.files import check_new, command, new_file, new_folder, only_one
from nextview.learning.learned_picture import draw_learned
from nextview.learning.memory_fit import VIEWS, fit_memory, size_evidence
from nextview.learning.teaching import Arrays, How, teach
from nextview.learning.things import Found, Source, find_things
from nextview.recognition.belief import Calibration
from nextview.recognition.memory import AZIMUTHS, Memory, read_memory
from nextview.recognition.model_card import (
    FEATURES,
    ModelCard,
    Taught,
    Thing,
    Training,
    find_card,
    read_card,
    write_card,
)

NAME = "memory"  # of the card in a folder of taught things, and of the file beside it
Pair = tuple[Source, Arrays]  # a thing, and what is remembered of it
ODD_SIZE = 300  # a thing so many times larger or smaller than the median of the others is asked about


@dataclass(frozen=True)
class Learned:
    """What was learned."""

    out: Path  # the folder
    things: int  # how many, of so many ``classes``
    classes: int
    # share of the cases in which held-out views are named right after 1, 2, 3 and 5 of them; things of a class of
    # several by the others of that class
    accuracy: tuple[float, ...]
    # pairs of things that are most often taken for each other, with the share of the cases
    confused: tuple[tuple[str, str, float], ...]
    notes: tuple[str, ...]  # what there is to know, a sentence each
    left_out: tuple[str, ...]  # what could not be learned and why, a phrase each

    def __str__(self) -> str:
        """In words."""
        classes = "" if self.classes == self.things else f" of {self.classes} classes"
        one, two, three, _ = (f"{share:.0%}" for share in self.accuracy)
        thing = "thing" if self.things == 1 else "things"
        lines = [f"{self.things} {thing}{classes} learned; named right after 1, 2, 3 views: {one}, {two}, {three}"]
        lines += [f"confused: {a} and {b} ({share:.0%} of the cases)" for a, b, share in self.confused[:5]]
        if len(self.confused) > 5:
            lines.append(f"and {len(self.confused) - 5} pairs less often")
        return "\n".join(lines + [*self.notes] + [f"left out: {phrase}" for phrase in self.left_out])


def learn(folder: str | Path, out: str | Path, **options: Any) -> Learned:
    """Teach the things in a folder; options are those of ``How`` and of ``learn_things``, which says all."""
    how = {name: options.pop(name) for name in How.__dataclass_fields__ if name in options}
    return learn_things(Path(folder), Path(out), How(**how), **options)


def learn_things(
    folder: Path,  # what is to be taught
    out: Path,  # folder to write
    how: How = How(),
    add: bool = False,  # put the things beside those that OUT knows; the old ones are not looked at again
    # forget the things of these names in OUT; nothing is added where FOLDER is OUT, too
    remove: tuple[str, ...] = (),
    workers: int | None = None,  # processes; one for each core by default; 0 to work in this one
    # address of a dask.distributed scheduler whose workers see the same files, to use instead
    scheduler: str | None = None,
    overwrite: bool = False,  # replace what OUT knows
    track: Track = silently,  # follows the things
) -> Learned:
    """Teach the things in a folder, and write a folder of models that recognises them.

    Each mesh in the folder is a thing of its own name, as is each folder of captured depth frames with poses (BOP, TUM
    RGB-D or 7-Scenes) or from a turntable; any other folder is a class, and the meshes in it are its things. A run that
    was stopped goes on where it was. Use what it writes with --models OUT, or ``nextview.load(models=OUT)``.

    Raises:
        DatasetError: nothing can be taught; what is wrong, in one sentence.
        ResultsError: ``out`` is there, and neither ``add`` nor ``overwrite``.
    """
    folder, out = Path(folder), Path(out)
    card_path, old, taught = out / f"{NAME}.json", None, list[Pair]()
    if add or remove:
        old = read_card(card_path)
        taught = _known(old, read_memory(old.path, old.sha256), remove)
    elif card_path.exists() and not overwrite:
        raise UsageError(f"{out}: knows things already; --add puts others beside them, --overwrite replaces them")
    else:
        check_new(out, overwrite, folder=True)
    found = Found([], []) if remove and folder.resolve() == out.resolve() else find_things(folder)
    names, left_out = {source.name for source, _ in taught}, list(found.left_out)
    for thing in found.things:
        if thing.name in names:
            raise UsageError(f"{thing.path}: something called {thing.name} is known already; --remove it, or rename it")
    part = out.with_name(f".{out.name}.part")
    with only_one(out):
        track(_teach(found.things, how, part, taught, left_out, workers, scheduler), len(found.things), "things")
        if not taught:
            raise DatasetError(f"{folder}: none of its things could be taught ({'; '.join(left_out[:3])})")
        taught.sort(key=lambda pair: (pair[0].label, pair[0].name))
        if not how.any_size:
            _check_sizes(taught)
        learned = _write(out, taught, left_out, old)
        shutil.rmtree(part, ignore_errors=True)
    return learned


def _known(card: ModelCard, memory: Memory, remove: Sequence[str]) -> list[Pair]:
    """The things of a memory, without some."""
    assert card.memory is not None
    names = [thing.name for thing in card.memory.things]
    if missing := sorted(set(remove) - set(names)):
        raise UsageError(f"{card.path}: knows nothing called {missing[0]!r}")
    kept = []
    for index, thing in enumerate(card.memory.things):
        own = memory.thing == index
        label = card.classes[card.calibration.hypotheses[int(np.flatnonzero(own)[0])]]
        arrays = {name: getattr(memory, name)[own] for name in ("views", "rotations")}
        arrays |= {name: getattr(memory, name)[index] for name in PER_THING}
        arrays["radii"] = arrays["radii"].reshape(1)
        if thing.name not in remove:
            kept.append((Source(thing.name, label, Path(thing.source)), arrays))
    return kept


PER_THING = ("held_out", "held_out_views", "radii", "pictures")


def _teach(
    sources: Sequence[Source],
    how: How,
    part: Path,
    taught: list[Pair],
    left_out: list[str],
    workers: int | None,
    scheduler: str | None,
) -> Iterator[int]:
    """Teach things side by side, each into a file of its own; what is there from a run that was stopped is taken."""
    part.mkdir(parents=True, exist_ok=True)
    waiting = []
    for source in sources:
        file = part / f"{source.name}.safetensors"
        # A file that was changed since, or other options, make it anew.
        stamp = repr((str(source.path.resolve()), source.path.stat().st_mtime_ns, replace(how, any_size=False)))
        if (arrays := _finished(file, stamp)) is not None:
            taught.append((source, arrays))
        else:
            waiting.append((source, stamp))
    waiting.sort(key=lambda item: -item[0].path.stat().st_size)  # the longest first: none is left alone at the end
    # A thing alone takes all cores.
    threads = 1 if scheduler else max(1, count_workers(workers) // max(1, len(waiting)))
    work = partial(_teach_one, how, part, threads)
    before, results = len(sources) - len(waiting), each(work, waiting, workers, scheduler)
    yield before
    for count, ((source, _), result) in enumerate(results, before + 1):
        if isinstance(result, WorkerDied | str):
            left_out.append(f"{source.name}: {result}")
        else:
            taught.append((source, result))
        yield count


def _finished(file: Path, stamp: str) -> Arrays | None:
    try:
        arrays = load_file(file)
    except Exception:  # missing, or cut off by a kill: it is made again
        return None
    return arrays if bytes(arrays.pop("stamp").tobytes()).decode() == stamp else None


def _teach_one(how: How, part: Path, threads: int, item: tuple[Source, str]) -> Arrays | str:
    """What is to be remembered of one thing; a sentence where it cannot be taught."""
    source, stamp = item
    try:
        arrays = teach(source.path, source.name, how, threads)
    except NextviewError as error:
        return str(error)
    arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    with new_file(part / f"{source.name}.safetensors", overwrite=True) as file:
        save_file(arrays | {"stamp": np.frombuffer(stamp.encode(), np.uint8)}, file)
    return arrays


def _check_sizes(taught: Sequence[Pair]) -> None:
    """Ask about a thing a thousand times larger than the others: its file is in another unit."""
    radii = np.concatenate([arrays["radii"] for _, arrays in taught])
    if np.isfinite(radii).sum() < 2:
        return
    ratio = radii / np.nanmedian(radii)
    for (source, _), times in zip(taught, ratio, strict=True):
        if times > ODD_SIZE or times < 1 / ODD_SIZE:
            how = f"{times:,.0f} times larger" if times > 1 else f"{1 / times:,.0f} times smaller"
            hint = "is it in another unit? --any-size takes it as it is"
            raise DatasetError(f"{source.path}: is {how} than most others; {hint}")


def _write(out: Path, taught: Sequence[Pair], left_out: Sequence[str], old: ModelCard | None) -> Learned:
    """Fit what is fitted to all things together, and write memory and card."""
    classes = tuple(dict.fromkeys(source.label for source, _ in taught))
    label = np.array([classes.index(source.label) for source, _ in taught])
    poses = [len(arrays["views"]) for _, arrays in taught]
    thing = np.repeat(np.arange(len(taught)), poses)
    stacked = {name: np.stack([arrays[name] for _, arrays in taught]) for name in PER_THING}
    stacked["radii"] = stacked["radii"][:, 0]
    joint = {name: np.concatenate([arrays[name] for _, arrays in taught]) for name in ("views", "rotations")}
    fit = fit_memory(joint["views"], thing, label, *(stacked[name] for name in PER_THING[:3]))
    memory = Memory(thing=thing, head=fit.head, head_bias=fit.head_bias, **joint, **stacked)
    things = tuple(Thing(source.name, str(source.path), n) for (source, _), n in zip(taught, poses, strict=True))
    features = find_card(FEATURES)
    calibration = Calibration(1.0, 1.0, None, fit.correlation, tuple(label[thing].tolist()))
    novelty, usual = (tuple(map(tuple, np.round(rows, 4).tolist())) for rows in (fit.quantiles, fit.usual))
    card = ModelCard(
        NAME,
        "recogniser",
        features.input,
        "0" * 64,
        network="memory of views",
        classes=classes,
        azimuth_bins=AZIMUTHS,
        calibration=calibration,
        size=size_evidence(stacked["radii"], label),
        training=Training(f"{len(taught)} things", commands=() if old is None else old.training.commands),
        scores={"held-out views": {str(k): round(a, 4) for k, a in zip(VIEWS, fit.accuracy, strict=True)}},
        memory=Taught(things, features.sha256, fit.weight, novelty=novelty, usual=usual),
    ).made_by(command())
    with new_folder(out, overwrite=True) as part:
        sha256 = memory.save(part / f"{NAME}.safetensors")
        write_card(part / f"{NAME}.json", replace_record(card, sha256=sha256))
        draw_learned(part / "learned.png", {source.name: arrays["pictures"] for source, arrays in taught}, fit)
    names = [source.name for source, _ in taught]
    confused = tuple((names[a], names[b], share) for a, b, share in fit.confused)
    return Learned(out, len(taught), len(classes), fit.accuracy, confused, _notes(taught), tuple(left_out))


def _notes(taught: Sequence[Pair]) -> tuple[str, ...]:
    """What there is to know of what was learned, a sentence each."""
    names, notes = [source.name for source, _ in taught], []
    if len(taught) == 1:
        notes.append(f"{names[0]} is all it knows, so everything is that; teach what it may be mistaken for, too")
    first: dict[bytes, str] = {}
    for source, arrays in taught:
        # The picture is a render without errors: only the same mesh gives the very same one.
        look = arrays["pictures"].tobytes() + np.round(np.log(arrays["radii"]), 3).tobytes()
        if (twin := first.setdefault(look, source.name)) != source.name:
            notes.append(f"{twin} and {source.name} look the same: one thing under two names?")
    unknown = [source.name for source, arrays in taught if not np.isfinite(arrays["radii"])]
    if unknown and len(taught) > 1:
        notes.append(f"the size of {len(unknown)} of {len(taught)} things is not known; --unit makes it count")
    return tuple(notes)
