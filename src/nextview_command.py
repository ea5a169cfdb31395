"""The command ``nextview``. Outside the package, whose import takes half a second: it has to stop quietly then too."""

import os
import signal
from types import FrameType


def main() -> None:
    """Run the command."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)
    from nextview.cli.main import main as run

    signal.signal(signal.SIGINT, before)
    run()


def _stop(number: int, frame: FrameType | None) -> None:
    """End at once: nothing is begun yet, and what is being imported turns a KeyboardInterrupt into other errors."""
    os.write(2, b"nextview: stopped; run the same command again\n")
    os._exit(128 + number)
