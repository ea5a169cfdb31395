"""How many cores are used: one setting for processes, threads of networks, and parallel objects."""

import os
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController, threadpool_limits

from nextview.checks import whole

CORES = "NEXTVIEW_CORES"  # an environment variable, which worker processes inherit
CORES_HELP = f"All cores that the process may use are used, or {CORES}=NUMBER in the environment."
MOST_CORES = 1024


def asked_cores() -> int | None:
    """Return the number of cores that ``NEXTVIEW_CORES`` asks for; None if it is not set.

    Raises:
        UsageError: it is no whole number from 1 on.
    """
    asked = os.environ.get(CORES, "").strip()
    if not asked:
        return None
    number = int(asked) if asked.isdecimal() else asked
    return whole(number, f"the number of cores in {CORES}", 1, MOST_CORES)


def limit_blas() -> None:
    """Limit NumPy's matrix products in this process to the cores that ``NEXTVIEW_CORES`` asks for.

    Raises:
        UsageError: it is no whole number from 1 on.
    """
    asked = asked_cores()
    if asked is not None:
        threadpool_limits(asked, "blas")


def cores() -> int:
    """Return how many cores are used, by default all that the process may use.

    Answers do not depend on it.

    Raises:
        UsageError: ``NEXTVIEW_CORES`` is no whole number from 1 on.
    """
    asked = asked_cores()
    if asked is not None:
        return asked
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    """Return a controller of the thread pools below NumPy."""
    return ThreadpoolController().select(user_api="blas")


def one_blas_thread() -> AbstractContextManager[Any]:
    """Limit NumPy's matrix products to one thread in this context.

    They are small, and the threads of BLAS spin while they wait for each other. That takes the
    cores from the networks; on a computer that is busy otherwise, a search takes several times as
    long.
    """
    return _blas().limit(limits=1)
