"""Write a self-contained HTML report from a folder of benchmark results."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nextview.errors import ResultsError
from nextview.files import check_new, new_file
from nextview.policies.registry import DEFAULT_POLICY
from nextview_lab.benchmark import class_tables as board
from nextview_lab.benchmark import figures as draw
from nextview_lab.benchmark.class_tables import ClassResults
from nextview_lab.benchmark.classes import load
from nextview_lab.benchmark.comparison import ALL, SIGNIFICANT, values_of
from nextview_lab.benchmark.entries import is_oracle
from nextview_lab.benchmark.page import numbers, origin, picture, render
from nextview_lab.extras import extras

with extras():
    import pandas as pd


def report(
    results: Path,
    out: Path | None = None,
    /,
    overwrite: bool = False,
) -> Path:
    """Write one self-contained HTML page: tables, differences, and the worst failures.

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
    if not loaded.tables.choosing():
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
        n for n in results.tables.choosing() if not is_oracle(n) and n != reference
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
    whole = t.measures[(t.measures["views"] == 0) & (t.measures["set"] == ALL)]
    found = numbers(whole, "policy", "threshold", "measure")
    policies = t.choosing()
    best = headline_policy(results, at)
    tests = board.accuracy_tests(t, at)
    by_policy = tests.set_index("policy").to_dict("index")
    wanted = dict.fromkeys((reference, best, DEFAULT_POLICY, "oracle-gain"))
    figures = {}
    if len(tests):
        drawn = draw.differences(t, tests, "accuracy")
        figures["differences"] = picture(drawn)
    return render(
        "report.html",
        title=_title(by_policy.get(best), best, reference, at),
        settings=s,
        p=p,
        at=at,
        best=best,
        reference=reference,
        significant=SIGNIFICANT,
        found=found,
        policies=policies,
        shown=[name for name in wanted if name in policies],
        tests=by_policy,
        nothing=board.nothing_differs(t, at, reference),
        warning=board.too_few_objects(t, at, len(p)),
        risks=board.promised_risks(t, s["risks"]),
        figures=figures,
        failures=_failures(results, best, at),
        made={
            **origin(p, s),
            "valley classes": ", ".join(s["valley_classes"]) or "none",
            "first views": (
                f"{s['runs']} of each object, the same for every policy and threshold; seed"
                f" {s['seed']}"
            ),
            "bootstrap": f"{s['samples']} samples of objects",
            "tests": (
                "signs of the differences of objects flipped; Holm's correction is over all"
                " policies and thresholds of a measure"
            ),
        },
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
