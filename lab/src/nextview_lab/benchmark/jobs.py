"""Run the episodes of a benchmark as parallel, resumable jobs, each with its own record.

A folder of results contains ``runs``, a small file with the runs of all policies in each episode;
``episodes.json``, the conditions of the episodes; ``benchmark.json``, the settings; and the tables
and figures, which every run rewrites. Workers import this module, so it imports neither pandas nor
matplotlib.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from nextview.checks import whole
from nextview.data import pool
from nextview.data.progress import TrackProgress
from nextview.errors import ResultsError, UsageError
from nextview.files import check_new, read_record, write_record

EPISODES_FILE = "episodes.json"  # conditions of the episodes in a folder


@dataclass(frozen=True)
class Settings:
    """Policies and statistics of any benchmark.

    Attributes:
        policies: names of policies, or MODULE:NAME for your own; by default all that the input
            allows. In a folder of results only missing ones run; your own always run again.
        reference: policy with which the others are compared; it is always included.
        views: numbers of views after which the policies are compared; the largest is the length of
            an episode, unless that has an option of its own.
        samples: number of bootstrap samples.
        seed: seed of all that is drawn: objects and their places, first views, noise, and random
            policies.
    """

    policies: tuple[str, ...] = ()
    reference: str = "random"
    views: tuple[int, ...] = ()
    samples: int = 10_000
    seed: int = 0

    def check(self) -> None:
        """Check the settings before any work is done.

        Raises:
            UsageError: a number is invalid.
        """
        whole(self.samples, "the samples of the bootstrap", 100)
        if not self.views or list(self.views) != sorted(set(self.views)):
            raise UsageError("the numbers of views ascend, as in --views 1 2 3")
        whole(self.views[0], "a number of views", 1)


Runs = TypeVar("Runs", bound=msgspec.Struct)
OneJob = TypeVar("OneJob", bound="Job")


@dataclass(frozen=True)
class Job:
    """One episode, and the policies to run in it.

    Attributes:
        settings: of the benchmark.
        out: folder of the results.
        name: of the files of the episode.
        policies: their names.
    """

    settings: Any
    out: Path
    name: str
    policies: tuple[str, ...]

    @property
    def runs_file(self) -> Path:
        """Path of its record."""
        return self.out / "runs" / f"{self.name}.json"

    def earlier(self, kind: type[Runs]) -> Runs | None:
        """Read its record; None if there is none.

        Args:
            kind: type of the record.

        Raises:
            ResultsError: the file is damaged.
        """
        if not self.runs_file.exists():
            return None
        return read_record(self.runs_file, kind, "runs", ResultsError)

    def write(self, runs: msgspec.Struct) -> None:
        """Write its record, replacing an earlier one."""
        self.runs_file.parent.mkdir(parents=True, exist_ok=True)
        write_record(self.runs_file, runs, overwrite=True)

    def left(self: OneJob, kind: type[Runs], anew: bool = False) -> OneJob | None:
        """Return the job with the unfinished policies; None if all are done.

        Custom policies always run again.

        Args:
            kind: type of its record.
            anew: whether to run all policies again.
        """
        done: Any = self.earlier(kind)
        if done is None or anew:
            return self
        left = [name for name in self.policies if name not in done.runs or ":" in name]
        return replace(self, policies=tuple(left)) if left else None


def run_jobs(
    work: Callable[[OneJob], None],
    jobs: Sequence[OneJob],
    kind: type[Runs],
    workers: int | None,
    track: TrackProgress,
    anew: bool = False,
) -> list[Runs]:
    """Run the unfinished policies of some jobs.

    Args:
        work: runs a job, and writes its record.
        jobs: all of them.
        kind: type of their records.
        workers: number of processes; None for one per core, 0 for this process.
        track: callable that shows progress.
        anew: whether to run all of them again.

    Returns:
        The records of all jobs.
    """
    left = [job for job in (each.left(kind, anew) for each in jobs) if job is not None]
    steps = pool.counted(work, left, len(jobs), lambda job: job.name, workers)
    next(steps)
    track((done for done, _ in steps), len(jobs), "episodes")
    return [read_record(job.runs_file, kind, "runs", ResultsError) for job in jobs]


def check_place(out: Path, own: str = EPISODES_FILE) -> None:
    """Check that a folder is new, or contains results of this benchmark.

    Args:
        out: the folder.
        own: a folder or file that exists before the first episode is finished.

    Raises:
        ResultsError: it contains something else.
    """
    check_new(out, overwrite=True, folder=True)
    if not out.is_dir() or any((out / name).exists() for name in (EPISODES_FILE, own)):
        return
    strange = [path.name for path in out.iterdir() if not path.name.startswith(".")]
    if strange:
        raise ResultsError(
            f"{out}: holds {strange[0]}, and no results of this benchmark"
        )


def check_same(out: Path, made: dict[str, Any]) -> None:
    """Check that the conditions of a folder's episodes are those of this run.

    In a new folder they are written down.

    Args:
        out: folder of the results.
        made: conditions, by setting.

    Raises:
        ResultsError: they differ.
    """
    out.mkdir(parents=True, exist_ok=True)
    file = out / EPISODES_FILE
    if not file.exists():
        write_record(file, made)
        return

    before = read_record(file, dict[str, Any], "a record of episodes", ResultsError)
    for name, new in made.items():
        old = before.get(name)
        if old != new:
            what = name.removesuffix("_sha256")
            raise ResultsError(
                f"{out}: its episodes are of another {what} ({old}, not {new}); give another folder"
            )
