"""The command ``nextview``.

Outside the package, so that Ctrl-C ends it quietly while the package is imported, too.
"""

import os
import signal
from importlib import import_module
from types import FrameType


def main() -> None:
    """Run the command."""
    start("nextview.cli.main")


def start(module: str) -> None:
    """Import the module of a command, and run its ``main``.

    Args:
        module: its dotted name.
    """
    before = signal.signal(signal.SIGINT, _stop)
    run = import_module(module).main

    signal.signal(signal.SIGINT, before)
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        # temporary files go then, too
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    run()


def _stop(number: int, frame: FrameType | None) -> None:
    os.write(2, b"nextview: stopped; nothing was written\n")
    os._exit(130)
