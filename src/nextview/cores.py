"""How many cores are used: one setting for processes, threads of networks, and parallel objects."""

import os

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
        # only here: it would slow down the start of every command
        from threadpoolctl import threadpool_limits

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
