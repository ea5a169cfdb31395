"""Episodes of a benchmark as jobs: in parallel, each with a record of its own, resumable.

A folder of results holds ``runs``, what each policy made of each episode, a small file for each;
``episodes.json``, how the episodes are shown; the record ``benchmark.json``, which says how it was
run; and the tables and figures, which every run writes anew. Workers import this module, and so
neither pandas nor matplotlib.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from nextview.data import pool
from nextview.data.progress import TrackProgress
from nextview.errors import ResultsError
from nextview.files import check_new, read_record, write_record

EPISODES_FILE = "episodes.json"  # how the episodes of a folder are shown


Runs = TypeVar("Runs", bound=msgspec.Struct)
OneJob = TypeVar("OneJob", bound="Job")


@dataclass(frozen=True)
class Job:
    """One episode, and the policies that are run in it.

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
        """Where its record is written."""
        return self.out / "runs" / f"{self.name}.json"

    def earlier(self, kind: type[Runs]) -> Runs | None:
        """Its record; None if it was not begun.

        Args:
            kind: of the record.

        Raises:
            ResultsError: the file is damaged.
        """
        if not self.runs_file.exists():
            return None
        return read_record(self.runs_file, kind, "runs", ResultsError)

    def write(self, runs: msgspec.Struct) -> None:
        """Write its record, in the place of an earlier one."""
        self.runs_file.parent.mkdir(parents=True, exist_ok=True)
        write_record(self.runs_file, runs, overwrite=True)

    def left(self: OneJob, kind: type[Runs], anew: bool = False) -> OneJob | None:
        """The job with the policies that are not done; None if all are. Your own are done anew.

        Args:
            kind: of its record.
            anew: whether all are done anew.
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
    """Run what is left of some jobs.

    Args:
        work: runs a job, and writes its record.
        jobs: all of them.
        kind: of their records.
        workers: number of processes; None for one on each core, 0 for this process.
        track: follows the work.
        anew: whether all are done anew.

    Returns:
        The records of all jobs.
    """
    left = [job for job in (each.left(kind, anew) for each in jobs) if job is not None]
    steps = pool.counted(work, left, len(jobs), lambda job: job.name, workers)
    next(steps)
    track((done for done, _ in steps), len(jobs), "episodes")
    return [read_record(job.runs_file, kind, "runs", ResultsError) for job in jobs]


def check_place(out: Path, own: str = EPISODES_FILE) -> None:
    """See that a folder is new, or holds results of this benchmark.

    Args:
        out: the folder.
        own: a folder or file that is there before the first episode is.

    Raises:
        ResultsError: it holds something else.
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
    """See that the episodes of a folder are shown as those of this run; note it in a new folder.

    Args:
        out: folder of the results.
        made: how they are shown, by what is set.

    Raises:
        ResultsError: they are shown in another way.
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
