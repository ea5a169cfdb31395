"""The report: one self-contained HTML page from a folder of benchmark results."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from nextview.benchmark import figures as draw
from nextview.benchmark import leaderboard as board
from nextview.benchmark import page as html
from nextview.benchmark.entries import is_oracle
from nextview.benchmark.page import NONE, Cell, Number, Part, Row, Section, Table, cell, percent, picture, words
from nextview.benchmark.published import COLUMNS, published_threshold
from nextview.benchmark.run import Results, load
from nextview.data.predictions import Predictions
from nextview.data.scene_views import scene_views
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, ResultsError
from nextview.files import check_new, new_file
from nextview.geometry.depth import headlight
from nextview.policies.registry import DEFAULT
from nextview.recognition.map_names import LEM

Found = dict[tuple, Number]
"""The numbers of the summary by policy, threshold and measure."""
PICTURE = 112
"""Side of a view's picture, pixels."""
OWNERS = np.array([[255, 255, 255], [11, 95, 165], [209, 73, 91], [225, 225, 225]])
"""Colours of nothing, the target, other things and the table in a scene."""
KNOWING = ("best", "worst", "high", "low", "true")
"""How the names of fixed views begin that are chosen by a truth no robot has."""
ORACLES = (
    "Policies marked oracle take something that no robot has: the true class, the true map, or what every view would "
    "show. Without duplicates leaves out the objects whose very mesh also stands in the data under another label. "
    "Travel is in grid cells, over all episodes and over those that moved."
)
PUBLISHED = "oracle-valley is the published method: it takes the map's peak or its valley by the true class."
CURVES = (
    "A threshold buys accuracy with views and travel. The curves go through all thresholds, from one view for all to "
    "all views for nearly all. Drawn are the reference, the most "
    "accurate others and oracles."
)
OVERVIEW = {
    "accuracy": ("accuracy", 3),
    "without duplicates": ("clean_accuracy", 3),
    "class accuracy": ("class_accuracy", 3),
    "views": ("n_views", 2),
    "travel, all": ("travel_all", 2),
    "travel, moved": ("travel_moved", 2),
    "arc, rad": ("arc_all", 2),
}
"""Columns of the overview: measure and digits."""


def report(results: Path, out: Path | None = None, /, store: Path | None = None, overwrite: bool = False) -> Path:
    """Write one self-contained HTML page: tables, curves, and the worst failures.

    Args:
        results: folder made by nextview benchmark.
        out: the page; RESULTS/report.html by default.
        store: take the pictures of the objects from this view store; by default from that of the predictions, if it
            still is where it was.
        overwrite: replace an earlier page.

    Raises:
        ResultsError: there are no results, or fixed views only; or the page cannot be written.
        DatasetError: the store that was given cannot be read.
    """
    path = out or results / "report.html"
    check_new(path, overwrite)
    loaded = load(results)
    if loaded.tables.sweep.empty:
        raise ResultsError(f"{results}: holds fixed views only; a report needs a policy that chooses")
    views, why_not = pictures_of(loaded.predictions, store)
    with new_file(path, overwrite) as part:
        part.write_text(page(loaded, views, why_not), encoding="utf-8")
    return path


def headline_policy(results: Results, threshold: float) -> str:
    """The most accurate policy that a robot could follow, other than the reference; the reference if it is alone."""
    found = html.numbers(results.tables.summary, "policy", "threshold", "measure")
    reference = results.settings["reference"]
    names = [n for n in results.tables.sweep["policy"].unique() if not is_oracle(n) and n != reference]
    return max(names, key=lambda n: found[n, threshold, "accuracy"].value, default=reference)


def page(results: Results, store: ViewStore | None, why_not: str) -> str:
    """The whole page as text."""
    s, t, p = results.settings, results.tables, results.predictions
    at, reference = board.headline_threshold(s["thresholds"]), s["reference"]
    best, found = headline_policy(results, at), html.numbers(t.summary, "policy", "threshold", "measure")
    title, difference = _verdict(results, best, at)
    warning = board.too_few(t, at, len(p))
    levels, objects = list(t.levels["level"].unique()), f"{len(p):,} objects"
    if levels:
        objects = f"{len(p):,} scenes of {', '.join(levels)} clutter"
    facts = f"{objects} of {len(set(p.labels.tolist()))} classes, {s['runs']} first views each, "
    facts += f"threshold {at:g}, at most {s['max_views']} views. "
    facts += "All intervals are 95\u00a0% bootstrap intervals over objects."
    lead = [(difference, "lead"), (board.level_differences(t, reference) or "", "")]
    lead += [(f"Warning. {warning}" if warning else "", "warning"), (facts, "")]
    above = [board.nothing_differs(t, at, reference) or "", ORACLES if levels else f"{ORACLES} {PUBLISHED}"]
    above += [f"Left out: {why}" for why in s["failures"].values()]
    alt = "Difference of each policy to the reference in accuracy. " + _spoken(results, found, at, "accuracy")
    caption = f"Difference in accuracy at threshold {at:g}; filled where Holm's p is under {board.SIGNIFICANT}."
    compared: list[Part] = [] if t.tests.empty else [[picture(draw.differences(results, at), alt, caption)]]
    by_class: list[Part] = [_confusions(results, best, at), *_per_class(results, found, at)]
    sections: list[Section] = [
        ("results", "Results", [*filter(None, above), _overview(results, found, at), *compared]),
        ("levels", "By clutter", list(_levels(results))),
        ("curves", "What accuracy costs", [CURVES, _curves(results, found, at)]),
        ("calibration", "Is the confidence worth its name?", list(_trust(results, found, best, at))),
        ("classes", "By class", by_class),
        ("fixed", "Fixed views", list(_fixed(results, found))),
        ("failures", "The worst failures", _failures(results, best, at, store)),
        ("made", "How this was made", [_made(results, store, why_not)]),
    ]
    return html.render(title, lead, _cards(results, found, best, at), sections)


def _cards(results: Results, found: Found, best: str, at: float) -> list[html.Card]:
    reference, ran = results.settings["reference"], set(results.tables.sweep["policy"])
    first = results.tables.sweep.query("policy == @reference or policy == @best").iloc[0]
    cards = [("one view", percent(first["accuracy"]), "no travel")]
    for policy in dict.fromkeys((reference, best, DEFAULT, *draw.ceiling(results))):
        if policy in ran:
            n, n_views, travel = (found[policy, at, m] for m in ("accuracy", "n_views", "travel_all"))
            small = f"{html.between(n)}; {n_views.value:.2f} views, {travel.value:.2f} cells"
            cards.append((policy, percent(n.value), small))
    return cards


def _verdict(results: Results, best: str, at: float) -> tuple[str, str]:
    """The title, and the difference of the best policy to the reference in words; none if it was not compared."""
    reference = results.settings["reference"]
    rows = results.tables.tests.query("policy == @best and threshold == @at and measure == 'accuracy'")
    if rows.empty:
        return f"{best} at threshold {at:g}", ""
    difference, low, high, p = rows[["difference", "low", "high", "p_holm"]].to_numpy(float)[0]
    more = "more" if difference > 0 else "less"
    title = f"{best} is {100 * abs(difference):.1f} points {more} accurate than {reference}"
    if p >= board.SIGNIFICANT:
        title = f"No policy that a robot could follow is clearly more accurate than {reference} at threshold {at:g}"
    return title, (
        f"{best} against {reference}: {_points(difference)} points, 95\u00a0% interval {_points(low)} to "
        f"{_points(high)}, p after Holm's correction {_p(p).replace('< ', 'under ')}."
    )


def _spoken(results: Results, found: Found, at: float, measure: str) -> str:
    shown = (f"{n} {found[n, at, measure].value:.3f}" for n in draw.compared(results) if (n, at, measure) in found)
    return f"At threshold {at:g}: " + ", ".join(shown) + "."


def _p(p: float) -> str:
    return NONE if np.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


def _points(difference: float) -> str:
    return f"{round(100 * difference, 1) + 0.0:+.1f}"


def _named(policy: str, *small: str) -> Cell:
    return Cell(policy, small, oracle=is_oracle(policy) or policy.split("-")[0] in KNOWING)


def _overview(results: Results, found: Found, threshold: float) -> Table:
    """All policies under one threshold: table 5 of the thesis, with what it lacked."""
    tests = results.tables.tests.query("threshold == @threshold and measure == 'accuracy'").set_index("policy")
    rows = []
    for policy in results.tables.sweep["policy"].unique():
        row = [_named(policy), *(cell(found[policy, threshold, m], digits) for m, digits in OVERVIEW.values())]
        if policy in tests.index:
            t = tests.loc[policy]
            row.append(Cell(_points(t["difference"]), (f"{_points(t['low'])} … {_points(t['high'])}",)))
            row += [Cell(_p(t["p_holm"])), Cell(_p(t["mcnemar_holm"]))]
        else:
            row += [Cell("reference"), Cell(NONE), Cell(NONE)]
        rows.append(row)
    head = ["policy", *OVERVIEW, "points over reference", "p, boot\u00adstrap", "p, Mc\u00adNemar"]
    caption = f"Every policy at threshold {threshold:g}. Small print: 95\u00a0% intervals. p-values are Holm-corrected."
    return Table(head, rows, caption)


def _levels(results: Results) -> Iterator[Table]:
    for policies in board.level_rows(results.tables):
        first = policies[0][1]
        head = ["policy", *(f"{row.n_views} view{'s' * (row.n_views > 1)}" for row in first)]
        head += [f"travel, {row.n_views} views" for row in first if row.n_views > 1]
        body: list[Row] = []
        for policy, rows in policies:
            line = [_named(policy)]
            for row in rows:
                small = [f"{row.low:.3f} {NONE} {row.high:.3f}"]
                if row.n_views > 1 and not np.isnan(row.difference):  # after one view nothing is chosen
                    around = f"{_points(row.difference_low)} … {_points(row.difference_high)}"
                    small += [f"{_points(row.difference)} ({around})", f"p {_p(row.p_holm)}"]
                line.append(Cell(f"{row.accuracy:.3f}", tuple(small)))
            body.append([*line, *(f"{row.travel:.2f}" for row in rows if row.n_views > 1)])
        caption = (
            f"{first[0].level.capitalize()} clutter, {first[0].scenes} scenes: accuracy after a fixed number of views, "
            "whatever is believed. Small print: 95\u00a0% intervals, points over "
            f"{results.settings['reference']} with theirs, and p-values with one Holm correction for all levels, "
            "policies and numbers of views. Travel is in grid cells."
        )
        yield Table(head, body, caption)


def _curves(results: Results, found: Found, at: float) -> list[html.Picture]:
    shown = []
    for measure, what in (("class_accuracy", "Mean class accuracy"), ("accuracy", "Accuracy over objects")):
        alt = f"{what} against threshold. " + _spoken(results, found, at, measure)
        shown.append(picture(draw.threshold_curve(results, measure), alt, f"{what} against threshold."))
    for budget, what in (("n_views", "views"), ("travel_all", "travel")):
        if results.tables.sweep[budget].max() > results.tables.sweep[budget].min():
            alt = f"Accuracy against mean {what}. " + _spoken(results, found, at, budget)
            shown.append(picture(draw.budget_curve(results, budget), alt, f"Accuracy against mean {what}."))
    return shown


def _trust(results: Results, found: Found, best: str, at: float) -> Iterator[Part]:
    ran = set(results.tables.sweep["policy"])
    policies = [n for n in dict.fromkeys((results.settings["reference"], best, *draw.ceiling(results))) if n in ran]
    alt = "Share of right answers against confidence. " + _spoken(results, found, at, "calibration_error")
    caption = f"Reliability at threshold {at:g}: on the diagonal, 90\u00a0% sure is right nine times in ten."
    yield [picture(draw.reliability_diagram(results, policies, at), alt, caption)]
    risks: list[Row] = []
    for r in board.promised_risks(results.tables):
        measured = Cell(percent(r.error), (html.between(Number(r.error, r.low, r.high)),))
        risks.append([_named(r.policy), percent(r.risk), f"{r.threshold:.4g}", measured, percent(r.confident)])
    if risks:
        caption = "Promised error rates of those who stop early, and measured ones."
        yield Table(["policy", "promised", "threshold", "measured", "stopped early"], risks, caption)


def _confusions(results: Results, best: str, at: float) -> list[html.Picture]:
    shown = []
    for name in dict.fromkeys((results.settings["reference"], best)):
        if name in set(results.tables.sweep["policy"]):
            drawn = draw.confusion(results.episodes(name, at), results.predictions.classes, name)
            alt = f"Confusion matrix of {name} at threshold {at:g}."
            shown.append(picture(drawn, alt, "Percent of each true class."))
    return shown


def _by_class(
    results: Results, found: Found, at: Mapping[str, float | None], measure: str, ends: Sequence[tuple], caption: str
) -> Table:
    """A measure of policies, each at its threshold, by class; then ``ends``: heading, measure and digits."""
    of_class = html.numbers(results.tables.per_class, "policy", "threshold", "label", "measure")
    digits = 3 if measure == "accuracy" else 2
    rows: list[Row] = []
    for label in sorted(results.tables.per_class["label"].unique()):
        rows.append([words(label), *(cell(of_class.get((n, t, label, measure)), digits) for n, t in at.items())])
    for heading, end, places in ends:
        rows.append([heading, *(cell(found.get((n, t, end)), places) for n, t in at.items())])
    head: Row = ["class", *(_named(n, *([] if t is None else [f"at {t:g}"])) for n, t in at.items())]
    return Table(head, rows, caption)


def _per_class(results: Results, found: Found, fallback: float) -> Iterator[Table]:
    """Tables 8 and 9 (40 classes: 10 and 11), each policy at the threshold of its published column.

    Of scenes nothing is published; there the policies of the curves are at the same threshold.
    """
    ran, thresholds = set(results.tables.sweep["policy"]), results.settings["thresholds"]
    if results.tables.levels.empty:
        wanted = {n: published_threshold(n) or 0.99 for n in (LEM, *COLUMNS) if n in ran}
        at = {name: t if t in thresholds else fallback for name, t in wanted.items()}
        table = {"accuracy": 8, "travel_moved": 9}
        more = 0 if len(results.predictions.classes) <= 10 else 2
        as_in = {
            m: f" As table {n + more} of the thesis, whose numbers stand last in a cell." for m, n in table.items()
        }
    else:
        at = {name: fallback for name in draw.compared(results) if not is_oracle(name)}
        as_in = dict.fromkeys(("accuracy", "travel_moved"), "")
    for measure, what, over, digits in (
        ("accuracy", "Accuracy", "objects", 3),
        ("travel_moved", "Travel in grid cells, over the episodes that moved,", "episodes", 2),
    ):
        ends = [("mean of classes", f"class_{measure}", digits), (f"mean of {over}", measure, digits)]
        yield _by_class(results, found, at, measure, ends, f"{what} by class.{as_in[measure]}")


def _fixed(results: Results, found: Found) -> Iterator[Table]:
    at = {name: None for name, threshold, measure in found if threshold is None and measure == "accuracy"}
    ends = [("mean of classes", "class_accuracy", 3), ("mean of objects", "accuracy", 3)]
    ends += [("views", "n_views", 0), ("travel, cells", "travel_all", 1)]
    caption = "Fixed views, no threshold, as tables 3 and 12. The published numbers are of a network for 40 classes."
    if at:
        yield _by_class(results, found, at, "accuracy", ends, caption)


def worst_failures(episodes: pd.DataFrame, most: int = 8) -> pd.DataFrame:
    """Objects, and how often, how surely and in which run a policy gets them wrong, the most often first."""
    wrong = episodes[episodes["answer"].astype(str) != episodes["label"].astype(str)]
    wrong = wrong.assign(object=wrong["object"].astype(str)).sort_values("confidence", ascending=False, kind="stable")
    groups = wrong.groupby("object", sort=False)
    table = groups.agg(wrong=("run", "size"), confidence=("confidence", "mean"), run=("run", "first")).reset_index()
    return table.sort_values(["wrong", "confidence"], ascending=False, kind="stable").head(most)


def _failures(results: Results, best: str, at: float, store: ViewStore | None) -> list[Part]:
    p, runs = results.predictions, results.settings["runs"]
    items: list[html.Strip] = []
    episodes = results.episodes(best, at)
    names = np.asarray(episodes["object"].astype(str))
    for name, wrong, confidence, run in worst_failures(episodes).itertuples(index=False):
        episode = episodes[(names == name) & (episodes["run"] == run)].iloc[0]
        views = [int(v) for v in episode["views"]]
        text = f", classified as {words(episode['answer'])}: wrong in {wrong} of {runs} runs, on average "
        text += f"{percent(confidence)} sure."
        if p.conflicting[p.names.index(name)]:
            text += " Its very mesh is also in the data under another label."
        images = _images(store, name, views) if store is not None and name in store.names else {}
        items.append(html.Strip(name, text, f"Views {', '.join(map(str, views))}.", images))
    if not items:
        return [f"{best} made no mistake."]
    explained = f"What {best} gets wrong from most first views, and then with the most confidence; the views are those "
    return [explained + "of its most confident mistake.", items]


def pictures_of(predictions: Predictions, store: Path | None = None) -> tuple[ViewStore | None, str]:
    """The store of the objects' pictures, or None and why not."""
    if store is not None:
        given = ViewStore.open(store)
        if given.sphere != predictions.sphere or not set(given.names) & set(predictions.names):
            raise ResultsError(f"{store}: holds no views of these objects from these viewpoints")
        return given, ""
    remedy = "give it with --store"
    if not predictions.store:
        return None, f"No pictures: the predictions do not name the view store they were made from; {remedy}."
    try:
        named = ViewStore.open(predictions.store)
        row = {name: i for i, name in enumerate(named.names)}
        rows = [row.get(name, -1) for name in predictions.names]
        same = named.sphere == predictions.sphere and -1 not in rows
        same = same and np.array_equal(named.measure()[rows], predictions.depth_entropy)
    except DatasetError:
        return None, f"No pictures: there is no view store at {predictions.store} any more; {remedy}."
    return (named, "") if same else (None, f"No pictures: the view store {predictions.store} has changed; {remedy}.")


def _images(store: ViewStore, name: str, views: list[int]) -> dict[str, str]:
    """Images of some views of an object, as data URIs; in a scene the target is told from all else by its colour."""
    row = store.names.index(name)
    images: NDArray = store.image(row)
    if store.attributes.scene:
        scene = scene_views(store, row)
        shade = np.stack([headlight(depth, scene.intrinsics) for depth in scene.depth])[..., None] / 255
        images = np.where(scene.owner[..., None] > 0, OWNERS[scene.owner] * (0.35 + 0.65 * shade), 255).astype(np.uint8)
    found = {}
    for view in views:
        file = BytesIO()
        small = Image.fromarray(images[view]).resize((PICTURE, PICTURE), Image.Resampling.LANCZOS)
        small.save(file, "WEBP", quality=70)
        found[f"{name} from view {view}"] = "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()
    return found


def _made(results: Results, store: ViewStore | None, why_not: str) -> dict[str, str]:
    s = results.settings
    return {
        **origin(results.predictions, s),
        "valley classes": ", ".join(s["valley_classes"]) or "none",
        "first views": f"{s['runs']} of each object, the same for every policy and threshold; seed {s['seed']}",
        "bootstrap": f"{s['samples']} samples of objects; p-values from its standard error",
        "tests": "McNemar's for clustered pairs; Holm's correction is over all policies and thresholds of a measure",
        "pictures": store.path.name if store is not None else why_not,
    }


def origin(p: Predictions, settings: Mapping[str, Any]) -> dict[str, str]:
    """From which predictions and models a page was made, and of which objects."""
    splits = zip(*np.unique(p.splits, return_counts=True), strict=True)
    conflicting = [name for name, twice in zip(p.names, p.conflicting, strict=True) if twice]
    return {
        "predictions": f"{settings['predictions']}, SHA-256 {settings['predictions_sha256']}",
        **{f"model: {kind}": f"{name}, SHA-256 {sha}" for kind, (name, sha) in p.models.items()},
        "splits": ", ".join(f"{n} {name or 'unnamed'}" for name, n in splits),
        "the same mesh under another label": ", ".join(conflicting) or "none",
    }
