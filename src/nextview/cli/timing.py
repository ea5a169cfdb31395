"""Where the time of a command went."""

from __future__ import annotations

import time
from pathlib import Path


def process_age() -> float:
    """Seconds since this process began, from Linux's books; 0 where there are none."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / 100
    except (OSError, AttributeError, ValueError):
        return 0.0


class Stopwatch:
    """Adds up laps by name; the first one begins with the process."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter() - process_age()

    def lap(self, name: str) -> None:
        """Count the time since the last lap under a name."""
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now

    def show(self) -> None:
        """Print the laps and their shares on standard error."""
        from rich.table import Table

        from nextview.cli.progress import console

        total = sum(self.laps.values())
        table = Table("time", "seconds", "share", title="From process start to the answer")
        for name, seconds in [*self.laps.items(), ("all", total)]:
            table.add_row(name, f"{seconds:.3f}", f"{seconds / total:.0%}")
        console.print(table)
