"""The report: one self-contained HTML page made from a folder of benchmark results."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from nextview.benchmark.results import KIND, Results
from nextview.errors import ResultsError
from nextview.outputs import added_file, check_added, check_file, written_whole
from nextview.report import curves
from nextview.report import html_tables as tables
from nextview.report.elements import GENERATOR, asset, card, description, document, numbers, picture, side_by_side
from nextview.report.trajectories import Pictures, gains, trajectories, worst_failures


def headline_policy(results: Results, threshold: float) -> str:
    """The most accurate policy that a robot could follow, other than the reference; the reference if it is alone."""
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    reference = results.settings["reference"]
    names = [n for n in results.tables.sweep["policy"].unique() if not curves.is_oracle(n) and n != reference]
    return max(names, key=lambda n: found[n, threshold, "accuracy"].value, default=reference)


PAGE = "report.html"
"""Beside the results that it shows."""


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
    elif path.exists() and GENERATOR.encode() not in path.read_bytes()[:1000]:
        raise ResultsError(f"{path}: is there and is no page of nextview's; give another name")


def _is_beside(path: Path, results: Path) -> bool:
    return path.parent.resolve() == results.resolve()


def page(results: Results, pictures: Pictures) -> str:
    """The whole page as text."""
    at = curves.headline_threshold(results)
    best, reference = headline_policy(results, at), results.settings["reference"]
    failures = worst_failures(results.episodes(best, at))
    sections = [
        ("results", "Results", _results(results, at)),
        ("curves", "Accuracy against its travel weight", _curves(results, at)),
        ("calibration", "Is the confidence worth its name?", _calibration(results, best, at)),
        ("classes", "By class", _classes(results, best, at)),
        ("fixed", "Fixed views", tables.five_views(results)),
        ("failures", "The worst failures", _failures(results, best, at, failures.values.tolist(), pictures)),
        ("episodes", "Step through an episode", _viewer(results, best, at, failures.values.tolist(), pictures)),
        ("made", "How this was made", _made(results, pictures)),
    ]
    title = f"Next best view: {best} against {reference}"
    return document(title, _headline(results, best, at), sections, asset("viewer.js"))


def _headline(results: Results, best: str, at: float) -> str:
    p, settings = results.predictions, results.settings
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    reference = settings["reference"]
    first = results.tables.sweep.query("policy == @reference or policy == @best").iloc[0]

    def of(policy: str) -> str:
        n = found[policy, at, "accuracy"]
        n_views, travel = found[policy, at, "n_views"].value, found[policy, at, "travel_all"].value
        return card(
            escape(policy), f"{100 * n.value:.1f} %",
            f"{100 * n.low:.1f} &ndash; {100 * n.high:.1f} %; {n_views:.2f} views, {travel:.2f} cells",
        )  # fmt: skip

    cards = [card("one view", f"{100 * first['accuracy']:.1f} %", "no travel")]
    ran = set(results.tables.sweep["policy"])
    cards += [of(name) for name in dict.fromkeys((reference, best)) if name in ran]
    if "oracle-gain" in ran:
        cards.append(of("oracle-gain"))
    return (
        f"{_verdict(results, best, at)}"
        f"<p>{len(p):,} objects of {len(set(p.labels.tolist()))} classes, {settings['runs']} first views each, "
        f"threshold {at:g}, at most {settings['max_views']} views. All intervals are 95&nbsp;% bootstrap intervals "
        f'over objects.</p><div class="cards">{"".join(cards)}</div>'
    )


def _verdict(results: Results, best: str, at: float) -> str:
    reference = results.settings["reference"]
    rows = results.tables.tests.query("policy == @best and threshold == @at and measure == 'accuracy'")
    if rows.empty:
        return f"<h1>{escape(best)} at threshold {at:g}</h1>"
    difference, low, high, p = rows[["difference", "low", "high", "p_holm"]].to_numpy(float)[0]
    best, reference = escape(best), escape(reference)
    title = (
        f"{best} is {100 * abs(difference):.1f} points {'more' if difference > 0 else 'less'} accurate than {reference}"
    )
    if p >= 0.05:
        title = f"No policy that a robot could follow is clearly more accurate than {reference}"
    p_text = tables.p_value(p).replace("&lt; ", "under ")
    return (
        f'<h1>{title}</h1><p class="lead">{best} against {reference}: {100 * difference:+.1f} points, 95&nbsp;% '
        f"interval {100 * low:+.1f} to {100 * high:+.1f}, p after Holm's correction {p_text}.</p>"
    )


def _spoken(results: Results, policies: Sequence[str], at: float, measure: str) -> str:
    """The numbers of a figure in words, for those who cannot see it."""
    found = numbers(results.tables.summary, "policy", "threshold", "measure")
    shown = (f"{name} {found[name, at, measure].value:.3f}" for name in policies if (name, at, measure) in found)
    return f"At threshold {at:g}: " + ", ".join(shown) + "."


def _others(results: Results, where: str = "the tables") -> str:
    """What a figure's caption says of the policies that are left out of it in a crowd; nothing if none are."""
    left = len(curves.followed(results)) - len(curves.compared(results))
    drawn = f"the reference, the {curves.BEST} most accurate others and oracles"
    return f" Drawn are {drawn}; {left} more are in {where}." if left else ""


def _results(results: Results, at: float) -> str:
    text = (
        "<p>Policies marked <em>oracle</em> are told something that no robot knows: the true class, the true map, or "
        "what every view would say. <code>oracle-valley</code> is the published method, which takes the map's peak or "
        "its valley by the true class. <em>Without duplicates</em> leaves out the objects whose very mesh also stands "
        "in the data under another label. Travel is in grid cells: over all episodes, and, as published, over those "
        "that moved.</p>"
    )
    failures = "".join(f"<p>Left out: {escape(sentence)}</p>" for sentence in results.settings["failures"].values())
    shown = ""
    if len(results.tables.tests):
        shown = side_by_side(
            *(
                picture(
                    curves.differences(results, at, measure),
                    f"Difference of each policy to the reference in {what}, with intervals. "
                    + _spoken(results, list(results.tables.sweep["policy"].unique()), at, measure),
                    f"Difference in {what} at threshold {at:g}; filled where Holm's p is under 0.05.",
                )
                for measure, what in (("accuracy", "accuracy"), ("n_views", "n_views"), ("travel_all", "travel"))
            ),
            small=True,
        )
    return text + failures + tables.overview(results, at) + shown


def _curves(results: Results, at: float) -> str:
    names = curves.compared(results)
    text = (
        "<p>A threshold buys accuracy with views and travel. The curves go through all thresholds from &ldquo;one view "
        "for all&rdquo; to &ldquo;all views for nearly all&rdquo;; the number beside a name is the curve's mean "
        "height.</p>"
    )
    figures = [
        picture(
            curves.threshold_curve(results, measure),
            f"{what} against threshold. " + _spoken(results, names, at, measure),
            f"{what} against threshold, as figures 15 and 18.{_others(results)}",
        )
        for measure, what in (("class_accuracy", "Mean class accuracy"), ("accuracy", "Accuracy over objects"))
    ]
    for budget, what in (("n_views", "n_views"), ("travel_all", "travel")):
        if results.tables.sweep[budget].max() > results.tables.sweep[budget].min():
            figures.append(
                picture(
                    curves.budget_curve(results, budget),
                    f"Accuracy against mean {what}. " + _spoken(results, names, at, budget),
                    f"Accuracy against mean {what}; oracles broken.{_others(results)}",
                )
            )
    return text + side_by_side(*figures)


def _calibration(results: Results, best: str, at: float) -> str:
    ran = set(results.tables.sweep["policy"])
    policies = [n for n in dict.fromkeys((results.settings["reference"], best, "oracle-gain")) if n in ran]
    figure = picture(
        curves.reliability_diagram(results, policies, at),
        "Share of right answers against confidence. " + _spoken(results, policies, at, "calibration_error"),
        f"Reliability at threshold {at:g}: on the diagonal, 90&nbsp;% sure is right nine times in ten.",
    )
    return tables.calibration(results, curves.followed(results)) + side_by_side(figure)


def _classes(results: Results, best: str, at: float) -> str:
    figures, ran = [], set(results.tables.sweep["policy"])
    for name in dict.fromkeys((results.settings["reference"], best)):
        if name in ran:
            figure = curves.confusion(results.episodes(name, at), results.predictions.classes, name)
            figures.append(
                picture(figure, f"Confusion matrix of {name} at threshold {at:g}.", "Percent of each true class.")
            )
    difference = ""
    if results.settings["reference"] in ran and len(set(curves.compared(results)) - {"oracle-gain"}) > 1:
        reference = escape(results.settings["reference"])
        difference = picture(
            curves.class_differences(results, at),
            "Accuracy of each class against the reference, in percentage points; the table below has the numbers.",
            f"Accuracy by class against {reference} at threshold {at:g}, percentage points."
            + _others(results, "per_class.csv"),
        )
    return (
        side_by_side(*figures, difference)
        + tables.per_class(results, "accuracy", at)
        + tables.per_class(results, "travel_moved", at)
    )


def _failures(results: Results, best: str, at: float, failures: list, pictures: Pictures) -> str:
    p, items = results.predictions, []
    episodes = results.episodes(best, at)
    names = np.asarray(episodes["object"].astype(str))
    for name, wrong, confidence, run in failures:
        episode = episodes[(names == name) & (episodes["run"] == run)].iloc[0]
        views = [int(v) for v in episode["views"]]
        shown = pictures.views(name, views)
        strip = "".join(
            f'<img src="{shown[v]}" alt="{escape(name)} from view {v}" title="view {v}">' for v in views if v in shown
        )
        duplicate = (
            " Its very mesh is also in the data under another label." if p.conflicting[p.names.index(name)] else ""
        )
        items.append(
            f"<li><strong>{escape(name)}</strong>, taken for {escape(str(episode['answer'])).replace('_', ' ')}: wrong "
            f"in {wrong} of {results.settings['runs']} runs, on average {100 * confidence:.1f}&nbsp;% sure.{duplicate} "
            f'<span class="soft">Views {", ".join(map(str, views))}.</span><div class="strip">{strip}</div></li>'
        )
    if not items:
        return f"<p>{escape(best)} made no mistake.</p>"
    return (
        f"<p>What {escape(best)} gets wrong from most first views, and then with the most confidence; the views are "
        f'those of its most confident mistake.</p><ul class="failures">{"".join(items)}</ul>'
    )


def _viewer(results: Results, best: str, at: float, failures: list, pictures: Pictures) -> str:
    reference = results.settings["reference"]
    wanted = []
    if reference != best and reference in set(results.tables.sweep["policy"]):
        better = gains(results.episodes(best, at), results.episodes(reference, at)).values.tolist()
        wanted += [(name, run, f"{best} is right in {n} more runs than {reference}") for name, n, run in better]
    runs = results.settings["runs"]
    wanted += [(name, run, f"{best} is wrong in {n} of {runs} runs") for name, n, _, run in failures[:6]]
    scenes = trajectories(results, [best, *(n for n in curves.compared(results) if n != best)], wanted, at, pictures)
    if not scenes["scenes"]:
        return ""
    data = json.dumps(scenes, separators=(",", ":")).replace("<", "\\u003c")  # no name opens a comment or a tag
    return (
        "<p>The dots are the views, the lighter the higher their depth-entropy; the red ring is the first view. Drag "
        "to turn, and use the buttons or the arrow keys to step.</p>"
        '<div id="viewer"><div><div class="controls">'
        '<select id="scene" aria-label="object"></select><select id="policy" aria-label="policy"></select>'
        '<button id="back" aria-label="one view back">&#9664;</button>'
        '<button id="next" aria-label="next view">&#9654;</button></div>'
        '<div class="stage"><canvas id="sphere" tabindex="0" role="img"></canvas></div></div>'
        '<div><p id="why" class="soft"></p><p id="verdict" aria-live="polite"></p><ol id="steps"></ol></div></div>'
        f'<script type="application/json" id="trajectories">{data}</script>'
    )


def _made(results: Results, pictures: Pictures) -> str:
    s, p = results.settings, results.predictions
    splits = zip(*np.unique(p.splits, return_counts=True), strict=True)
    conflicting = [name for name, twice in zip(p.names, p.conflicting, strict=True) if twice]
    facts = {
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
    }  # fmt: skip
    if pictures.store is not None:
        facts["pictures"] = pictures.store.path.name
    return description(facts)
