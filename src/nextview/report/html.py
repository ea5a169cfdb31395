"""The report: one self-contained HTML page made from a folder of benchmark results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nextview.arguments import takes_paths
from nextview.benchmark.entries import is_oracle
from nextview.benchmark.leaderboard import SIGNIFICANT, headline_threshold, level_differences, nothing_differs, too_few
from nextview.benchmark.results import KIND, Results
from nextview.errors import ResultsError
from nextview.outputs import added_file, check_added, check_file, written_whole
from nextview.policies.registry import DEFAULT
from nextview.report import curves
from nextview.report import html_tables as tables
from nextview.report.elements import GENERATOR, NONE, Card, Picture, numbers, percent, picture, render
from nextview.report.object_pictures import Pictures
from nextview.report.trajectories import gains, trajectories, worst_failures


def headline_policy(results: Results, threshold: float) -> str:
    """The most accurate policy that a robot could follow, other than the reference; the reference if it is alone."""
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    reference = results.settings["reference"]
    names = [n for n in results.tables.sweep["policy"].unique() if not is_oracle(n) and n != reference]
    return max(names, key=lambda n: found[n, threshold, "accuracy"].value, default=reference)


PAGE = "report.html"
"""Beside the results that it shows."""


@takes_paths("path")
def write_report(results: Results, path: Path, pictures: Pictures) -> None:
    """Write the page, whole or not at all. In the folder of the results it counts as one of their files.

    Args:
        results: of a benchmark, with at least one policy that chooses its views.
        path: of the page.
        pictures: of the objects, for the failures and the viewer.

    Raises:
        ResultsError: there are fixed views only, or see ``check_page``.
    """
    check_page(path, results.folder)
    if results.tables.sweep.empty:
        raise ResultsError(f"{results.folder}: holds fixed views only; a report needs a policy that chooses")
    text = page(results, pictures)
    beside = _is_beside(path, results.folder)
    with added_file(results.folder, path.name, KIND) if beside else written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


@takes_paths("path", "results")
def check_page(path: Path, results: Path) -> None:
    """See, before any work is done, that a page can be written; nothing is touched.

    Args:
        path: of the page.
        results: folder of the results that it is to show.

    Raises:
        ResultsError: it cannot be written, or something else than such a page is there.
    """
    check_file(path)
    if _is_beside(path, results):
        if path.name != PAGE:
            raise ResultsError(f"{path}: in a folder of results the page is called {PAGE}; give a path outside of it")
        check_added(results, path.name, KIND)
    elif path.exists() and not (path.is_file() and GENERATOR.encode() in _beginning(path)):
        raise ResultsError(f"{path}: is there and is no page of nextview's; give another name")


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1000)


def _is_beside(path: Path, results: Path) -> bool:
    return path.parent.resolve() == results.resolve()


def page(results: Results, pictures: Pictures) -> str:
    """The whole page as text."""
    at = headline_threshold(results.settings["thresholds"])
    best, reference = headline_policy(results, at), results.settings["reference"]
    failures = worst_failures(results.episodes(best, at))
    title, difference = _verdict(results, best, at)
    p, settings = results.predictions, results.settings
    return render(
        "report.html",
        title=title,
        difference=difference,
        in_worlds=level_differences(results.tables, results.settings["reference"]),
        best=best,
        reference=reference,
        runs=settings["runs"],
        warning=too_few(results.tables, at, len(p)),
        verdict=nothing_differs(results.tables, at, reference),
        facts=f"{_objects(results)} of {len(set(p.labels.tolist()))} classes, {settings['runs']} first views each, "
        f"threshold {at:g}, at most {settings['max_views']} views.",
        headline=_cards(results, best, at),
        scenes=_scenes(results, best, at, failures.values.tolist(), pictures),
        no_pictures=pictures.why_not,
        left_out=list(settings["failures"].values()),
        overview=tables.overview(results, at),
        differences=_differences(results, at),
        curve_figures=_curves(results, at),
        reliability=_reliability(results, best, at),
        calibration=tables.calibration(results, curves.followed(results)),
        risks=tables.risks(results),
        levels=tables.levels(results),
        class_figures=_classes(results, best, at),
        class_tables=[tables.per_class(results, measure, at) for measure in ("accuracy", "travel_moved")],
        fixed_views=tables.five_views(results),
        failures=_failures(results, best, at, failures.values.tolist(), pictures),
        made=_made(results, pictures),
    )


def _cards(results: Results, best: str, at: float) -> list[Card]:
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    reference = results.settings["reference"]
    first = results.tables.sweep.query("policy == @reference or policy == @best").iloc[0]
    ran = set(results.tables.sweep["policy"])
    cards = [Card("one view", percent(first["accuracy"]), "no travel")]
    for policy in dict.fromkeys((reference, best, DEFAULT, *curves.own_policies(results), *curves.ceiling(results))):
        if policy in ran:
            n = found[policy, at, "accuracy"]
            n_views, travel = found[policy, at, "n_views"].value, found[policy, at, "travel_all"].value
            interval = f"{100 * n.low:.1f} {NONE} {percent(n.high)}"
            cards.append(Card(policy, percent(n.value), f"{interval}; {n_views:.2f} views, {travel:.2f} cells"))
    return cards


def _verdict(results: Results, best: str, at: float) -> tuple[str, str]:
    """The title, and the difference of the best policy to the reference in words; none if it was not compared."""
    reference = results.settings["reference"]
    rows = results.tables.tests.query("policy == @best and threshold == @at and measure == 'accuracy'")
    if rows.empty:
        return f"{best} at threshold {at:g}", ""
    difference, low, high, p = rows[["difference", "low", "high", "p_holm"]].to_numpy(float)[0]
    title = (
        f"{best} is {100 * abs(difference):.1f} points {'more' if difference > 0 else 'less'} accurate than {reference}"
    )
    if p >= SIGNIFICANT:
        title = f"No policy that a robot could follow is clearly more accurate than {reference} at threshold {at:g}"
    return title, (
        f"{tables.points(difference)} points, 95\u00a0% interval {tables.points(low)} to {tables.points(high)}, "
        f"p after Holm's correction {tables.p_value(p).replace('< ', 'under ')}"
    )


def _objects(results: Results) -> str:
    """How many there are; of worlds, also at which levels."""
    levels = list(results.tables.levels["level"].unique())
    n = len(results.predictions)
    if not levels:
        return f"{n:,} objects"
    listed = " and ".join([", ".join(levels[:-1]), levels[-1]] if levels[1:] else levels)
    return f"{n:,} world{'s' * (n > 1)} of {listed} clutter around objects"


def _spoken(results: Results, policies: Sequence[str], at: float, measure: str) -> str:
    """The numbers of a figure in words, for those who cannot see it."""
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    shown = (f"{name} {found[name, at, measure].value:.3f}" for name in policies if (name, at, measure) in found)
    return f"At threshold {at:g}: " + ", ".join(shown) + "."


def _others(results: Results, where: str = "the tables") -> str:
    """What a figure's caption says of the policies that are left out of it in a crowd; nothing if none are."""
    left = len(curves.followed(results)) - len(curves.compared(results))
    drawn = "the reference, the default, your own, the most accurate others and oracles"
    return f" Drawn are {drawn}; {left} more are in {where}." if left else ""


def _differences(results: Results, at: float) -> list[Picture]:
    if results.tables.tests.empty:
        return []
    policies = list(results.tables.sweep["policy"].unique())
    return [
        picture(
            curves.differences(results, at, measure),
            f"Difference of each policy to the reference in {what}, with intervals. "
            + _spoken(results, policies, at, measure),
            f"Difference in {what} at threshold {at:g}; filled where Holm's p is under {SIGNIFICANT}.",
        )
        for measure, what in (("accuracy", "accuracy"), ("n_views", "views"), ("travel_all", "travel"))
    ]


def _curves(results: Results, at: float) -> list[Picture]:
    names = curves.compared(results)
    as_published = ", as figures 15 and 18" if results.tables.levels.empty else ""
    oracles = "; oracles broken" if any(map(is_oracle, names)) else ""
    figures = [
        picture(
            curves.threshold_curve(results, measure),
            f"{what} against threshold. " + _spoken(results, names, at, measure),
            f"{what} against threshold{as_published}.{_others(results)}",
        )
        for measure, what in (("class_accuracy", "Mean class accuracy"), ("accuracy", "Accuracy over objects"))
    ]
    for budget, what in (("n_views", "views"), ("travel_all", "travel")):
        if results.tables.sweep[budget].max() > results.tables.sweep[budget].min():
            figures.append(
                picture(
                    curves.budget_curve(results, budget),
                    f"Accuracy against mean {what}. " + _spoken(results, names, at, budget),
                    f"Accuracy against mean {what}{oracles}.{_others(results)}",
                )
            )
    return figures


def _reliability(results: Results, best: str, at: float) -> list[Picture]:
    ran = set(results.tables.sweep["policy"])
    policies = [n for n in dict.fromkeys((results.settings["reference"], best, *curves.ceiling(results))) if n in ran]
    return [
        picture(
            curves.reliability_diagram(results, policies, at),
            "Share of right answers against confidence. " + _spoken(results, policies, at, "calibration_error"),
            f"Reliability at threshold {at:g}: on the diagonal, 90\u00a0% sure is right nine times in ten.",
        )
    ]


def _classes(results: Results, best: str, at: float) -> list[Picture]:
    ran, reference = set(results.tables.sweep["policy"]), results.settings["reference"]
    figures = [
        picture(
            curves.confusion(results.episodes(name, at), results.predictions.classes, name),
            f"Confusion matrix of {name} at threshold {at:g}.",
            "Percent of each true class.",
        )
        for name in dict.fromkeys((reference, best))
        if name in ran
    ]
    if reference in ran and len(set(curves.compared(results)) - set(curves.ceiling(results))) > 1:
        figures.append(
            picture(
                curves.class_differences(results, at),
                "Accuracy of each class against the reference, in percentage points; the table below has the numbers.",
                f"Accuracy by class against {reference} at threshold {at:g}, percentage points."
                + _others(results, "per_class.csv"),
            )
        )
    return figures


def _failures(results: Results, best: str, at: float, failures: list, pictures: Pictures) -> list[dict[str, Any]]:
    p, items = results.predictions, []
    episodes = results.episodes(best, at)
    names = np.asarray(episodes["object"].astype(str))
    for name, wrong, confidence, run in failures:
        episode = episodes[(names == name) & (episodes["run"] == run)].iloc[0]
        views = [int(v) for v in episode["views"]]
        items.append(
            {
                "name": name,
                "answer": str(episode["answer"]),
                "wrong": wrong,
                "confidence": confidence,
                "conflicting": bool(p.conflicting[p.names.index(name)]),
                "views": views,
                "pictures": pictures.views(name, views),
            }
        )
    return items


def _scenes(results: Results, best: str, at: float, failures: list, pictures: Pictures) -> dict[str, Any] | None:
    """What the viewer shows; None if there is nothing to see."""
    reference = results.settings["reference"]
    wanted = []
    if reference != best and reference in set(results.tables.sweep["policy"]):
        better = gains(results.episodes(best, at), results.episodes(reference, at)).values.tolist()
        wanted += [(name, run, f"{best} is right in {n} more runs than {reference}") for name, n, run in better]
    runs = results.settings["runs"]
    wanted += [(name, run, f"{best} is wrong in {n} of {runs} runs") for name, n, _, run in failures[:6]]
    policies = [best, *(n for n in curves.compared(results) if n != best)]
    scenes = trajectories(results, policies, wanted, at, pictures)
    return scenes if scenes["scenes"] else None


def _made(results: Results, pictures: Pictures) -> dict[str, str]:
    s, p = results.settings, results.predictions
    splits = zip(*np.unique(p.splits, return_counts=True), strict=True)
    conflicting = [name for name, twice in zip(p.names, p.conflicting, strict=True) if twice]
    return {
        "predictions": f"{s['predictions']}, SHA-256 {s['predictions_sha256']}",
        **{f"model: {kind}": f"{name}, SHA-256 {sha}" for kind, (name, sha) in s["models"].items()},
        "splits": ", ".join(f"{n} {name or 'unnamed'}" for name, n in splits),
        "the same mesh under another label": ", ".join(conflicting) or "none",
        "valley classes": ", ".join(s["valley_classes"]) or "none",
        "first views": f"{s['runs']} of each object, the same for every policy and threshold; seed {s['seed']}",
        "bootstrap": f"{s['samples']} samples of objects; p-values from its standard error",
        "McNemar": "for clustered pairs (Durkalski et al. 2003)",
        "Holm": "over all policies and thresholds of a measure",
        "calibration error": "15 bins of equal width (Guo et al. 2017)",
        "pictures": pictures.store.path.name if pictures.store is not None else pictures.why_not,
    }
