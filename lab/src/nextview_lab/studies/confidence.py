"""Whether the belief in a name holds: what ``nextview-lab real`` found, by belief.

    python -m nextview_lab.studies.confidence real.csv drawn.csv --figure confidence.png

Each table is a series, called as its file. Printed and drawn are, for each range of beliefs, the
share of such names that are right, without those on strangers; and the share of the strangers that
get such a name: things with known pixels that nobody taught. With 95 % Wilson intervals.
"""

import csv
from itertools import pairwise
from pathlib import Path

import tyro

from nextview.cli.exit_status import orderly_end
from nextview.figures.style import ACCENT, BLUE, FAINT, legend, new_figure, to_png
from nextview.files import new_file
from nextview_lab.benchmark.figures import percent_axis
from nextview_lab.benchmark.statistics import wilson

BELIEFS = (0.5, 0.8, 0.95, 0.97, 1.01)  # a confident name has at least the last but one
MARKERS = "os^D"
ASIDE = 0.11  # between two series
RIGHT = "names that are right"
NAMED = "strangers with such a name"


def shares(path: Path) -> dict[str, list[tuple[int, int]]]:
    """Of how many names, and of how many strangers, for each range of beliefs.

    Args:
        path: a table of ``nextview-lab real``.

    Returns:
        For ``RIGHT`` and ``NAMED``, in the order of the ranges, how many and of how many.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found: dict[str, list[tuple[int, int]]] = {RIGHT: [], NAMED: []}
    strangers = {
        (row["folder"], row["frame"], row["number"])
        for row in rows
        if row["taught"] == "False" and row["number"] != "0"
    }

    for low, high in pairwise(BELIEFS):
        right = []
        named = set()
        for row in rows:
            if row["named"] == "True" and low <= float(row["belief"]) < high:
                thing = row["folder"], row["frame"], row["number"]
                if thing in strangers:
                    named.add(thing)
                else:
                    right.append(row["right"] == "True")
        found[RIGHT].append((sum(right), len(right)))
        found[NAMED].append((len(named), len(strangers)))
    return found


def main(tables: tyro.conf.Positional[tuple[Path, ...]], figure: Path) -> None:
    """Print and draw the shares.

    Args:
        tables: of ``nextview-lab real``.
        figure: PNG to write.
    """
    drawn, axes = new_figure(5.6, 3.4)
    series = [(path, *one) for path in tables for one in shares(path).items()]
    for number, (path, what, counts) in enumerate(series):
        known = [k for k, (_, total) in enumerate(counts) if total]
        print(f"{path.stem}, {what}: {', '.join(f'{n} of {of}' for n, of in counts)}")

        share = [counts[k][0] / counts[k][1] for k in known]
        ends = [wilson(*counts[k]) for k in known]

        axes.errorbar(
            [k + ASIDE * (number - (len(series) - 1) / 2) for k in known],
            share,
            [
                [max(0.0, p - low) for p, (low, _) in zip(share, ends, strict=True)],
                [max(0.0, high - p) for p, (_, high) in zip(share, ends, strict=True)],
            ],
            fmt=MARKERS[number // 2 % len(MARKERS)],
            color=BLUE if what == RIGHT else ACCENT,
            label=f"{path.stem}: {what}",
            elinewidth=1.2,
        )

    for k, (low, high) in enumerate(pairwise(BELIEFS)):
        around = [k - 4 * ASIDE, k + 4 * ASIDE]
        axes.fill_between(around, low, min(high, 1), color=FAINT, linewidth=0, zorder=0)
    ranges = [f"{low:g} to {high:g}" for low, high in pairwise(BELIEFS[:-1])]
    axes.set_xticks(range(len(BELIEFS) - 1), [*ranges, f"{BELIEFS[-2]:g} to 1"])

    axes.set_xlabel("belief in a name")
    axes.grid(visible=False, axis="x")
    axes.set_ylim(-0.02, 1.02)
    percent_axis(axes.yaxis)
    legend(axes)
    with new_file(figure, overwrite=True) as part:
        to_png(drawn, part)


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
