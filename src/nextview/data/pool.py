"""Run a function on many items, on all cores or on a dask.distributed cluster."""

import io
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from nextview.checks import extras, whole
from nextview.errors import DatasetError

MOST_WORKERS = 1024  # processes on one machine
PATIENCE = "10s"  # how long a scheduler may take to answer

_starting = threading.Lock()

GivenItem = TypeVar("GivenItem")
Result = TypeVar("Result")


@dataclass(frozen=True)
class WorkerDied:
    """The process that worked on an item was killed or crashed twice.

    Attributes:
        reason: What happened, in words. ``str`` gives it, too.
    """

    reason: str

    def __str__(self) -> str:
        return self.reason


def count(workers: int | None) -> int:
    """The number of processes: one for each core by default."""
    return (
        os.cpu_count() or 1
        if workers is None
        else whole(workers, "the number of workers", 0, MOST_WORKERS)
    )


def each(
    function: Callable[[GivenItem], Result],
    items: Sequence[GivenItem],
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[GivenItem, Result | WorkerDied]]:
    """Call a function for every item in parallel.

    Function and items must be picklable, items hashable. A script whose functions or classes are
    passed in has to guard its code by ``if __name__ == "__main__"``; no other script has to. If a
    process dies, its item is tried once more alone, and costs only its own result if the process
    dies again. What the function raises ends the run.

    Args:
        function: called with an item.
        items: the items.
        workers: number of processes; None for one on each core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.

    Yields:
        Each item and its result, in any order.
    """
    if scheduler is not None:
        yield from _on_cluster(function, items, scheduler)
        return
    workers = count(workers)
    if workers == 0:
        yield from ((item, function(item)) for item in items)
        return
    waiting = list(items)
    while waiting:
        finished = set()
        try:
            for item, result in _in_pool(function, waiting, workers):
                finished.add(item)
                yield item, result
            return
        except BrokenProcessPool:
            waiting = [item for item in waiting if item not in finished]
            # Items are begun in order, so the first that are not finished were being worked on. Try
            # each alone.
            suspects = waiting[:workers]
            waiting = waiting[workers:]
            for item in suspects:
                try:
                    yield from _in_pool(function, [item], 1)
                except BrokenProcessPool:
                    yield item, WorkerDied("the process that worked on it died, twice")


def counted(
    function: Callable[[GivenItem], None],
    items: Sequence[GivenItem],
    total: int,
    name: Callable[[GivenItem], str],
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, int]]:
    """Call a function for the remaining items and count; see ``each``.

    Args:
        function: called with an item.
        items: those that are left.
        total: number of all items, with those done before.
        name: returns the name of an item, for messages.
        workers: number of processes; None for one on each core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.

    Yields:
        Number of items done so far, and the total.
    """
    before = total - len(items)
    yield before, total
    for finished, (item, result) in enumerate(
        each(function, items, workers, scheduler),
        before + 1,
    ):
        if isinstance(result, WorkerDied):
            raise DatasetError(f"{name(item)} cannot be computed: {result}")
        yield finished, total


def _in_pool(
    function: Callable[[GivenItem], Result],
    items: Sequence[GivenItem],
    workers: int,
) -> Iterator[tuple[GivenItem, Result]]:
    start = (
        multiprocessing.get_context("spawn")
        if _of_script(function, items)
        else _OwnMainContext()
    )
    pool = ProcessPoolExecutor(min(workers, len(items)), start, _begin_worker)
    try:
        jobs = {pool.submit(function, item): item for item in items}
        for job in as_completed(jobs):
            yield jobs[job], job.result()
    finally:
        pool.shutdown(cancel_futures=True)


class _NamedModules(ForkingPickler):
    """Passes work on as a pool does, and remembers the modules of what it names."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO())
        self.modules: set[str] = set()

    def reducer_override(self, named: Any) -> Any:
        """Called for functions, classes and their instances; they are pickled as usual."""
        self.modules.add(getattr(named, "__module__", ""))
        return NotImplemented


def _of_script(function: Callable, items: Sequence[Any]) -> bool:
    """Whether a worker needs the script that runs.

    It does if the function, or what it is called with, is defined there: workers import the modules
    that what is passed to them names.
    """
    pickler = _NamedModules()
    pickler.dump((function, items))
    return "__main__" in pickler.modules


class _OwnMain(SpawnProcess):
    """A worker that does not run the caller's script.

    A process of multiprocessing imports it, so a script that calls a function of this package would
    have to stand below ``if __name__ == "__main__"``: else each worker calls that function again.
    """

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        def without_script(name: str) -> dict[str, Any]:
            told = usual(name)
            if (
                name != process_obj.name
            ):  # another thread starts a process of its own meanwhile
                return told
            return {
                key: value
                for key, value in told.items()
                if not key.startswith("init_main_from")
            }

        with _starting:
            usual = spawn.get_preparation_data
            spawn.get_preparation_data = without_script
            try:
                return SpawnProcess._Popen(process_obj)
            finally:
                spawn.get_preparation_data = usual


class _OwnMainContext(SpawnContext):
    """Starts such workers."""

    Process = _OwnMain


def _begin_worker() -> None:
    """Prepare a worker: one core, a silent end with Ctrl-C and with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threadpool_limits(1, "blas")
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _on_cluster(
    function: Callable,
    items: Sequence[GivenItem],
    scheduler: str,
) -> Iterator[tuple[GivenItem, Any]]:
    with extras():
        from distributed import Client, KilledWorker, as_completed
    try:
        client = Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{scheduler}: no dask scheduler answers there ({error})"
        ) from None
    with client:
        jobs = dict(zip(client.map(function, items, pure=False), items, strict=True))
        for job in as_completed(jobs):
            try:
                yield jobs[job], job.result()
            except KilledWorker:
                yield jobs[job], WorkerDied("the workers that worked on it died")
