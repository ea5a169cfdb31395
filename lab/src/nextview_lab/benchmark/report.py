"""Write a self-contained HTML report from a folder of benchmark results."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from nextview.errors import ResultsError
from nextview.files import check_new, new_file
from nextview.policies.registry import DEFAULT_POLICY
from nextview.recognition.map_names import LEM
from nextview_lab.benchmark import class_tables as board
from nextview_lab.benchmark import figures as draw
from nextview_lab.benchmark.class_tables import ClassResults, class_set
from nextview_lab.benchmark.classes import load
from nextview_lab.benchmark.comparison import ALL, SIGNIFICANT, values_of
from nextview_lab.benchmark.entries import is_oracle
from nextview_lab.benchmark.page import numbers, origin, picture, render
from nextview_lab.benchmark.published import PUBLISHED_COLUMNS, published_threshold
from nextview_lab.extras import extras

with extras():
    import pandas as pd


def report(
    results: Path,
    out: Path | None = None,
    /,
    overwrite: bool = False,
) -> Path:
    """Write one self-contained HTML page: tables, curves, and the worst failures.

    Args:
        results: folder of nextview-lab benchmark classes.
        out: page to write; by default RESULTS/report.html.
        overwrite: replace an earlier page.

    Raises:
        ResultsError: there are no results, or only fixed views; or the page cannot be written.
    """
    path = out or results / "report.html"
    check_new(path, overwrite)
    loaded = load(results)
    if loaded.tables.sweep.empty:
        raise ResultsError(
            f"{results}: holds fixed views only; a report needs a policy that chooses"
        )

    with new_file(path, overwrite) as part:
        part.write_text(page(loaded), encoding="utf-8")

    return path


def headline_policy(results: ClassResults, threshold: float) -> str:
    """Return the most accurate realisable policy other than the reference.

    Args:
        results: of the benchmark.
        threshold: of the belief.

    Returns:
        Its name; the reference if there is no other.
    """
    found = values_of(results.tables.measures, threshold)
    reference = results.settings["reference"]
    names = [
        n
        for n in results.tables.sweep["policy"].unique()
        if not is_oracle(n) and n != reference
    ]
    return max(names, key=lambda n: found[n, "accuracy", 0][0], default=reference)


def page(results: ClassResults) -> str:
    """Return the page of a benchmark.

    Args:
        results: of the benchmark.

    Returns:
        HTML.
    """
    s = results.settings
    t = results.tables
    p = results.predictions
    at = board.headline_threshold(s["thresholds"])
    reference = s["reference"]
    whole = t.measures[t.measures["views"] == 0]
    keys = ("policy", "threshold", "measure")
    found = numbers(whole[whole["set"] == ALL], *keys)
    labels = sorted(p.classes[k] for k in np.unique(p.labels))
    of_class = {
        label: numbers(whole[whole["set"] == class_set(label)], *keys)
        for label in labels
    }
    policies = list(t.sweep["policy"].unique())
    best = headline_policy(results, at)
    tests = board.accuracy_tests(t, at).set_index("policy").to_dict("index")
    wanted = dict.fromkeys((reference, best, DEFAULT_POLICY, *draw.ceiling(results)))
    shown = [name for name in wanted if name in policies]

    def spoken(measure: str) -> str:
        known = [
            (name, found.get((name, at, measure))) for name in draw.compared(results)
        ]
        values = [
            f"{name} {number.value:.3f}" for name, number in known if number is not None
        ]
        return f"At threshold {at:g}: {', '.join(values)}."

    thresholds = [
        (name, value) for name, value, measure in found if measure == "accuracy"
    ]
    fixed_at = {name: None for name, value in thresholds if value is None}
    confusions = {
        name: picture(draw.confusion(results.episodes(name, at), p.classes, name))
        for name in dict.fromkeys((reference, best))
        if name in policies
    }
    return render(
        "report.html",
        title=_title(tests.get(best), best, reference, at),
        settings=s,
        p=p,
        at=at,
        best=best,
        reference=reference,
        significant=SIGNIFICANT,
        found=found,
        of_class=of_class,
        labels=labels,
        policies=policies,
        shown=shown,
        one_view=t.sweep.query("policy == @reference or policy == @best").iloc[0][
            "accuracy"
        ],
        tests=tests,
        nothing=board.nothing_differs(t, at, reference),
        warning=board.too_few_objects(t, at, len(p)),
        risks=board.promised_risks(t, s["risks"]),
        by_class_at=_thresholds(results, at),
        fixed_at=fixed_at,
        spoken=spoken,
        figures={
            name: picture(figure)
            for name, figure in _figures(results, best, at).items()
        },
        confusions=confusions,
        failures=_failures(results, best, at),
        made=_made(results),
    )


def _title(test: Mapping[Any, Any] | None, best: str, reference: str, at: float) -> str:
    if test is None:
        return f"{best} at threshold {at:g}"
    if test["p_holm"] >= SIGNIFICANT:
        return (
            f"No policy that a robot could follow is clearly more accurate than {reference} at"
            f" threshold {at:g}"
        )
    more = "more" if test["difference"] > 0 else "less"
    return f"{best} is {100 * abs(test['difference']):.1f} points {more} accurate than {reference}"


def _figures(results: ClassResults, best: str, at: float) -> dict[str, Figure]:
    sweep = results.tables.sweep
    reference = results.settings["reference"]
    tests = board.accuracy_tests(results.tables, at)
    figures = {}
    if len(tests):
        figures["differences"] = draw.differences(results.tables, tests, "accuracy")
    figures |= {
        measure: draw.threshold_curve(results, measure)
        for measure in ("class_accuracy", "accuracy")
    }

    varying = [
        budget
        for budget in ("n_views", "travel_all")
        if sweep[budget].max() > sweep[budget].min()
    ]
    figures |= {budget: draw.budget_curve(results, budget) for budget in varying}

    ran = [
        n
        for n in dict.fromkeys((reference, best, *draw.ceiling(results)))
        if n in set(sweep["policy"])
    ]
    return figures | {"reliability": draw.reliability_diagram(results, ran, at)}


def _thresholds(results: ClassResults, at: float) -> dict[str, float]:
    """Return policies by class at their published thresholds (tables 8 to 11)."""
    ran = set(results.tables.sweep["policy"])
    thresholds = results.settings["thresholds"]
    wanted = {
        name: published_threshold(name) or 0.99
        for name in (LEM, *PUBLISHED_COLUMNS)
        if name in ran
    }
    return {name: t if t in thresholds else at for name, t in wanted.items()}


def worst_failures(episodes: pd.DataFrame, most: int = 8) -> pd.DataFrame:
    """Return the objects that a policy gets wrong most often.

    Args:
        episodes: of the policy.
        most: number of objects.

    Returns:
        Object, number of wrong episodes, mean confidence, and the run of the most confident one.
    """
    wrong = episodes[episodes["answer"].astype(str) != episodes["label"].astype(str)]
    wrong = wrong.assign(object=wrong["object"].astype(str)).sort_values(
        "confidence",
        ascending=False,
        kind="stable",
    )

    groups = wrong.groupby("object", sort=False)
    table = groups.agg(
        wrong=("run", "size"),
        confidence=("confidence", "mean"),
        run=("run", "first"),
    ).reset_index()
    return table.sort_values(
        ["wrong", "confidence"],
        ascending=False,
        kind="stable",
    ).head(most)


def _failures(results: ClassResults, best: str, at: float) -> list[dict[Any, Any]]:
    """Return the worst failures of a policy, each with its most confident episode."""
    p = results.predictions
    episodes = results.episodes(best, at)
    names = np.asarray(episodes["object"].astype(str))
    found = []
    for failure in worst_failures(episodes).to_dict("records"):
        name = failure["object"]
        mine = (names == name) & (episodes["run"] == failure["run"])
        episode = episodes[mine].iloc[0]
        views = [int(v) for v in episode["views"]]
        conflicting = bool(p.conflicting[p.names.index(name)])
        shown = {"answer": episode["answer"], "views": views}
        found.append(failure | shown | {"conflicting": conflicting})
    return found


def _made(results: ClassResults) -> dict[str, str]:
    s = results.settings
    return {
        **origin(results.predictions, s),
        "valley classes": ", ".join(s["valley_classes"]) or "none",
        "first views": (
            f"{s['runs']} of each object, the same for every policy and threshold; seed {s['seed']}"
        ),
        "bootstrap": f"{s['samples']} samples of objects",
        "tests": (
            "signs of the differences of objects flipped; Holm's correction is over all policies"
            " and thresholds of a measure"
        ),
    }
