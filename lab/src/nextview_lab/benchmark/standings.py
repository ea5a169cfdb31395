"""The leaderboard of a frozen archive: files of results are checked, compared and put on a page."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from nextview.checks import number_of, one_line, whole
from nextview.data.progress import TrackProgress, silently
from nextview.errors import ResultsError, UsageError
from nextview.files import check_new, new_folder, read_record
from nextview.geometry.mesh import load_mesh
from nextview.recognition.poses import PoseCandidate, turn_apart
from nextview.things.surface import Surface
from nextview.things.symmetry import find_symmetries
from nextview.types import Float, Index
from nextview_lab.benchmark import statistics as st
from nextview_lab.benchmark.board_page import (
    NONE,
    Leaderboard,
    WrittenTable,
    as_markdown,
    plain,
    points,
)
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
    mean_seconds,
)
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
SURFACE_POINTS = 20_000  # among which the nearest is looked for
JUDGED_POINTS = 2_000  # of the true surface
MOST_SAMPLES = 100_000  # of the bootstrap
PAGE_FILE = "leaderboard.html"
TEXT_FILE = "leaderboard.md"


@dataclass(frozen=True, eq=False)
class Scored:
    """A file of results beside the truth.

    Attributes:
        submission: the file.
        said: after each view of each episode, in the order of the archive.
        right: whether the name is right, (episodes, views) bool.
        distances: median distance of surfaces, mm, after the last view of the episodes whose name
            is right and has a pose, (E,).
        turns: rotation error modulo symmetries of the same episodes, degrees, (E,).
        posed: rows of these episodes, (E,) int64.
    """

    submission: Submission
    said: tuple[tuple[SaidAfterView, ...], ...]
    right: Any
    distances: Float
    turns: Float
    posed: Index

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


class KnownShape:
    """The scan of a thing, to compare poses of it."""

    def __init__(self, file: Path, name: str) -> None:
        """Read the scan.

        Args:
            file: of the scan, in metres.
            name: of the thing.
        """
        self._surface = Surface.from_mesh(load_mesh(file, unit="m"), name)
        rng = np.random.default_rng(0)
        triangles = self._surface.triangles_by_area(SURFACE_POINTS, rng)
        corners = self._surface.vertices[self._surface.faces[triangles]].astype(float)
        shares = rng.dirichlet((1.0, 1.0, 1.0), SURFACE_POINTS)
        self._points = (shares[:, :, None] * corners).sum(1)
        edges = corners[:, 1:] - corners[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._tree = cKDTree(self._points)

    @cached_property
    def symmetry(self) -> tuple[Any, ...]:
        """Axes about which it looks the same after a turn."""
        return find_symmetries(self._surface)

    def distance(self, pose: Float, true: Float) -> float:
        """Return the median distance of the true surface from the posed one, millimetres.

        Args:
            pose: that is judged, (4, 4), metres.
            true: pose, (4, 4), metres.
        """
        there = self._points[:JUDGED_POINTS] @ true[:3, :3].T + true[:3, 3]
        in_scan = (there - pose[:3, 3]) @ pose[:3, :3]
        _, nearest = self._tree.query(in_scan)
        off = ((in_scan - self._points[nearest]) * self._normals[nearest]).sum(1)
        return float(1000 * np.median(np.abs(off)))

    def turn(self, pose: Float, true: Float) -> float:
        """Return the angle between two poses modulo the symmetries, degrees.

        Args:
            pose: the one, (4, 4).
            true: the other, (4, 4).
        """
        one, other = (
            PoseCandidate("", 0, each, 1.0, symmetry=self.symmetry)
            for each in (pose, true)
        )
        return turn_apart(one, other)


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
        out: folder to write, with leaderboard.html and leaderboard.md.
        reference: method with which the others are compared; by default the blind one that is right
            most often after the first view.
        samples: number of bootstrap samples.
        seed: seed of the bootstrap.
        overwrite: replace the two files in OUT.
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
    shapes: dict[str, KnownShape] = {}
    scored: list[Scored] = []
    track(_score_all(read, frozen, truths, shapes, scored), len(read), "methods")
    scored.sort(key=lambda one: (-one.right[:, -1].mean(), one.submission.method))

    board = _board(frozen, scored, list(truths.values()), reference, samples, seed)
    with new_folder(Path(out), overwrite) as part:
        page = render("leaderboard.html", board=board, sha256=frozen.sha256)
        (part / PAGE_FILE).write_text(page, encoding="utf-8")
        (part / TEXT_FILE).write_text(as_markdown(board), encoding="utf-8")
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
        one = msgspec.structs.replace(one, views=longest)
        shown = one_line(one.method)
        if shown in read:
            raise ResultsError(f"{file}: another file has the method {one.method}, too")

        first = next(iter(read.values()), one)
        if one.views != first.views:
            raise ResultsError(
                f"{file}: has {number_of(one.views, 'view')} of each episode,"
                f" {first.method} {first.views}; they are compared after equally many"
            )
        read[shown] = one
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


def _score_all(
    read: Sequence[Submission],
    frozen: FrozenArchive,
    truths: dict[str, EpisodeTruth],
    shapes: dict[str, KnownShape],
    scored: list[Scored],
) -> Iterator[int]:
    """Compare each file with the truth; yields how many are done."""
    for done, one in enumerate(read, 1):
        scored.append(_scored(one, frozen, truths, shapes))
        yield done


def _scored(
    one: Submission,
    frozen: FrozenArchive,
    truths: dict[str, EpisodeTruth],
    shapes: dict[str, KnownShape],
) -> Scored:
    """Compare a file with the truth."""
    by_number = {each.episode: each.said for each in one.episodes}
    said = tuple(by_number[number] for number in truths)
    right = np.zeros((len(said), one.views), bool)
    posed = []
    distances = []
    turns = []

    for row, (answers, truth) in enumerate(zip(said, truths.values(), strict=True)):
        names = [each.name == truth.thing for each in answers]
        # where an episode has fewer views, the last answer stands
        right[row] = [names[min(k, len(names) - 1)] for k in range(one.views)]
        pose = answers[-1].pose
        if not names[-1] or pose is None:
            continue
        if truth.thing not in shapes:
            shapes[truth.thing] = KnownShape(frozen.scan(truth.thing), truth.thing)
        shape = shapes[truth.thing]
        found = np.array(pose)
        true = np.array(truth.pose)
        posed.append(row)
        distances.append(shape.distance(found, true))
        turns.append(shape.turn(found, true))
    rows = np.array(posed, np.int64)
    return Scored(one, said, right, np.array(distances), np.array(turns), rows)


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
    tables = [_main_table(scored, shares, weights, len(order))]
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
    return plain(
        Leaderboard(frozen.manifest.name, compared, tuple(tables), tuple(notes))
    )


def _main_table(
    scored: Sequence[Scored],
    shares: "pd.DataFrame",
    weights: Float,
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

        seconds = mean_seconds(one.submission.episodes)
        rows.append(
            (
                f"{name} ({one.submission.version})",
                *cells,
                _median(one.distances, one.posed, weights),
                _median(one.turns, one.posed, weights),
                NONE if seconds is None else f"{seconds:.2f}",
            )
        )

    return WrittenTable(
        "Methods",
        f"Confident, unknown and poses are those after {number_of(views, 'view')}; poses are those"
        " of things that are named right. CPU time is that of a method and of processes that it has"
        " waited for."
        " In brackets: 95 % bootstrap intervals; Wilson's, with as many samples as things, where"
        " all episodes agree.",
        (
            "method",
            *(heading for heading, _, _ in columns),
            "surface off, mm, median",
            "rotation off, degrees, median",
            "CPU, s a view",
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


def _median(values: Float, rows: Index, weights: Float) -> str:
    """Format a median of some episodes with its interval; ``weights`` are (S, episodes)."""
    if not len(values):
        return NONE
    order = np.argsort(values)
    once = np.ones((1, weights.shape[1]))
    total = np.cumsum(np.vstack([once, weights])[:, rows[order]], axis=1)
    total = total[total[:, -1] > 0]
    half = (total >= total[:, -1:] / 2).argmax(1)
    medians = values[order][half]
    low, high = np.quantile(medians[1:], (0.025, 0.975))
    return f"{medians[0]:.1f} ({low:.1f} to {high:.1f})"


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
