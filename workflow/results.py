"""Write docs/results.md: the measurements on one page, each table beside the command that made it.

    python workflow/results.py docs/results.md --stages evaluation benchmark ...

Runs in the folder of the workflow. A section is written for each of the stages that is given; all
numbers are read from what the stages wrote.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
from math import isfinite
from pathlib import Path
from textwrap import wrap

from nextview_lab.extras import require

require("benchmark")

import pandas as pd

from nextview_lab.benchmark.comparison import ALL, SIGNIFICANT
from nextview_lab.benchmark.entries import is_oracle
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.store import ViewStore

WIDTH = 98
"""Columns of the page's prose."""

THRESHOLD = 0.97
"""Of the belief, in the tables that are for one threshold."""

SPLITS = {"validation": "validation", "test": "test", "test-size": "test, size known"}
"""Folders of the evaluation, and what they are called here."""

SOURCES = ("views.zarr", "validation.npz", "test.npz", "test-size.npz")
"""Stages from which the others come."""

OFFICIAL = {"train": 3991, "test": 908}
"""Meshes of ModelNet10 as it is published."""

Cell = tuple[float, float, float, float]
"""Value, ends of its interval, and the published value."""


def markdown(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """A table."""
    head = list(head)
    yield "| " + " | ".join(head) + " |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield "| " + " | ".join(row) + " |"
    yield ""


def cells(table: pd.DataFrame, *keys: str) -> dict[tuple, Cell]:
    """The numbers of a long table by its key columns."""
    published = (
        table["published"] if "published" in table else [float("nan")] * len(table)
    )
    numbers = zip(table["value"], table["low"], table["high"], published, strict=True)
    return dict(
        zip(table[list(keys)].itertuples(index=False, name=None), numbers, strict=True)
    )


def shown(cell: Cell | None, digits: int = 3, interval: bool = True) -> str:
    """A number, with its interval where it has one."""
    if cell is None or not isfinite(cell[0]):
        return ""
    value, low, high, _ = cell
    return f"{value:.{digits}f}" + (
        f" ({low:.{digits}f}-{high:.{digits}f})" if interval and high > low else ""
    )


def published(cell: Cell | None, digits: int = 3) -> str:
    """The published number, if there is one."""
    return "" if cell is None or not isfinite(cell[3]) else f"{cell[3]:.{digits}f}"


def whole_episodes(file: Path) -> pd.DataFrame:
    """The rows of a table of results that are of whole episodes of all objects."""
    table = pd.read_csv(file)
    return table[(table["set"] == ALL) & (table["views"] == 0)]


def objects(predictions: str) -> int:
    """How many objects a file of predictions holds."""
    return len(Predictions.load(predictions).labels)


def p_value(p: float) -> str:
    """A p-value, none for the reference itself."""
    return "" if not isfinite(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


def called(policy: str) -> str:
    """What a policy is called here: the card of one of ours by its name."""
    return Path(policy).stem if policy.endswith(".json") else policy


def recogniser(stage: Path) -> Iterator[str]:
    """Accuracy of single views and of all of them."""
    tables = {
        split: pd.read_csv(stage / split / "accuracy.csv", keep_default_na=False)
        for split in SPLITS
    }
    for table in tables.values():
        for column in ("value", "low", "high", "published"):
            table[column] = pd.to_numeric(table[column])
    found = {
        split: cells(table, "n_views", "label", "measure")
        for split, table in tables.items()
    }
    all_views = int(tables["test"]["n_views"].max())
    objects = {
        split: int(table.loc[table["label"] == "", "objects"].max())
        for split, table in tables.items()
    }
    yield "Accuracy. Over several views the logits are summed. `accuracy.csv`."
    yield ""
    measures = {
        "accuracy": "all objects",
        "class_accuracy": "mean of classes",
        "clean_accuracy": "without the meshes that also have another label",
        "shape_accuracy": "size not used",
    }
    rows = []
    for views in (1, all_views):
        for measure, what in measures.items():
            row = [found[split].get((views, "", measure)) for split in SPLITS]
            name = f"{'one view' if views == 1 else f'all {views} views'}, {what}"
            rows.append(
                [
                    name,
                    *map(shown, row),
                    published(found["test"].get((views, "", measure))),
                ]
            )
    head = [f"{what} ({objects[split]} objects)" for split, what in SPLITS.items()]
    yield from markdown(["", *head, "published, test"], rows)
    yield "Each class of the test split, one view and all:"
    yield ""
    test = found["test"], found["test-size"]
    labels = [label for label in tables["test"]["label"].unique() if label]
    rows = [
        [
            label.replace("_", " "),
            *(
                shown(of.get((v, label, "accuracy")))
                for of in test
                for v in (1, all_views)
            ),
        ]
        for label in labels
    ]
    yield from markdown(
        ["class", "one view", "all", "one view, size known", "all, size known"],
        rows,
    )


def calibration(stage: Path) -> Iterator[str]:
    """What the belief is worth after several views."""
    yield (
        "Views of the test split in random order, fused with the parameters on the recogniser's"
        " card. `fusion.csv`."
    )
    yield ""
    table = pd.read_csv(stage / "test" / "fusion.csv")
    table = table[table["n_views"].isin((1, 2, 3, 5, 8, 15, table["n_views"].max()))]
    rows = [
        [
            f"{r.n_views}",
            f"{r.accuracy:.3f} ({r.low:.3f}-{r.high:.3f})",
            f"{r.class_accuracy:.3f}",
            f"{r.confidence:.3f}",
            f"{r.calibration_error:.3f}",
        ]
        for r in table.itertuples()
    ]
    yield from markdown(
        [
            "views",
            "accuracy",
            "mean of classes",
            "mean confidence",
            "calibration error",
        ],
        rows,
    )


def maps(stage: Path) -> Iterator[str]:
    """Scores of the map networks."""
    measures = {
        "mse": "squared error",
        "d0": "peak exact",
        "d_le_1": "within one cell",
        "d_lt_2": "d < 2",
        "regret": "regret",
    }
    yield from wrap(
        "Published: squared error over objects, peaks over classes (table 4). The mean maps are"
        " computed from the true maps of the same objects, so their rows are optimistic."
        " `maps.csv`.",
        WIDTH,
    )
    yield ""
    rows = []
    for split in ("validation", "test"):
        table = pd.read_csv(stage / split / "maps.csv", keep_default_na=False)
        for column in ("value", "low", "high", "published"):
            table[column] = pd.to_numeric(table[column])
        found = cells(table[table["label"] == ""], "map", "by", "measure")
        for name in table["map"].unique():
            for by in table.loc[table["map"] == name, "by"].unique():
                for over, what in {"": "objects", "class_": "classes"}.items():
                    if (split == "validation") + (by != "network") + (over != "") > 1:
                        # the page keeps what differs in one respect from the network on test
                        # objects
                        continue
                    row = [
                        found.get((name, by, over + measure)) for measure in measures
                    ]
                    if any(cell is not None for cell in row):
                        digits = [4 if measure == "mse" else 3 for measure in measures]
                        values = [
                            shown(c, d, by == "network")
                            for c, d in zip(row, digits, strict=True)
                        ]
                        rows.append([f"{name.upper()}, {by}", split, what, *values])
            if split == "test":
                row = [
                    found.get((name, "network", m if m == "mse" else f"class_{m}"))
                    for m in measures
                ]
                if any(published(cell) for cell in row):
                    rows.append(
                        [
                            f"{name.upper()}, published",
                            split,
                            "see above",
                            *(published(c, 4) for c in row),
                        ]
                    )
    yield from markdown(["map", "split", "mean of", *measures.values()], rows)


def comparison(stage: Path) -> Iterator[str]:
    """All policies at one threshold."""
    settings = json.loads((stage / "benchmark.json").read_text())
    summary = whole_episodes(stage / "measures.csv")
    tests = whole_episodes(stage / "tests.csv")
    decay = settings["threshold_decay"]
    yield from wrap(
        f"{settings['runs']} first views per object, the same for every policy. The threshold is"
        f" {THRESHOLD} at the first view and decreases with every view (decay {decay:g}); at most"
        f" {settings['max_views']} views. Travel is the mean over all episodes, including those"
        f" that never moved. p: sign-flip test of the accuracy against `{settings['reference']}`,"
        " with Holm's correction over all policies and thresholds. `measures.csv`, `tests.csv`.",
        WIDTH,
    )
    yield ""
    found = cells(summary[summary["threshold"] == THRESHOLD], "policy", "measure")
    at = tests[
        (tests["threshold"] == THRESHOLD) & (tests["measure"] == "accuracy")
    ].set_index("policy")
    rows = []
    for policy in dict.fromkeys(policy for policy, _ in found):
        numbers = [
            ("accuracy", 3),
            ("class_accuracy", 3),
            ("n_views", 2),
            ("travel_all", 2),
            ("arc_all", 2),
        ]
        row = [
            shown(found.get((policy, m)), d, m != "class_accuracy") for m, d in numbers
        ]
        test = at.loc[policy] if policy in at.index else None
        difference = (
            "" if test is None else f"{round(100 * test['difference'], 1) + 0.0:+.1f}"
        )
        rows.append(
            [
                called(policy),
                *row,
                difference,
                "" if test is None else p_value(test["p_holm"]),
            ]
        )
    yield from markdown(
        [
            "policy",
            "accuracy",
            "mean of classes",
            "views",
            "travel, cells",
            "travel, radians",
            f"points over {settings['reference']}",
            "p",
        ],
        rows,
    )
    robot = tests["policy"].map(lambda policy: not is_oracle(called(policy)))
    if not (
        tests["p_holm"][robot & (tests["measure"] == "accuracy")] < SIGNIFICANT
    ).any():
        yield from wrap(
            "**No policy that a robot could follow differs significantly from"
            f" {settings['reference']} in accuracy** at any threshold: every p after the correction"
            f" is {SIGNIFICANT} or more. Policies named oracle or true use information that a robot"
            " does not have.",
            WIDTH,
        )
        yield ""


def risk(stage: Path) -> Iterator[str]:
    """What became of the promised error rates."""
    settings = json.loads((stage / "benchmark.json").read_text())
    found = cells(
        whole_episodes(stage / "measures.csv"), "policy", "threshold", "measure"
    )
    yield from wrap(
        "With `--risk` an episode stops at the lowest threshold at which at most that share of"
        " the early stops is wrong on the validation objects. Test split:",
        WIDTH,
    )
    yield ""
    rows = []
    for policy in [
        name for name in settings["policies"] if called(name) in ("random", "gain")
    ]:
        for promised, threshold in settings["risks"].items():
            near = next(t for _, t, _ in found if abs(t - threshold) < 1e-9)
            right, early, views = (
                found[policy, near, m]
                for m in ("confident_accuracy", "confident", "n_views")
            )
            wrong = f"{1 - right[0]:.3f} ({1 - right[2]:.3f}-{1 - right[1]:.3f})"
            cell = shown(found[policy, near, "accuracy"])
            rows.append(
                [
                    called(policy),
                    promised,
                    f"{threshold:.4f}",
                    f"{early[0]:.3f}",
                    wrong,
                    cell,
                    f"{views[0]:.2f}",
                ]
            )
    yield from markdown(
        [
            "policy",
            "promised",
            "threshold",
            "stop early",
            "wrong among those",
            "accuracy of all",
            "views",
        ],
        rows,
    )


SECTIONS: list[tuple[str, str, Callable[[Path], Iterator[str]]]] = [
    ("benchmark", f"Policies at threshold {THRESHOLD}", comparison),
    ("benchmark-risk", "Promised error rates", risk),
    ("evaluation", "Recogniser", recogniser),
    ("evaluation", "Calibration", calibration),
    ("evaluation", "Map networks", maps),
]
"""Stage, heading, and what writes the section."""


def commands(stage: Path) -> list[str]:
    """Those that made a stage, for the reader."""
    made = json.loads(stage.with_name(f"{stage.name}.done").read_text())["commands"]
    return [command for command in made if command.startswith(("nextview", "python "))]


def page(stages: Iterable[str]) -> str:
    """The whole page."""
    given = set(stages)
    training = int((ViewStore.open("views.zarr").splits == "train").sum())
    out = [
        "# Results",
        "",
        *wrap(
            "Measurements, each beside the command that produced it. `make reproduce` writes this"
            f" page. {objects('test.npz'):,} of ModelNet10's {OFFICIAL['test']:,} test meshes and"
            f" {training:,} of its {OFFICIAL['train']:,} training meshes were available."
            f" {objects('validation.npz'):,} training meshes that no network was trained on are"
            " the validation set. All choices were made on them, and the test split chose"
            " nothing. Brackets contain 95 % bootstrap intervals over objects. Most sections are"
            " computed from the predictions of the networks, which are made with",
            WIDTH,
        ),
        "",
        "```",
        *[line for name in SOURCES for line in commands(Path(name))],
        "```",
        "",
    ]
    last = ""
    for name, heading, section in SECTIONS:
        if name not in given:
            continue
        out += [f"## {heading}", ""]
        if name != last:
            out += ["```", *commands(Path(name)), "```", ""]
        out += section(Path(name))
        last = name
    return "\n".join(line.rstrip() for line in out).rstrip() + "\n"


def main() -> None:
    """Read the command line and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--stages",
        nargs="+",
        required=True,
        choices=sorted({name for name, *_ in SECTIONS}),
    )
    given = parser.parse_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(page(given.stages), encoding="utf-8")


if __name__ == "__main__":
    main()
