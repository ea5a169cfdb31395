"""The command ``nextview-lab``; see ``nextview_command``."""

from nextview_command import start


def main() -> None:
    """Run the command."""
    start("nextview_lab.cli.main")
