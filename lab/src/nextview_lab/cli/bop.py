"""``nextview-lab bop``: what was found in a BOP dataset, as tables in the terminal."""

from rich import box
from rich.table import Table

from nextview.checks import number_of
from nextview.cli.progress import Terminal, console
from nextview_lab.benchmark.bop import BopRun
from nextview_lab.benchmark.pose_recall import MSPD_PIXELS, MSSD_PARTS, NO_HITS, Hits

OURS = (
    "Computed by nextview after the definitions of BOP, by MSSD and MSPD alone; VSD and the"
    " official figures are bop_toolkit's (docs/bop.md)."
)


def print_bop(run: BopRun) -> None:
    """Print the recall, and what was left out.

    Args:
        run: what was found.
    """
    if run.learned is not None:
        console.print(f"{run.learned.out}: {run.learned}", soft_wrap=True)
    if run.not_known:
        numbers = ", ".join(map(str, run.not_known))
        console.print(
            f"the memory does not know the models {numbers}, so they are never found",
            style="yellow",
            soft_wrap=True,
        )
    for model, count in run.without_model.items():
        console.print(
            f"object {model} has no model and does not count: it is in the images"
            f" {number_of(count, 'time')}",
            style="yellow",
            soft_wrap=True,
        )
    if run.round_ones:
        numbers = ", ".join(map(str, run.round_ones))
        console.print(
            f"models_info.json has no symmetries_continuous of round models ({numbers}): the recall"
            " takes each turn about their axis for an error",
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
    if run.hits is None:
        console.print(
            "scene_gt.json is not there, so nothing is compared: evaluate with bop_toolkit",
            soft_wrap=True,
        )
        return
    _print_recall(run.hits, terminal)


def _print_recall(hits: dict[int, Hits], terminal: Terminal) -> None:
    """Print the recall of each model and of all."""
    together = sum(hits.values(), NO_HITS)
    table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
    table.title = "Recall, mean over ten thresholds"
    table.title_justify = "left"
    for column in ("model", "objects", "MSSD", "MSPD", "mean"):
        table.add_column(column, justify="right")
    for name, one in [*((str(model), one) for model, one in hits.items())]:
        table.add_row(name, *_cells(one))
    table.add_section()
    table.add_row("all", *_cells(together))
    terminal.print(table)

    if together.objects:
        for what, limits, found in (
            ("MSSD, % of the diameter", 100 * MSSD_PARTS, together.mssd),
            ("MSPD, pixels at a width of 640", MSPD_PIXELS, together.mspd),
        ):
            shares = " ".join(
                f"{limit:.0f}: {count / together.objects:.2f}"
                for limit, count in zip(limits, found, strict=True)
            )
            terminal.print(f"{what}: {shares}", soft_wrap=True)
    terminal.print(OURS, soft_wrap=True)


def _cells(one: Hits) -> list[str]:
    """Number of objects and recalls; a dash where none counts."""
    shares = (one.average_mssd, one.average_mspd, one.average)
    return [str(one.objects), *(f"{x:.3f}" if one.objects else "-" for x in shares)]
