"""The leaderboard of a frozen archive: files of results are checked and compared.

Names of methods and of archives come from elsewhere: each is one line without control characters
and without marks of HTML.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nextview.checks import number_of, one_line, whole
from nextview.data.progress import TrackProgress, silently
from nextview.errors import ResultsError, UsageError
from nextview.files import check_new, command, read_record
from nextview.geometry.mesh import load_mesh
from nextview.things.surface import Surface
from nextview.types import Float
from nextview_lab.benchmark import statistics as st
from nextview_lab.benchmark.comparison import (
    ALL,
    ONE,
    Counted,
    corrected,
    measures_of,
    tested_by,
)
from nextview_lab.benchmark.frozen import EpisodeTruth, FrozenArchive
from nextview_lab.benchmark.methods import check_said
from nextview_lab.benchmark.results import ComparedTables, write_compared
from nextview_lab.benchmark.submit import (
    SUBMISSION_FORMAT,
    SaidAfterView,
    Submission,
    SubmittedEpisode,
)
from nextview_lab.benchmark.text_tables import Board, Column
from nextview_lab.data.metrics import add_s
from nextview_lab.data.progress import collected
from nextview_lab.extras import extras

with extras():
    import pandas as pd

RIGHT = "right"
LAST = "confident and right", "confident and wrong", "unknown"  # after the last view
SHARES = {name: (name, ONE) for name in (RIGHT, *LAST)}
ADD_S = "ADD-S, mm, median"
SURFACE_POINTS = 2_000
MOST_SAMPLES = 100_000  # of the bootstrap


@dataclass(frozen=True, eq=False)
class Scored:
    """A file of results beside the truth.

    Attributes:
        submission: the file.
        said: after each view of each episode, in the order of the archive.
        right: whether the name is right, (episodes, views) bool.
        errors: ADD-S, mm, after the last view of the episodes whose name is right and has a pose.
    """

    submission: Submission
    said: tuple[tuple[SaidAfterView, ...], ...]
    right: Any
    errors: tuple[float, ...]

    def episodes(self) -> "pd.DataFrame":
        """Return the long table: each episode after each view, and what was said after the last."""
        last = [said[-1] for said in self.said]
        sure = np.array([one.confident for one in last])
        right = self.right[:, -1]
        columns = {
            "policy": self.submission.method,
            "threshold": np.nan,
            "object": np.arange(len(last)),
            ONE: 1.0,
            LAST[0]: sure & right,
            LAST[1]: sure & ~right,
            LAST[2]: [one.name is None for one in last],
        }
        after = enumerate(self.right.T, 1)
        return pd.concat(
            [pd.DataFrame({**columns, "views": k, RIGHT: own}) for k, own in after]
        )


def leaderboard_of(
    folder: Path,
    archive: Path,
    out: Path,
    reference: str | None = None,
    samples: int = 10_000,
    seed: int = 0,
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> ComparedTables:
    """Compare the methods of a folder of results on their archive.

    Each file that nextview-lab submit wrote is checked: whether it belongs to this archive, answers
    every episode once, names only things of the archive, and has poses that are rigid. Then names
    and poses are compared with the truth, and methods with the best blind one, whose views ignore
    the images, episode by episode.

    Args:
        folder: with the result files of nextview-lab submit (.json).
        archive: folder of the archive, with its truth.
        out: folder to write, with tables.md, two figures, and every number with its interval in
            measures.csv and tests.csv.
        reference: method with which the others are compared; by default the blind one that is right
            most often after the first view.
        samples: number of bootstrap samples.
        seed: seed of the bootstrap.
        overwrite: replace the tables in OUT.
        track: follows the files.

    Returns:
        The tables.

    Raises:
        DatasetError: the archive is damaged, or its truth is missing.
        ResultsError: a file of results is not valid, or ``out`` exists.
        UsageError: there is no such reference.
    """
    check_new(Path(out), overwrite, folder=True)
    whole(samples, "the samples of the bootstrap", 100, MOST_SAMPLES)
    frozen = FrozenArchive(archive)
    read = read_submissions(Path(folder), frozen)
    if reference is not None and reference not in [one.method for one in read]:
        known = ", ".join(one.method for one in read)
        raise UsageError(
            f"{folder}: no method is called {one_line(repr(reference))}; there are {known}"
        )

    truths = frozen.truths()
    clouds: dict[str, Float] = {}
    comparing = (_scored(one, frozen, truths, clouds) for one in read)
    scored = collected(comparing, len(read), "methods", track)
    scored.sort(key=lambda one: (-one.right[:, -1].mean(), one.submission.method))

    tables = _compared(
        frozen, scored, list(truths.values()), reference, (samples, seed)
    )
    made = {
        "archive_sha256": frozen.sha256,
        "versions": {each.method: each.version for each in read},
        "reference": tables.reference,
        "samples": samples,
        "seed": seed,
        "command": command(),
    }
    write_compared(Path(out), tables, made, RIGHT, "named right", overwrite)
    return tables


def read_submissions(folder: Path, frozen: FrozenArchive) -> list[Submission]:
    """Read and check all files of results in a folder.

    Args:
        folder: of the files.
        frozen: their archive.

    Raises:
        ResultsError: there is none, or one is not valid.
    """
    files = sorted(folder.glob("*.json"))
    if not files:
        raise ResultsError(f"{folder}: holds no file of results, .json")

    read: dict[str, Submission] = {}
    for file in files:
        one = read_record(file, Submission, "a file of results", ResultsError)
        _check_submission(one, frozen, str(file))
        # no episode has more: what was asked for beyond is no work
        longest = max(len(each.said) for each in one.episodes)
        named = {
            name: escape(one_line(getattr(one, name), 100))
            for name in ("method", "version")
        }
        one = msgspec.structs.replace(one, views=longest, **named)
        if one.method in read:
            raise ResultsError(f"{file}: another file has the method {one.method}, too")

        first = next(iter(read.values()), one)
        if one.views != first.views:
            raise ResultsError(
                f"{file}: has {number_of(one.views, 'view')} of each episode,"
                f" {first.method} {first.views}; they are compared after equally many"
            )
        read[one.method] = one
    return list(read.values())


def _check_submission(one: Submission, frozen: FrozenArchive, file: str) -> None:
    """Check that a file of results belongs to an archive and is whole; ResultsError."""
    if one.format != SUBMISSION_FORMAT:
        raise ResultsError(
            f"{file}: has format {one.format}, this version reads {SUBMISSION_FORMAT}"
        )
    if one.archive_sha256 != frozen.sha256:
        raise ResultsError(
            f"{file}: is of another archive ({one_line(one.archive)},"
            f" {one.archive_sha256[:12]}), not of {frozen.manifest.name},"
            f" {frozen.sha256[:12]}"
        )

    counts = Counter(each.episode for each in one.episodes)
    for number in dict.fromkeys((*frozen.numbers, *counts)):
        count = counts[number]
        if number not in frozen.numbers or count != 1:
            raise ResultsError(
                f"{file}: answers episode {one_line(number)} {number_of(count, 'time')};"
                f" each of the {len(frozen.numbers)} is answered once"
            )

    for each in one.episodes:
        _check_episode(each, one.views, frozen, f"{file}, episode {each.episode}")


def _check_episode(
    one: SubmittedEpisode, views: int, frozen: FrozenArchive, where: str
) -> None:
    """Check what was said in an episode; ResultsError."""
    told = frozen.episode(one.episode)
    taken = [said.view for said in one.said]
    there = len(told.poses)
    if len(taken) != min(views, there) or not taken:
        raise ResultsError(
            f"{where}: has {number_of(len(taken), 'view')}, not {min(views, there)}"
        )
    if (
        taken[0] != told.first
        or len(set(taken)) < len(taken)
        or not all(0 <= view < there for view in taken)
    ):
        raise ResultsError(
            f"{where}: its views {taken} do not begin with {told.first}, or repeat one"
        )

    for said in one.said:
        check_said(said.name, said.confidence, said.pose, tuple(frozen.things), where)


def _scored(
    one: Submission,
    frozen: FrozenArchive,
    truths: dict[str, EpisodeTruth],
    clouds: dict[str, Float],
) -> Scored:
    """Compare a file with the truth; ``clouds`` keeps points on the scans."""
    by_number = {each.episode: each.said for each in one.episodes}
    said = tuple(by_number[number] for number in truths)
    right = np.zeros((len(said), one.views), bool)
    errors = []

    for row, (answers, truth) in enumerate(zip(said, truths.values(), strict=True)):
        names = [each.name == truth.thing for each in answers]
        # where an episode has fewer views, the last answer stands
        right[row] = [names[min(k, len(names) - 1)] for k in range(one.views)]
        pose = answers[-1].pose
        if not names[-1] or pose is None:
            continue
        if truth.thing not in clouds:
            scan = load_mesh(frozen.scan(truth.thing), unit="m")
            surface = Surface.from_mesh(scan, truth.thing)
            rng = np.random.default_rng(0)
            clouds[truth.thing] = surface.sample(SURFACE_POINTS, rng)
        off = add_s(clouds[truth.thing], np.array(pose), np.array(truth.pose))
        errors.append(1000 * off)
    return Scored(one, said, right, tuple(errors))


def _compared(
    frozen: FrozenArchive,
    scored: Sequence[Scored],
    truths: Sequence[EpisodeTruth],
    reference: str | None,
    resampling: tuple[int, int],
) -> ComparedTables:
    """Compare the methods; ``resampling`` is the number of samples, and their seed."""
    things = [truth.thing for truth in truths]
    families = np.unique(things, return_inverse=True)[1]
    samples, seed = resampling
    drawn = st.resample_families(families, samples, np.random.default_rng(seed))
    episodes = pd.concat([one.episodes() for one in scored])
    counted = Counted.of(episodes, SHARES, {}, families)
    views = scored[0].right.shape[1]
    posed = [
        (one.submission.method, None, views, ADD_S, np.median(one.errors or np.nan))
        for one in scored
    ]
    errors = measures_of(ALL, [(*row, np.nan, np.nan) for row in posed])

    blind = best_blind_method(scored)
    chosen = ""
    if reference is None and blind is not None:
        chosen = (
            f"The reference, {blind}, is the best blind method on these same episodes, which"
            " favours it."
        )
    compared = reference or blind or scored[0].submission.method
    tests = counted.tests(ALL, drawn, compared, tested_by((RIGHT,)))
    columns = [
        Column(f"right after {k + 1}", (RIGHT,), k + 1, short=f"right after {k + 1}")
        for k in range(views)
    ]
    columns += [Column(name, (name,), views, short=name) for name in LAST]
    columns.append(Column(ADD_S, (ADD_S,), views, 1, ADD_S))
    about = (
        f"{number_of(len(truths), 'episode')}, {number_of(len(set(things)), 'thing')}"
    )
    return ComparedTables(
        pd.concat([counted.measures(ALL, drawn), errors], ignore_index=True),
        corrected([tests]),
        compared,
        (Board(one_line(frozen.manifest.name), tuple(columns), about),),
        chosen,
    )


def best_blind_method(scored: Sequence[Scored]) -> str | None:
    """Return the blind method that is right most often after the views that it chose.

    Args:
        scored: all methods.

    Returns:
        Its name; None if there is none.
    """
    blind = [one for one in scored if one.submission.blind]
    if not blind:
        return None
    best = max(
        blind,
        key=lambda one: float(one.right[:, min(1, one.right.shape[1] - 1) :].mean()),
    )
    return best.submission.method
