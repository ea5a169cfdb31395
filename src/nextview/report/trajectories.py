"""Episodes to step through in the 3D viewer, as JSON: where each policy went, and what was believed after each view."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from nextview.benchmark.entries import EpisodeSpecs
from nextview.benchmark.published import COLUMNS
from nextview.benchmark.replay import replay, truncate
from nextview.benchmark.results import Results
from nextview.measures.depth_entropy import normalise_per_object
from nextview.measures.map_names import LEM
from nextview.report.object_pictures import Pictures
from nextview.worlds import level_of

THESIS = ("table_0444", 13)
"""Object and first view of the thesis's figures 16, 17 and 29 to 31."""


def worst_failures(episodes: pd.DataFrame, most: int = 8) -> pd.DataFrame:
    """Objects that a policy gets wrong in the most runs, then with the most confidence: object, wrong, confidence, run.

    ``run`` is the run in which it was wrong with the most confidence.
    """
    wrong = episodes[episodes["answer"].astype(str) != episodes["label"].astype(str)]
    wrong = wrong.assign(object=wrong["object"].astype(str)).sort_values("confidence", ascending=False, kind="stable")
    groups = wrong.groupby("object", sort=False)
    table = groups.agg(wrong=("run", "size"), confidence=("confidence", "mean"), run=("run", "first")).reset_index()
    return table.sort_values(["wrong", "confidence"], ascending=False, kind="stable").head(most)


def gains(ours: pd.DataFrame, theirs: pd.DataFrame, most: int = 4) -> pd.DataFrame:
    """Objects that one policy gets right in more runs than another: object, gain, run (one that differs)."""
    right = [t["answer"].astype(str).to_numpy() == t["label"].astype(str).to_numpy() for t in (ours, theirs)]
    table = pd.DataFrame(
        {"object": ours["object"].astype(str), "run": ours["run"], "gain": right[0].astype(int) - right[1]}
    ).sort_values("gain", ascending=False, kind="stable")
    table = table.groupby("object", sort=False).agg(gain=("gain", "sum"), run=("run", "first")).reset_index()
    return table[table["gain"] > 0].sort_values("gain", ascending=False, kind="stable").head(most)


def trajectories(
    results: Results, policies: list[str], wanted: list[tuple[str, int, str]], threshold: float, pictures: Pictures
) -> dict[str, Any]:
    """All that the viewer shows.

    Args:
        results: of the benchmark.
        policies: to compare.
        wanted: object, run, and why it is shown.
        threshold: that stops the episodes.
        pictures: of the objects.
    """
    p = results.predictions
    row = {name: i for i, name in enumerate(p.names)}
    scenes = []
    if p.calibration.visibility is not None and any(map(level_of, p.names)) and pictures.store is None:
        wanted = []  # what was believed depends on what shows, and that is not known any more
    if THESIS[0] in row and len(p.sphere) == 40:
        scenes.append(
            _scene(results, *THESIS, "the thesis's figures 16, 17, 29-31", _thesis_paths(results, row), pictures)
        )
    taken = {policy: _views_taken(results.episodes(policy, threshold)) for policy in policies}
    for name, run, why in wanted:
        paths = {policy: views[name, run] for policy, views in taken.items()}
        scenes.append(_scene(results, name, paths[policies[0]][0], why, paths, pictures))
    return {
        "directions": p.sphere.directions.round(4).tolist(),
        "angles": [p.sphere.angles(v) for v in range(len(p.sphere))],
        "azimuths": p.sphere.azimuths,
        "classes": p.classes,
        "scenes": scenes,
    }


def _views_taken(episodes: pd.DataFrame) -> dict[tuple[str, int], list[int]]:
    keys = zip(episodes["object"].astype(str), episodes["run"].tolist(), strict=True)
    return {key: list(map(int, views)) for key, views in zip(keys, episodes["views"], strict=True)}


def _thesis_paths(results: Results, row: dict[str, int]) -> dict[str, list[int]]:
    p, seed = results.predictions, results.settings["seed"]
    valleys = tuple(p.classes.index(name) for name in results.settings["valley_classes"])
    specs = EpisodeSpecs(p, np.array([row[THESIS[0]]]), np.array([THESIS[1]]), valleys)
    names = [name for name in (*COLUMNS, LEM) if name in set(results.tables.sweep["policy"])]
    paths = {}
    for name in names:
        path = replay(name, specs, results.settings["max_views"], seed)
        paths[name] = path.views[0, : truncate(path, 0.99).n_views[0]].tolist()
    return paths


def _scene(
    results: Results, name: str, start: int, why: str, paths: dict[str, list[int]], pictures: Pictures
) -> dict[str, Any]:
    p = results.predictions
    i = p.names.index(name)
    seen = sorted({view for views in paths.values() for view in views})
    return {
        "name": name,
        "label": int(p.labels[i]),
        "start": start,
        "why": why,
        "entropy": normalise_per_object(p.depth_entropy[i]).round(3).tolist(),
        "cloud": pictures.cloud(name),
        "world": pictures.world(name),
        "pictures": pictures.views(name, seen),
        "episodes": [_episode(results, i, policy, views, pictures) for policy, views in paths.items()],
    }


def _episode(results: Results, i: int, policy: str, views: list[int], pictures: Pictures) -> dict[str, Any]:
    """What was believed after each view, as ``nextview.episode`` adds it up."""
    p = results.predictions
    shown = None if p.calibration.visibility is None else pictures.shown(p.names[i], views)
    weights = p.seen[i, views] * np.asarray(p.calibration.weights(shown))
    total = (weights[:, None] * p.log_evidence[i, views].astype(np.float64)).cumsum(0)
    beliefs = p.calibration.belief(total, np.maximum(weights.cumsum(), 1), len(p.classes))
    top = [np.argsort(-belief, kind="stable")[:3] for belief in beliefs]
    travel = [0.0, *np.cumsum(p.sphere.travel[views[:-1], views[1:]])]
    return {
        "policy": policy,
        "views": views,
        "travel": [round(float(t), 2) for t in travel],
        "beliefs": [
            [[int(c), round(float(belief[c]), 4)] for c in best] for belief, best in zip(beliefs, top, strict=True)
        ],
    }
