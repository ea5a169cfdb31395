"""Which measure of a view serves recognition? Every measure that a store holds, against what a
recogniser says.

    python -m nextview_lab.thesis.measure_study views.zarr measures --test test.npz
        --validation validation.npz [--objects 300] [--runs 10] [--policies random-all gain]

What the models say of the views is predicted, and what the measures say is measured before
(nextview-lab predict, nextview-lab measure). Writes into the folder
the table (measures.md) and measures.csv (every number in a row of its own).

For each measure: the rank correlation, over the views of an object, of its value with the
log-probability that the recogniser gives the true class there, as the mean over objects, of all
classes and of each; how often its best view is the recogniser's best one, or next to it; and
accuracy and travel of the policy that climbs its true map in the local window, after fixed numbers
of views. That policy sees what no robot can, and so is an oracle by name; what it does not see is
the class: it goes to the valley for those that it believes in at that moment and for which the
valley gained on the validation objects. Other policies can stand beside, under the names that
nextview-lab benchmark has for them. Intervals are 95 % bootstrap intervals over objects; p is by
sign flips against random choice in the window, over objects, corrected by Holm's method for all
measures, policies and numbers of views together.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from nextview_lab.extras import extras, require

if __name__ == "__main__":
    require("benchmark")

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.stats import rankdata

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.errors import UsageError
from nextview.files import new_file
from nextview.recognition.map_names import map_name
from nextview_lab.benchmark.replay import make_specs, replay
from nextview_lab.benchmark.statistics import holm, interval, resample, sign_flip_p
from nextview_lab.benchmark.text_tables import markdown
from nextview_lab.benchmark.true_maps import true_map, true_measure
from nextview_lab.data.metrics import ratio
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.splits import sample
from nextview_lab.data.store import ViewStore
from nextview_lab.training.card_fits import valley_gains

with extras():
    import pandas as pd

RANDOM = "random"
"""What the policies are compared with: a view of the local window drawn at random."""
CONFIDENCE = "confidence"
"""The recogniser's own confidence, as a measure: the ceiling of what a map of one view can be."""
AGREEMENT = {"best": "best view is the recogniser's", "best_near": "or next to it"}


def correlations(
    values: NDArray[np.floating],
    reference: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Spearman's rank correlation along the rows, (N,); 0 where one of the two is constant."""
    a, b = (rankdata(x, axis=1) for x in (values, reference))
    a = a - a.mean(1, keepdims=True)
    b = b - b.mean(1, keepdims=True)
    spread = np.sqrt((a**2).sum(1) * (b**2).sum(1))
    return np.divide((a * b).sum(1), spread, out=np.zeros(len(a)), where=spread > 0)


def agreement(
    p: Predictions,
    values: NDArray[np.floating],
) -> dict[str, NDArray[np.float64]]:
    """Whether each object's best view by a measure is the recogniser's, or at most a cell away,
    (N,) each.

    Several best views count by the share of them: a measure that is constant agrees as often as
    chance does.
    """
    theirs = p.log_truth.argmax(1)
    best = values >= values.max(1, keepdims=True)
    away = p.sphere.travel[theirs]
    return {
        name: (best & (away <= reach)).sum(1) / best.sum(1)
        for name, reach in (("best", 0), ("best_near", 1))
    }


def study(
    test: Predictions,
    validation: Predictions,
    measures: list[str],
    policies: tuple[str, ...],
    n_views: tuple[int, ...],
    runs: int,
    samples: int,
    seed: int,
    rows: list[tuple],
) -> Iterator[int]:
    """Compute everything; yields how many entries are done.

    Args:
        test: predictions to judge by.
        validation: predictions of other objects, by which peak or valley is chosen.
        measures: names.
        policies: entries of the benchmark, beside them.
        n_views: after which policies are compared.
        runs: first views of each object.
        samples: of the bootstrap.
        seed: of it and of the first views.
        rows: gets measure, label, quantity, value, low, high, p.
    """
    weights = resample(len(test), samples, np.random.default_rng([seed, 1]))
    reference = test.log_truth
    right: dict[tuple[str, int], NDArray[np.bool_]] = {}

    def note(
        name: str,
        quantities: dict[str, NDArray[np.float64]],
        labels: bool = False,
    ) -> None:
        top = np.stack(list(quantities.values()), 1)
        groups = [("", np.ones(len(test), bool))]
        groups += (
            [(test.classes[c], test.labels == c) for c in np.unique(test.labels)]
            if labels
            else []
        )
        for label, here in groups:
            low, high = interval(
                ratio(top[here], np.ones_like(top[here]), weights[:, here])
            )
            for i, quantity in enumerate(quantities):
                rows.append(
                    (
                        name,
                        label,
                        quantity,
                        top[here, i].mean(),
                        low[i],
                        high[i],
                        np.nan,
                    )
                )

    for done, name in enumerate([RANDOM, *measures, *policies], 1):
        if name not in measures:
            entry = name
            valleys = None
        else:
            values = (
                true_measure(test, name) if name != CONFIDENCE else np.exp(reference)
            )
            note(name, {"correlation": correlations(values, reference)}, labels=True)
            note(name, agreement(test, values))
            entry = f"true-{map_name(name)}"
            maps = true_map(validation, map_name(name))
            unseen = validation.sphere, validation.logits, maps, validation.labels
            # the classes for which the valley of the true map gained on the validation objects
            valleys = tuple(c for c, gain in valley_gains(*unseen).items() if gain > 0)
            rows.append(
                (
                    name,
                    ", ".join(test.classes[c] for c in valleys),
                    "valleys",
                    len(valleys),
                    *[np.nan] * 3,
                )
            )
        given = (
            {}
            if valleys is None
            else {map_name(name): tuple(test.classes[c] for c in valleys)}
        )
        specs = make_specs(
            replace(test, valley_classes=given or test.valley_classes),
            runs,
            seed,
        )
        paths = replay(entry, specs, max(n_views), seed)
        for k in n_views:
            right[name, k] = (paths.answers[:, k - 1] == specs.labels).reshape(runs, -1)
            accuracy = right[name, k].mean(0)
            note(
                name,
                {
                    f"accuracy_{k}": accuracy,
                    f"travel_{k}": paths.travel[:, k - 1].reshape(runs, -1).mean(0),
                },
            )
            if name != RANDOM:
                over = accuracy - right[RANDOM, k].mean(0)
                note(name, {f"over_random_{k}": over})
                rows[-1] = (*rows[-1][:-1], float(sign_flip_p(over[:, None])[0]))
        yield done


def readable(table: pd.DataFrame, n_views: tuple[int, ...]) -> pd.DataFrame:
    """The table as it is read, the highest correlation first."""
    found: dict[tuple[str, str], Any] = {
        (str(r.measure), str(r.quantity)): r
        for r in table.itertuples()
        if not r.label or r.quantity == "valleys"
    }
    correlated = table[(table["quantity"] == "correlation") & (table["label"] == "")]
    measures = correlated.sort_values("value", kind="stable")["measure"].tolist()
    names = [*measures[::-1], *table["measure"]]  # others as they were named
    at = ", ".join(map(str, n_views))
    head = [
        "measure",
        "correlation",
        *AGREEMENT.values(),
        f"accuracy at {at} views",
        f"points over random at {at}",
        f"travel at {at}",
        "valley for",
    ]
    rows = []
    for name in dict.fromkeys([RANDOM, *names]):
        r = found.get((name, "correlation"))
        cells = [name.replace("_", " ") if r else name]
        if r is None:
            cells += [""] * 3
        else:
            cells.append(f"{r.value:.2f} ({r.low:.2f} to {r.high:.2f})")
            cells += [
                f"{100 * found[name, quantity].value:.0f} %" for quantity in AGREEMENT
            ]
        cells.append(
            ", ".join(f"{found[name, f'accuracy_{k}'].value:.3f}" for k in n_views)
        )
        over = (
            [found[name, f"over_random_{k}"] for k in n_views] if name != RANDOM else []
        )
        cells.append(", ".join(map(points, over)))
        cells.append(
            ", ".join(f"{found[name, f'travel_{k}'].value:.2f}" for k in n_views)
        )
        cells.append("" if r is None else found[name, "valleys"].label or "none")
        rows.append(cells)
    return pd.DataFrame(rows, columns=head)


def points(row: Any) -> str:
    """A difference of shares in points, with its interval; a star where it is significant."""
    value, low, high = (
        f"{round(100 * x, 1) + 0.0:+.1f}" for x in (row.value, row.low, row.high)
    )
    return f"{value}{'*' * (row.p_holm < 0.05)} ({low} to {high})"


def main(
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    test: Path,
    validation: Path,
    measures: tuple[str, ...] = (),
    policies: tuple[str, ...] = (),
    objects: int | None = None,
    views: tuple[int, ...] = (2, 3, 5),
    runs: int = 10,
    samples: int = 1000,
    seed: int = 0,
) -> None:
    """Compare the measures.

    Args:
        store: view store that holds the measures.
        out: folder of the results.
        test: predictions of the test split.
        validation: of training objects that the recogniser has not seen.
        measures: names, or MODULE:FUNCTION of your own; by default all that the store holds, and
            the confidence.
        policies: others in the same table, as nextview-lab benchmark names them.
        objects: only so many of each split, spread evenly, as nextview-lab measure takes them.
        views: after which policies are compared.
        runs: random first views of each object.
        samples: of the bootstrap.
        seed: of everything random.
    """
    if not views or min(views) < 2:
        raise UsageError("policies are compared after two views or more")
    tables = [Predictions.load(path) for path in (test, validation)]
    tables = [p.of_objects(sample(np.arange(len(p)), objects)) for p in tables]
    tables = [replace(p, store=str(store.resolve())) for p in tables]
    if set(tables[0].names) & set(tables[1].names):
        raise UsageError(
            f"{validation}: holds objects of {test}: peak or valley would be chosen on what is"
            " judged"
        )
    if tables[0].classes != tables[1].classes:
        raise UsageError(f"{validation}: is of other classes than {test}")
    names = list(measures) or [*ViewStore.open(store).measures, CONFIDENCE]
    numbers: list[tuple] = []
    comparing = study(
        tables[0], tables[1], names, policies, views, runs, samples, seed, numbers
    )
    track(comparing, 1 + len(names) + len(policies), "comparing measures")
    table = pd.DataFrame(
        numbers,
        columns=["measure", "label", "quantity", "value", "low", "high", "p"],
    )
    table["p_holm"] = holm(table["p"].to_numpy())
    wide = readable(table, views)
    text = markdown(wide.columns, wide.to_numpy().tolist())
    text += "\n\\* p < 0.05 after Holm's correction.\n"
    out.mkdir(parents=True, exist_ok=True)
    with new_file(out / "measures.csv", True) as part:
        table.to_csv(part, index=False)
    with new_file(out / "measures.md", True) as part:
        part.write_text(text, encoding="utf-8")
    print(text, end="")


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
