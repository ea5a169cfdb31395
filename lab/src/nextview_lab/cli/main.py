"""The ``nextview-lab`` command: find the requested command in commands.py and call it."""

from nextview.cli.main import run
from nextview_lab.cli.commands import LABORATORY


def main(arguments: list[str] | None = None) -> None:
    """Run a command of ``nextview-lab``.

    Args:
        arguments: of the command line; by default those of the process.
    """
    run(LABORATORY, arguments)
