"""The leaderboard of a frozen archive: files of results are checked, compared and put on a page.

Names of methods and of archives come from elsewhere: each is one line without control characters.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nextview.checks import number_of, one_line, whole
from nextview.data.progress import TrackProgress, silently
from nextview.errors import ResultsError, UsageError
from nextview.files import check_new, new_folder, read_record
from nextview.geometry.mesh import load_mesh
from nextview.things.surface import Surface
from nextview.types import Float
from nextview_lab.benchmark import statistics as st
from nextview_lab.benchmark.board_page import NONE, WrittenTable, points
from nextview_lab.benchmark.comparison import (
    ALL,
    ONE,
    Counted,
    corrected,
    too_few,
    values_of,
)
from nextview_lab.benchmark.frozen import EpisodeTruth, FrozenArchive
from nextview_lab.benchmark.methods import check_said
from nextview_lab.benchmark.page import render
from nextview_lab.benchmark.submit import (
    SUBMISSION_FORMAT,
    SaidAfterView,
    Submission,
    SubmittedEpisode,
)
from nextview_lab.data.metrics import add_s
from nextview_lab.extras import extras

with extras():
    import pandas as pd

RIGHT = "right"
CONFIDENT_RIGHT = "confident_right"
CONFIDENT_WRONG = "confident_wrong"
UNKNOWN_SAID = "unknown"
SHARES = {
    name: (name, ONE)
    for name in (RIGHT, CONFIDENT_RIGHT, CONFIDENT_WRONG, UNKNOWN_SAID)
}
SURFACE_POINTS = 2_000
MOST_SAMPLES = 100_000  # of the bootstrap
PAGE_FILE = "leaderboard.html"


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
            CONFIDENT_RIGHT: sure & right,
            CONFIDENT_WRONG: sure & ~right,
            UNKNOWN_SAID: [one.name is None for one in last],
        }
        after = enumerate(self.right.T, 1)
        return pd.concat(
            [pd.DataFrame({**columns, "views": k, RIGHT: own}) for k, own in after]
        )


@dataclass(frozen=True)
class Leaderboard:
    """Methods that are compared on an archive.

    Attributes:
        archive: its name.
        reference: the method with which the others are compared; None without a blind one.
        tables: all of them, the most important first.
        notes: what a reader has to know.
    """

    archive: str
    reference: str | None
    tables: tuple[WrittenTable, ...]
    notes: tuple[str, ...]


def leaderboard_of(
    folder: Path,
    archive: Path,
    out: Path,
    reference: str | None = None,
    samples: int = 10_000,
    seed: int = 0,
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> Leaderboard:
    """Compare the methods of a folder of results on their archive.

    Each file that nextview-lab submit wrote is checked: whether it belongs to this archive, answers
    every episode once, names only things of the archive, and has poses that are rigid. Then names
    and poses are compared with the truth, and methods with the best blind one, whose views ignore
    the images, episode by episode.

    Args:
        folder: with the result files of nextview-lab submit (.json).
        archive: folder of the archive, with its truth.
        out: folder to write, with leaderboard.html.
        reference: method with which the others are compared; by default the blind one that is right
            most often after the first view.
        samples: number of bootstrap samples.
        seed: seed of the bootstrap.
        overwrite: replace the page in OUT.
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
    scored: list[Scored] = []

    def score() -> Iterator[int]:
        for one in read:
            scored.append(_scored(one, frozen, truths, clouds))
            yield len(scored)

    track(score(), len(read), "methods")
    scored.sort(key=lambda one: (-one.right[:, -1].mean(), one.submission.method))

    board = _board(frozen, scored, list(truths.values()), reference, samples, seed)
    with new_folder(Path(out), overwrite) as part:
        page = render("leaderboard.html", board=board, sha256=frozen.sha256)
        (part / PAGE_FILE).write_text(page, encoding="utf-8")
    return board


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
            name: one_line(getattr(one, name), 100) for name in ("method", "version")
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


def _board(
    frozen: FrozenArchive,
    scored: Sequence[Scored],
    truths: Sequence[EpisodeTruth],
    reference: str | None,
    samples: int,
    seed: int,
) -> Leaderboard:
    """Compare the methods with each other, and put them into tables."""
    things = [truth.thing for truth in truths]
    order = {name: row for row, name in enumerate(dict.fromkeys(things))}
    families = np.array([order[name] for name in things])
    weights = st.resample_families(families, samples, np.random.default_rng(seed))
    episodes = pd.concat([one.episodes() for one in scored])
    counted = Counted.of(episodes, SHARES, {}, families)
    shares = counted.measures(ALL, weights)

    compared = best_blind_method(scored) if reference is None else reference
    tables = [_main_table(scored, shares, len(order))]
    notes = [
        f"{len(truths)} episodes with {number_of(len(order), 'thing')}; episodes with one thing are"
        " resampled together.",
        "All of it is simulated, with true masks. Poses are compared in the world, with the error"
        " of the reported poses of the cameras.",
    ]
    if compared is not None and len(scored) > 1:
        tests = counted.tests(
            ALL, weights, compared, lambda key: key.measure == RIGHT and key.views > 1
        )
        if len(tests):
            tables.append(_differences_table(corrected([tests]), compared))
            notes += filter(None, [too_few(tests)])
            if reference is None:
                notes.append(
                    f"The reference, {compared}, is the best blind method on these same episodes,"
                    " which favours it."
                )
    name = one_line(frozen.manifest.name)
    return Leaderboard(name, compared, tuple(tables), tuple(notes))


def _main_table(
    scored: Sequence[Scored],
    shares: "pd.DataFrame",
    things: int,
) -> WrittenTable:
    """Return the table of all methods."""
    views = scored[0].right.shape[1]
    columns = [
        *(
            (f"right after {number_of(k + 1, 'view')}", RIGHT, k + 1)
            for k in range(views)
        ),
        ("confident and right", CONFIDENT_RIGHT, views),
        ("confident and wrong", CONFIDENT_WRONG, views),
        ("unknown", UNKNOWN_SAID, views),
    ]

    numbers = values_of(shares)
    rows = []
    for one in scored:
        name = one.submission.method
        cells = [
            _with_interval(numbers[name, measure, at], things)
            for _, measure, at in columns
        ]
        off = f"{np.median(one.errors):.1f}" if one.errors else NONE
        rows.append((f"{name} ({one.submission.version})", *cells, off))

    return WrittenTable(
        "Methods",
        f"Confident, unknown and poses are those after {number_of(views, 'view')}; poses are those"
        " of things that are named right. In brackets: 95 % bootstrap intervals; Wilson's, with as"
        " many samples as things, where all episodes agree.",
        (
            "method",
            *(heading for heading, _, _ in columns),
            "ADD-S, mm, median",
        ),
        tuple(rows),
    )


def _with_interval(number: tuple[float, float, float], things: int) -> str:
    """Format a share with its interval.

    Where all episodes agree, a bootstrap tells nothing: Wilson's interval for so many things.
    """
    value, low, high = number
    if value in (0, 1):
        low, high = st.wilson(int(value) * things, things)
    return f"{value:.3f} ({low:.3f} to {high:.3f})"


def _differences_table(tests: "pd.DataFrame", reference: str) -> WrittenTable:
    """Return the table of differences to the reference."""
    rows = []
    for policy, views, *numbers in tests[
        ["policy", "views", "difference", "low", "high", "p", "p_holm"]
    ].itertuples(index=False):
        apart, low, high = map(points, numbers[:3])
        p = (f"{number:.3g}" for number in numbers[3:])
        rows.append(
            (policy, number_of(views, "view"), f"{apart} ({low} to {high})", *p)
        )
    return WrittenTable(
        f"Differences to {reference}",
        "Share that is right, percentage points, on the same episodes; p-values of sign flips over"
        " the things, as they are and after Holm's correction over all rows.",
        ("method", "after", "difference", "p", "p, corrected"),
        tuple(rows),
    )
