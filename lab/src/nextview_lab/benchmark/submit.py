"""Run a method over a frozen archive, and write its answers into one file of results."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from nextview.checks import one_line, whole
from nextview.data.progress import TrackProgress, silently
from nextview.errors import UsageError
from nextview.files import (
    HashText,
    check_new,
    only_one,
    read_record,
    unfinished,
    write_record,
)
from nextview_lab.benchmark.frozen import LARGEST_FROZEN_VIEWS, FrozenArchive
from nextview_lab.benchmark.methods import (
    CommandMethod,
    FrozenLook,
    Method,
    NextviewMethod,
    PoseRows,
    check_answer,
)

SUBMISSION_FORMAT = 1
COMMON_VIEWS = 3  # of an episode
LONGEST_NAME = 80  # letters of a method's name, of its version, and of a policy

# what a field of a file of results may be: more would be no result, but work
ViewNumber = Annotated[int, msgspec.Meta(ge=0, lt=LARGEST_FROZEN_VIEWS)]
ViewCount = Annotated[int, msgspec.Meta(ge=1, le=LARGEST_FROZEN_VIEWS)]
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
ShortText = Annotated[
    str, msgspec.Meta(min_length=1, max_length=len("nextview ") + LONGEST_NAME)
]
FileName = Annotated[str, msgspec.Meta(max_length=255)]


@dataclass(frozen=True)
class SubmitOptions:
    """Which method runs, and how many views it gets.

    Attributes:
        policy: how nextview chooses views: geometry, sampled, predicted, random, spread, furthest,
            fixed, ring, or a policy of your own, MODULE:CLASS.
        models: memory of nextview; it has to be taught with the scans of the archive.
        command: run another process instead of nextview, such as "python my_method.py". It reads a
            line of JSON for each view and writes one as its answer (docs/submit.md).
        name: name of the method in tables; needed with --command.
        version: version of the method; needed with --command.
        blind: the next views of --command ignore the images, so that it can be the reference for
            those that look.
        max_views: views of each episode, or all of them where there are fewer.
        seed: seed of nextview's random policies.
    """

    policy: str = "geometry"
    models: str = "ycb"
    command: str | None = None
    name: str | None = None
    version: str | None = None
    blind: bool = False
    max_views: int = COMMON_VIEWS
    seed: int = 0


class SaidAfterView(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a method said after a view.

    Attributes:
        view: which of the candidate views it had.
        name: of the thing; None for unknown.
        confidence: probability of the name.
        confident: whether a robot should act on it.
        pose: from the scan to the world, (4, 4), metres; None without one.
    """

    view: ViewNumber
    name: FileName | None
    confidence: Probability
    confident: bool
    pose: PoseRows | None


class SubmittedEpisode(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a method said in an episode.

    Attributes:
        episode: number of the episode.
        said: after each view, in order.
    """

    episode: FileName
    said: tuple[SaidAfterView, ...]


class Submission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file of results: what a method said in all episodes of an archive.

    Attributes:
        format: of the file, SUBMISSION_FORMAT.
        archive: name of the archive.
        archive_sha256: of its manifest.
        method: name of the method.
        version: of the method.
        blind: whether its next views ignore the images.
        run: how it was run: the command, or the memory, the policy and the seed.
        views: of each episode, or all of them where there are fewer.
        episodes: what it said.
    """

    format: int
    archive: str
    archive_sha256: HashText
    method: ShortText
    version: ShortText
    blind: bool
    run: str
    views: ViewCount
    episodes: tuple[SubmittedEpisode, ...]


def submit(
    archive: Path,
    out: Path,
    how: SubmitOptions = SubmitOptions(),
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> Submission:
    """Run a method over the episodes of a frozen archive, and write its answers.

    A method sees a depth image, a mask and poses of cameras, names what it sees, and chooses
    the next view. It does not know what the images show: only nextview-lab leaderboard reads the
    truth. Without --command the method is nextview itself. An interrupted run resumes.

    Args:
        archive: folder of the archive, such as nextview-bench-1.0.
        out: file of results to write, .json.
        how: method and number of views.
        overwrite: replace OUT.
        track: follows the episodes.

    Returns:
        What the method said.

    Raises:
        DatasetError: the archive is damaged.
        ResultsError: ``out`` exists, or the method answers something that is no answer.
        UsageError: an option makes no sense, or the method cannot be started.
    """
    out = Path(out)
    check_new(out, overwrite)
    _check_options(out, how)
    frozen = FrozenArchive(archive)
    ours = f"--models {how.models} --policy {how.policy} --seed {how.seed}"
    run = ours if how.command is None else how.command

    key = hashlib.sha256(
        msgspec.json.encode([frozen.sha256, run, how.name, how.version, how.max_views])
    ).hexdigest()
    with only_one(out), unfinished(out, key) as parts:
        with _method(frozen, how) as method:
            steps = _episodes(frozen, method, how, parts)
            track(steps, len(frozen.numbers), "episodes")
        episodes = tuple(
            read_record(parts / f"{number}.json", SubmittedEpisode, "answers")
            for number in frozen.numbers
        )
        submission = Submission(
            SUBMISSION_FORMAT,
            frozen.manifest.name,
            frozen.sha256,
            method.name,
            method.version,
            method.blind,
            run,
            how.max_views,
            episodes,
        )
        write_record(out, submission, overwrite)
    return submission


def _check_options(out: Path, how: SubmitOptions) -> None:
    """Check the options before any work is done; UsageError."""
    if out.suffix.lower() != ".json":
        raise UsageError(f"{out}: the name ends in .json")
    whole(how.max_views, "the number of views", 1, LARGEST_FROZEN_VIEWS)
    if how.command is None and (how.name or how.version or how.blind):
        raise UsageError("--name, --version and --blind are for a --command")
    if how.command is not None and not (how.name and how.version):
        raise UsageError("a --command needs a --name and a --version, for the table")
    texts = {"--name": how.name, "--version": how.version, "--policy": how.policy}
    for option, text in texts.items():
        if text is not None and one_line(text, LONGEST_NAME) != text:
            raise UsageError(
                f"{option}: is one line of {LONGEST_NAME} letters at most, for the table, not"
                f" {one_line(repr(text))}"
            )


@contextmanager
def _method(frozen: FrozenArchive, how: SubmitOptions) -> Iterator[Method]:
    """Start the method, and end it."""
    if how.command is None:
        yield NextviewMethod(how.policy, how.models, tuple(frozen.things), how.seed)
        return
    assert how.name is not None
    assert how.version is not None
    method = CommandMethod(how.command, how.name, how.version, how.blind)
    try:
        yield method
        method.finish()
    finally:
        method.close()


def _episodes(
    frozen: FrozenArchive,
    method: Method,
    how: SubmitOptions,
    parts: Path,
) -> Iterator[int]:
    """Run each episode that is not done, and keep its answers; yields how many are done."""
    for done, number in enumerate(frozen.numbers, 1):
        part = parts / f"{number}.json"
        if not part.exists():
            write_record(part, run_episode(frozen, number, method, how.max_views))
        yield done


def run_episode(
    frozen: FrozenArchive, episode: str, method: Method, views: int
) -> SubmittedEpisode:
    """Run a method in one episode.

    Args:
        frozen: the archive.
        episode: number of the episode.
        method: that answers.
        views: how many it gets, at most as many as there are.

    Returns:
        What it said.

    Raises:
        DatasetError: a file of the archive is damaged.
        ResultsError: it says something that is no answer.
    """
    told = frozen.episode(episode)
    things = tuple(frozen.things)
    views = min(views, len(told.poses))
    view = told.first
    taken: list[int] = []
    said = []

    for step in range(1, views + 1):
        taken.append(view)
        images = frozen.view(episode, view)
        left = (one for one in range(len(told.poses)) if one not in taken)
        look = FrozenLook(
            episode=episode,
            step=step,
            of=views,
            view=view,
            depth=str(images.depth.resolve()),
            mask=str(images.mask.resolve()),
            metres_per_unit=told.metres_per_unit,
            intrinsics=told.intrinsics,
            poses=told.poses,
            free=tuple(left) if step < views else (),
            held=told.held,
            things=things,
        )
        answer = method.answer(look)
        check_answer(answer, look, f"{method.name}, episode {episode}, view {step}")
        said.append(
            SaidAfterView(
                view,
                answer.name,
                answer.confidence,
                answer.confident,
                answer.pose,
            )
        )
        if look.free:
            assert answer.next is not None  # check_answer
            view = answer.next
    return SubmittedEpisode(episode, tuple(said))
