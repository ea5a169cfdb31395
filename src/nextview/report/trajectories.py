"""Episodes to step through in the 3D viewer, as JSON: where each policy went, and what was believed after each view."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from nextview.benchmark.entries import EpisodeSpecs
from nextview.benchmark.published import COLUMNS
from nextview.benchmark.replay import replay, truncate
from nextview.benchmark.results import Results
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.data.world_views import world_views
from nextview.errors import DatasetError, ResultsError
from nextview.measures.depth_entropy import normalise_per_object
from nextview.measures.map_names import LEM
from nextview.shading import headlight

CLOUD = 1500
"""Points of an object in the viewer."""
PICTURE = 112
"""Side of a view's picture, pixels."""
THESIS = ("table_0444", 13)
"""Object and first view of the thesis's figures 16, 17 and 29 to 31."""


@dataclass(frozen=True)
class Pictures:
    """What the objects look like, from the store they were rendered into.

    Attributes:
        store: None if there are no pictures.
        why_not: a sentence that says why there are none; empty if there are.
    """

    store: ViewStore | None
    why_not: str = ""

    @classmethod
    def of(cls, predictions: Predictions, store: Path | None = None) -> Pictures:
        """Pictures of the objects of some predictions.

        Args:
            predictions: they name the store that they were made from, and hold the depth-entropy of each of its views,
                by which it is known again.
            store: take this one instead, as it is.

        Raises:
            DatasetError: the store that was given cannot be read.
            ResultsError: it holds none of the objects, or other views of them.
        """
        if store is not None:
            given = ViewStore.open(store)
            if given.sphere != predictions.sphere or not set(given.names) & set(predictions.names):
                raise ResultsError(f"{store}: holds no views of these objects from these viewpoints")
            return cls(given)
        remedy = "give it with --store"
        if not predictions.store:
            return cls(None, f"No pictures: the predictions do not name the view store they were made from; {remedy}.")
        try:
            named = ViewStore.open(predictions.store)
            row = {name: i for i, name in enumerate(named.names)}
            rows = [row.get(name, -1) for name in predictions.names]
            same = named.sphere == predictions.sphere and -1 not in rows
            same = same and np.array_equal(named.measure()[rows], predictions.depth_entropy)
        except DatasetError:
            return cls(None, f"No pictures: there is no view store at {predictions.store} any more; {remedy}.")
        if not same:
            return cls(None, f"No pictures: the view store {predictions.store} has changed since; {remedy}.")
        return cls(named)

    def row(self, name: str) -> int | None:
        """Where an object is in the store."""
        if self.store is None or name not in self.store.names:
            return None
        return self.store.names.index(name)

    def cloud(self, name: str) -> str | None:
        """Points of all views together, (CLOUD, 3) int8 in 1/127 radii, base64."""
        row = self.row(name)
        if row is None or self.store is None:
            return None
        points = self.store.points(row).reshape(-1, 3)
        points = points[np.random.default_rng(0).choice(len(points), CLOUD, replace=False)]
        return base64.b64encode(np.rint(127 * points.clip(-1, 1)).astype(np.int8).tobytes()).decode()

    def views(self, name: str, views: list[int]) -> dict[int, str]:
        """Shaded images of some views, as data URIs."""
        row = self.row(name)
        if row is None or self.store is None:
            return {}
        images = self.store.image(row) if "scene" not in self.store.group.attrs else _scenes(self.store, row)
        return {view: _data_uri(images[view]) for view in views}


OWNERS = np.array([[255, 255, 255], [11, 95, 165], [209, 73, 91], [225, 225, 225]])
"""Colours of nothing, the target, other things and the table."""


def _scenes(store: ViewStore, row: int) -> NDArray[np.uint8]:
    """A world as it looks from all views, the target told from all else by its colour, (V, S, S, 3) uint8."""
    world = world_views(store, row)
    shade = np.stack([headlight(depth, world.intrinsics) for depth in world.depth])[..., None] / 255
    return np.where(world.owner[..., None] > 0, OWNERS[world.owner] * (0.35 + 0.65 * shade), 255).astype(np.uint8)


def _data_uri(image: NDArray[np.uint8]) -> str:
    file = BytesIO()
    Image.fromarray(image).resize((PICTURE, PICTURE), Image.Resampling.LANCZOS).save(file, "WEBP", quality=70)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


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
        "pictures": pictures.views(name, seen),
        "episodes": [_episode(results, i, policy, views) for policy, views in paths.items()],
    }


def _episode(results: Results, i: int, policy: str, views: list[int]) -> dict[str, Any]:
    p = results.predictions
    log_evidence = p.log_evidence[i, views].astype(np.float64).cumsum(0)
    beliefs = p.calibration.belief(log_evidence, np.arange(1, len(views) + 1), len(p.classes))
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
