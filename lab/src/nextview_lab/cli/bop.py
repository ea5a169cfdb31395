"""``nextview-lab bop``: what was found in a BOP dataset, in the terminal."""

from nextview.checks import number_of
from nextview.cli.progress import Terminal, console
from nextview_lab.benchmark.bop import BopRun


def print_bop(run: BopRun) -> None:
    """Print what was found, and what was left out.

    Args:
        run: what was found.
    """
    if run.not_known:
        numbers = ", ".join(map(str, run.not_known))
        console.print(
            f"the memory does not know the models {numbers}, so they are never found",
            style="yellow",
            soft_wrap=True,
        )
    for name, reason in run.left_out.items():
        console.print(f"left out: {name}: {reason}", style="yellow", soft_wrap=True)
    for name, count in run.others.items():
        console.print(
            f"{name}: is no model of the dataset, found {number_of(count, 'time')} and not written",
            style="yellow",
            soft_wrap=True,
        )
    terminal = Terminal()
    terminal.print(
        f"{number_of(run.poses, 'pose')} in {number_of(run.images, 'image')},"
        f" {run.seconds:.2f} s an image",
        soft_wrap=True,
    )
