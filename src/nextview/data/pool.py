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
from nextview.cores import cores
from nextview.errors import DatasetError

MOST_WORKERS = 1024  # processes on one machine
PATIENCE = "10s"  # timeout of the connection to a scheduler

_starting = threading.Lock()

GivenItem = TypeVar("GivenItem")
Result = TypeVar("Result")


@dataclass(frozen=True)
class WorkerDied:
    """Result of an item whose process was killed or crashed twice.

    Attributes:
        reason: description, also returned by ``str``.
    """

    reason: str

    def __str__(self) -> str:
        return self.reason


def count(workers: int | None) -> int:
    """Return the number of processes, by default one per core."""
    return (
        cores()
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

    Function and items must be picklable, items hashable. A script that defines the passed functions
    or classes must guard its code by ``if __name__ == "__main__"``; other scripts need not. If a
    process dies, its item is tried once more alone, and fails only if the process dies again.
    Exceptions of the function end the run.

    Args:
        function: called with an item.
        items: the items.
        workers: number of processes; None for one per core, 0 for this process.
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
            # Items are started in order, so the first unfinished ones were being processed. Each is
            # tried alone.
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
        items: remaining items.
        total: number of all items, including those finished before.
        name: returns the name of an item, for messages.
        workers: number of processes; None for one per core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.

    Yields:
        Number of finished items, and the total.
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
    """Pickler that records the modules of pickled functions and classes."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO())
        self.modules: set[str] = set()

    def reducer_override(self, named: Any) -> Any:
        """Record functions, classes and their instances, which are then pickled as usual."""
        self.modules.add(getattr(named, "__module__", ""))
        return NotImplemented


def _of_script(function: Callable, items: Sequence[Any]) -> bool:
    """Return True if a worker needs the running script.

    It does if the function, or one of its arguments, is defined there, because workers import the
    modules of everything passed to them.
    """
    pickler = _NamedModules()
    pickler.dump((function, items))
    return "__main__" in pickler.modules


class _OwnMain(SpawnProcess):
    """A worker that does not run the caller's script.

    A multiprocessing worker imports the script. A script that calls a function of this package
    would therefore need the guard ``if __name__ == "__main__"``, or each worker would call that
    function again.
    """

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        def without_script(name: str) -> dict[str, Any]:
            told = usual(name)
            if name != process_obj.name:  # another thread is starting its own process
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
    """Context that starts such workers."""

    Process = _OwnMain


def _begin_worker() -> None:
    """Prepare a worker: one core, and a silent exit on Ctrl-C or when the parent ends."""
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
