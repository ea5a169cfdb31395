"""Write docs/reproduction.md: what of the thesis's comparison of policies holds up, with intervals.

    python -m nextview_lab.thesis.reproduction predictions.npz docs/reproduction.md

Every number and every verdict on the page is worked out here from the predictions; none is typed
in.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from nextview_lab.extras import require

if __name__ == "__main__":
    require("benchmark")

import numpy as np
import tyro

from nextview.cli.exit_status import orderly_end
from nextview.files import sha256_of
from nextview.recognition.belief import PLAIN_SUM
from nextview_lab.benchmark.class_tables import ClassTables, nothing_differs, summarise
from nextview_lab.benchmark.comparison import ALL, SIGNIFICANT
from nextview_lab.benchmark.entries import default_entries
from nextview_lab.benchmark.published import published, published_threshold
from nextview_lab.benchmark.replay import THESIS_THRESHOLDS, Grid, make_specs, run_grid
from nextview_lab.benchmark.text_tables import markdown
from nextview_lab.data.predictions import Predictions

AT = 0.97
BASELINES = ("random", "furthest", "unidirectional")
# measures of two tables, and their digits
AT_PUBLISHED = {"accuracy": 3, "class_accuracy": 3, "travel_moved": 2}
AT_ONE = {
    "accuracy": 3,
    "clean_accuracy": 3,
    "n_views": 2,
    "travel_all": 2,
    "arc_all": 2,
}
LEMS = {
    "oracle-valley": "predicted map, valley by the true class (as published)",
    "lem": "predicted map, valley by the believed class",
    "lem-peak": "predicted map, always the peak",
    "true-oracle-valley": "true map, valley by the true class",
    "true-lem": "true map, valley by the believed class",
    "true-lem-peak": "true map, always the peak",
    "lcm-oracle-valley": "predicted confidence map, valley by the true class (as published)",
    "lcm": "predicted confidence map, valley by the believed class",
    "lcm-peak": "predicted confidence map, its peak",
    "true-lcm": "true confidence map, its peak (an oracle)",
    "gain": "what a view is worth less its travel, learned (the default)",
    "random-all": "any unvisited view of the sphere",
    "oracle-gain": "the ceiling: sees what every view would say",
}


class Compared(NamedTuple):
    """Accuracy of a policy less that of another, with its interval and Holm's p."""

    difference: float
    low: float
    high: float
    p: float

    def __str__(self) -> str:
        p = "" if _p(self.p) == "1.000" else f", p {_p(self.p)}"
        low, high = (f"{100 * end:+.1f}" for end in (self.low, self.high))
        return f"{100 * self.difference:+.1f} ({low} to {high}{p})"

    @property
    def verdict(self) -> str:
        """In words."""
        if self.p >= SIGNIFICANT:
            return "does not differ significantly from"
        return (
            "is more accurate than" if self.difference > 0 else "is less accurate than"
        )


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def tests_of(tables: ClassTables, measure: str) -> dict[tuple[str, float], Compared]:
    """The tests of a measure over all objects, by policy and threshold."""
    rows = tables.tests[tables.tests["set"] == ALL]
    rows = rows[rows["measure"] == measure]
    columns = ["policy", "threshold", "difference", "low", "high", "p_holm"]
    return {
        (policy, t): Compared(*rest)
        for policy, t, *rest in rows[columns].to_numpy(object).tolist()
    }


def page(predictions: Path, samples: int = 2000) -> str:
    """The page about the predictions in a file; ``samples`` of the bootstrap."""
    # as published
    table = replace(Predictions.load(predictions), calibration=PLAIN_SUM)
    specs = make_specs(table, 10, 0)
    grid = Grid(specs, 10, THESIS_THRESHOLDS, 5, 0)
    list(run_grid(grid, default_entries(specs)))
    ran = {name for name, paths in grid.paths.items() if not paths.fixed}
    references = [
        name for name in (*BASELINES, "lem", "true-lem", "lcm") if name in ran
    ]
    tables = {
        name: summarise(grid, name, samples, np.random.default_rng([0, 1]))
        for name in references
    }
    values = tables["random"].measures
    rows = (
        values[values["set"] == ALL][
            ["policy", "threshold", "measure", "value", "low", "high"]
        ]
        .to_numpy(object)
        .tolist()
    )
    value = {
        (p, None if t != t else t, m): (v, low, high) for p, t, m, v, low, high in rows
    }
    test = {name: tests_of(of, "accuracy") for name, of in tables.items()}
    lems = {name: what for name, what in LEMS.items() if name in ran}

    def number(
        policy: str,
        threshold: float | None,
        measure: str,
        digits: int = 3,
    ) -> str:
        v, low, high = value[policy, threshold, measure]
        return (
            f"{v:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"
            if high > low
            else f"{v:.{digits}f}"
        )

    def named(classes: tuple[int, ...]) -> str:
        return ", ".join(table.classes[i] for i in classes) or "none"

    out = [
        "# What of the published comparison holds up",
        "",
        (
            f"{len(table)} objects, {len(table.classes)} classes, 10 first views each, at most 5"
            " views; the same first views for every policy and threshold. In brackets: 95 %"
            " bootstrap intervals over objects. p-values are by sign flips over objects, after one"
            " Holm correction over all that is compared with the same policy: every other one,"
            " published, learned or oracle, at every threshold, as in `nextview-lab benchmark"
            " classes`; where none is given, p is 1.000."
            " Differences of accuracy are in percentage points."
        ),
        "",
        (
            "`python -m nextview_lab.thesis.reproduction predictions.npz docs/reproduction.md`"
            " makes this page, verdicts and all."
        ),
        f"The predictions (SHA-256 `{sha256_of(predictions)[:16]}...`) come from `nextview-lab"
        " predict modelnet10.zarr predictions.npz --split test`; models: "
        + ", ".join(
            f"{kind} {name} (`{sha[:12]}...`)"
            for kind, (name, sha) in table.models.items()
        )
        + f". Valley classes: {named(specs.valley_classes('lem'))} (LEM),"
        f" {named(specs.valley_classes('lcm'))} (LCM), chosen on validation objects. Single views"
        f" are right {100 * (table.logits.argmax(2) == table.labels[:, None]).mean():.1f} % of"
        " the time (published: 87.1 %).",
        "",
        "## In short",
        "",
    ]
    if nothing := nothing_differs(tables["random"], AT, "random"):
        out.append(f"- {nothing}")
    leaks: list[str] = []
    for leak, honest in (
        ("oracle-valley", "lem"),
        ("lcm-oracle-valley", "lcm"),
        ("true-oracle-valley", "true-lem"),
    ):
        if leak in ran and honest in test:
            leaks.append(
                f"{leak} {test[honest][leak, AT].verdict} {honest}: {test[honest][leak, AT]}"
            )
    if leaks:
        out.append(
            f"- **The leak**: what the true class changes (points, at {AT}): {'; '.join(leaks)}."
        )
    baselines = (
        f"{name} {test['random'][name, AT].verdict} random: {test['random'][name, AT]}"
        for name in BASELINES[1:]
    )
    out.append(f"- **The baselines**: {'; '.join(baselines)}.")
    published_rows = []
    compared = ("oracle-valley", "lem", "lcm-oracle-valley", "lcm", "lcm-peak")
    for name in (*BASELINES, *(name for name in compared if name in ran)):
        t = published_threshold(name) or 0.99
        cells = []
        for measure, digits in AT_PUBLISHED.items():
            theirs = published(name, t, measure, table.classes)
            cells.append(number(name, t, measure, digits))
            cells.append("" if theirs is None else f"{theirs:.{digits}f}")
        published_rows.append([name, t, *cells])
    every = [
        [name, *(number(name, AT, m, digits) for m, digits in AT_ONE.items())]
        for name in dict.fromkeys((*BASELINES, *lems))
    ]
    against = [
        [name, what, *(test[b][name, AT] for b in BASELINES)]
        for name, what in lems.items()
    ]
    by_threshold = [
        [name, *(test["random"][name, t] for t in THESIS_THRESHOLDS)]
        for name in ("oracle-valley", "lem", "lcm", "gain", "oracle-gain")
        if name in lems
    ]
    fixed = []
    for name, paths in grid.paths.items():
        if paths.fixed:
            theirs = published(name, None, "class_accuracy", table.classes)
            cells = [number(name, None, m) for m in ("accuracy", "class_accuracy")]
            beside = "" if theirs is None else f"{theirs:.3f}"
            fixed.append([name, *cells, beside, paths.views.shape[1]])

    command = "`nextview-lab benchmark classes predictions.npz results --uncalibrated"
    for title, about, head, rows in (
        (
            "At the published thresholds",
            f"{command}`; `measures.csv`. Published: tables 5, 8 and 9.",
            "policy | threshold | accuracy | published | class accuracy | published | travel of the"
            " moved | published",
            published_rows,
        ),
        (
            f"Every policy at threshold {AT}",
            f"{command}`; `measures.csv`.",
            "policy | accuracy | without duplicates | views | travel, all episodes | arc, radians",
            every,
        ),
        (
            f"Accuracy against each baseline at threshold {AT}, points",
            f"{command} --reference BASELINE`; `tests.csv`.",
            " | ".join(
                ["policy | what it knows", *(f"against {b}" for b in BASELINES)]
            ),
            against,
        ),
        (
            "Does it depend on the threshold?",
            "Accuracy against random, points; `tests.csv`.",
            " | ".join(["policy", *map(str, THESIS_THRESHOLDS)]),
            by_threshold,
        ),
        (
            "Fixed views",
            "`measures.csv`, rows without a threshold. Published: tables 3 and 12, from a network"
            " for 40 classes.",
            "views | accuracy | class accuracy | published | views",
            fixed,
        ),
    ):
        text = markdown(head.split(" | "), rows).rstrip()
        out += ["", f"## {title}", "", about, "", text]
    duplicates = [n for n, c in zip(table.names, table.conflicting, strict=True) if c]
    out += [
        "",
        (
            f"Duplicates: {', '.join(duplicates) or 'none'}"
            " are the very meshes of objects with another label, in either split."
        ),
    ]
    if not {"lcm", "lcm-peak"} & ran:
        out += [
            "",
            "Not reproduced: the LCM from a predicted map; no such network is bundled.",
        ]
    return "\n".join(out) + "\n"


def main(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
) -> None:
    """Write the page.

    Args:
        predictions: of the test split.
        out: the Markdown file.
    """
    out.write_text(page(predictions), encoding="utf-8")


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
