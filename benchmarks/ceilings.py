"""How far any policy could get with these predictions: what no choice of views repairs, and what knowledge would buy.

    python benchmarks/ceilings.py TEST.npz TRAINING.npz [VALIDATION_SHARE]

prints a section in Markdown. TRAINING.npz are predictions of the training split; what is learned is learned from its
validation objects (VALIDATION_SHARE as for nextview fit). All numbers are shares of right answers over the objects of
TEST.npz and all first views, in brackets 95 % bootstrap intervals over objects; looks are fused by summing
logits, without what the recogniser says of the azimuth bins.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.entries import EpisodeSpecs
from nextview.benchmark.replay import replay
from nextview.benchmark.statistics import interval, resample
from nextview.calibration.fitting_set import FittingSet, fitting_set
from nextview.calibration.policy_tables import greedy_path
from nextview.cli.progress import track
from nextview.data.predictions import Predictions
from nextview.policies.learned_tables import cells_from
from nextview.viewsphere import ViewSphere

VIEW_COUNTS = 5


def leads(p: Predictions) -> NDArray[np.float64]:
    """Logit of the true class minus that of every other one, (N, V, C - 1)."""
    others = np.stack([np.delete(np.arange(len(p.classes)), label) for label in p.labels])
    of_truth = np.take_along_axis(p.logits, p.labels[:, None, None], 2)
    return (of_truth - np.take_along_axis(p.logits, others[:, None], 2)).astype(np.float64)


def any_sets(sphere: ViewSphere, start: int, n_views: int) -> NDArray[np.int64]:
    """All sets of so many views with the start among them, (S, looks)."""
    others = np.delete(np.arange(len(sphere)), start)
    sets = np.array(list(combinations(others, n_views - 1)), np.int64)
    return np.insert(sets, 0, start, axis=1)


def local_sets(sphere: ViewSphere, start: int, n_views: int) -> NDArray[np.int64]:
    """The sets of views of all paths from the start that stay in the local window at each step, (S, looks)."""
    paths = np.array([[start]])
    for _ in range(n_views - 1):
        steps = sphere.windows[paths[:, -1]].reshape(len(paths), -1)
        longer = np.hstack([np.repeat(paths, steps.shape[1], axis=0), steps.reshape(-1, 1)])
        paths = longer[~(longer[:, :-1] == longer[:, -1:]).any(1)]
    return np.unique(np.sort(paths, axis=1), axis=0)


def solvable(p: Predictions, sets: Callable[[ViewSphere, int, int], NDArray[np.int64]]) -> NDArray[np.int64]:
    """Views after which the right answer can be had at the earliest, by any choice of views, (N, V) by first view.

    Exact: every set of up to LOOKS views is tried. LOOKS + 1 where none will do.
    """
    lead = leads(p)
    found = np.full((len(p), len(p.sphere)), VIEW_COUNTS + 1)

    def tried():
        for start in range(len(p.sphere)):
            for n_views in range(1, VIEW_COUNTS + 1):
                left = np.flatnonzero(found[:, start] > VIEW_COUNTS)
                candidates = sets(p.sphere, start, n_views) if len(left) else np.zeros((0, n_views), np.int64)
                for i in left:
                    total = np.zeros((len(candidates), lead.shape[2]))
                    for views in candidates.T:
                        total += lead[i, views]
                    if (total.min(1) > 0).any():
                        found[i, start] = n_views
            yield start + 1

    track(tried(), len(p.sphere), sets.__name__.replace("_", " "))
    return found


def right_along(p: Predictions, paths: NDArray[np.int64]) -> NDArray[np.float64]:
    """Share of right answers after each view, (N, LOOKS), for views (N, V, LOOKS) or (V, LOOKS) by first view."""
    paths = np.broadcast_to(paths, (len(p), *paths.shape[-2:]))
    rows = np.arange(len(p))[:, None]
    total, right = np.zeros((len(p), len(p.sphere), len(p.classes))), []
    for k in range(VIEW_COUNTS):
        total += p.logits[rows, paths[..., k]]
        right.append((total.argmax(2) == p.labels[:, None]).mean(1))
    return np.stack(right, 1)


def learned_paths(data: FittingSet, p: Predictions, by_class: bool, by_pose: bool) -> NDArray[np.int64]:
    """Greedily best paths from each first view, (N, V, LOOKS), for a robot that knows the log-evidence of it.

    Args:
        data: from which is learned.
        p: whose objects are looked at.
        by_class: it knows the true class.
        by_pose: it knows the object's azimuth; otherwise only the ring that it is on.
    """
    sphere, n = data.sphere, data.sphere.azimuths
    paths = np.zeros((len(data.classes), len(sphere), VIEW_COUNTS), np.int64)
    for label in range(len(data.classes)) if by_class else [0]:
        mine = data.labels == label if by_class else np.ones(len(data), bool)
        known = replace(data, logits=data.logits[mine], labels=data.labels[mine])
        for ring in range(sphere.rings):
            on_it = ring * n + np.arange(n)
            for starts in on_it[:, None] if by_pose else [on_it]:
                cells = greedy_path(known, starts, True, VIEW_COUNTS - 1, p.calibration)
                paths[label, starts] = cells_from(sphere)[starts[:, None], cells]
    return paths[p.labels] if by_class else np.broadcast_to(paths[0], (len(p), *paths.shape[1:]))


def section(test: Path, training: Path, validation: float = 0.1, samples: int = 2000) -> str:
    p = replace(Predictions.load(test), azimuth_bins=None)
    data = replace(fitting_set(Predictions.load(training), validation, 0), azimuth_bins=None)
    weights = resample(len(p), samples, np.random.default_rng(0)) / len(p)

    def number(of_objects: NDArray) -> str:
        low, high = interval((weights @ of_objects)[:, None])
        return f"{of_objects.mean():.3f} ({low[0]:.3f}-{high[0]:.3f})"

    v = len(p.sphere)
    specs = EpisodeSpecs(p, np.repeat(np.arange(len(p)), v), np.tile(np.arange(v), len(p)), ())

    def replayed(name: str) -> NDArray[np.float64]:
        right = replay(name, specs, VIEW_COUNTS, 0).answers == specs.labels[:, None]
        return right.reshape(len(p), v, VIEW_COUNTS).mean(1)

    rows = {
        "random in the window": replayed("random"),
        "random over the sphere": replayed("random-all"),
    }
    for what, by_class, by_pose in [
        ("learned path: knows the ring", False, False),
        ("learned path: knows the object's azimuth too", False, True),
        ("learned path: knows the true class too", True, False),
        ("learned path: knows both", True, True),
    ]:
        rows[what] = right_along(p, learned_paths(data, p, by_class, by_pose))
    rows["sees all views, one step ahead, in the window"] = replayed("oracle-gain")
    rows["sees all views, one step ahead, over the sphere"] = replayed("oracle-gain-all")
    for what, sets in [
        ("any path in the window, exact bound", local_sets),
        ("any views of the sphere, exact bound", any_sets),
    ]:
        found = solvable(p, sets)
        rows[what] = np.stack([(found <= k).mean(1) for k in range(1, VIEW_COUNTS + 1)], 1)
    alone = (p.logits.argmax(2) == p.labels[:, None]).mean(1)
    fused = p.logits.sum(1).argmax(1) == p.labels
    wrong_after_all = [p.classes[label] for label in p.labels[~fused]]
    by_class = {name: wrong_after_all.count(name) for name in p.classes if name in wrong_after_all}
    lines = [
        "## Ceilings",
        "",
        f"{len(p)} objects from every first view; learned from {len(data)} objects of the training split "
        f"({', '.join(name for name, _ in p.models.values())}). `python benchmarks/ceilings.py`.",
        "",
        "| choice of views | " + " | ".join(f"{k} look{'s' * (k > 1)}" for k in range(1, VIEW_COUNTS + 1)) + " |",
        "|---|" + "---|" * VIEW_COUNTS,
    ]
    lines += [f"| {what} | " + " | ".join(number(x) for x in right.T) + " |" for what, right in rows.items()]
    window, step = rows["random in the window"], rows["sees all views, one step ahead, in the window"]
    lines += ["", "Share of the gap between random in the window and one step of foresight there:", ""]
    lines += ["| choice of views | 2 views | 3 views | 5 views |", "|---|---|---|---|"]
    for what, right in rows.items():
        if what.startswith(("learned", "random over")):
            share = [(right[:, k] - window[:, k]).mean() / (step[:, k] - window[:, k]).mean() for k in (1, 2, 4)]
            lines.append(f"| {what} | " + " | ".join(f"{x:.0%}" for x in share) + " |")
    lines += [
        "",
        f"- Right from every single view: {number(alone == 1)} of the objects; from none: {number(alone == 0)}; from "
        f"some: {number((alone > 0) & (alone < 1))}. Only the last have anything to gain from where one looks.",
        f"- All {v} views fused: {number(fused)}; wrong then: "
        + ", ".join(f"{name} {count}" for name, count in sorted(by_class.items(), key=lambda x: -x[1]))
        + ".",
        f"- Label noise: {int(p.conflicting.sum())} objects are the very mesh of another one with another label "
        f"({number(p.conflicting)}); without them all views fused reach {fused[~p.conflicting].mean():.3f}.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(section(Path(sys.argv[1]), Path(sys.argv[2]), *map(float, sys.argv[3:4])), end="")
