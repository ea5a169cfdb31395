"""What the camera poses of frozen episodes tell of the thing, without an image.

    python -m benchmarks.poses_alone YCB --seeds 1 2 3 4
    python -m benchmarks.poses_alone ARCHIVE --answer

The first draws the episodes of all scans in all places, without images, and names each half of them
by what was learned from the other half: by the nearest neighbour, along each single feature and
along all of them, and by a linear classifier. What is told of an episode is the same as in an
archive: it is drawn before the scene (``benchmarks.frozen.draw_views``).

The second is a method for ``nextview-lab submit --command``. It names what it sees by the nearest
of all other episodes of ARCHIVE, whose truth it reads, and opens no image.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.stats import binom

from benchmarks.frozen import (
    FROZEN_PLACES,
    STEPS_PER_METRE,
    FrozenTerms,
    draw_views,
    episode_rng,
)
from benchmarks.shared import names_to_stage
from benchmarks.staged_things import CAMERA_MATRIX, Float
from nextview_lab.benchmark.frozen import FrozenArchive, FrozenEpisode, as_matrix
from nextview_lab.benchmark.methods import aimed_at

RIDGE = 1.0  # penalty of the linear classifier, in units of standardised features
LIKELY = 0.001  # chance of as many right names without any information

Names = NDArray[np.str_]
Learner = Callable[[Float, Names, Float], Names]


class Attack(NamedTuple):
    """How often a way to name things by their cameras is right.

    Attributes:
        way: what it uses.
        right: number of episodes whose name is right.
        episodes: number of episodes.
        chance: share that is right without any information.
        p: probability of as many right names by chance.
    """

    way: str
    right: int
    episodes: int
    chance: float
    p: float

    def __str__(self) -> str:
        share = self.right / self.episodes
        return (
            f"{self.way}: {self.right} of {self.episodes}, {share:.4f}"
            f" (chance {self.chance:.4f}, p {self.p:.2g})"
        )


def features_of(episode: FrozenEpisode) -> dict[str, float]:
    """What can be measured of an episode without opening an image, by names."""
    poses = np.array(episode.poses)
    places = poses[:, :3, 3]
    ahead = poses[:, :3, 2]
    crossing = aimed_at(poses)
    away = places - crossing
    distances = np.linalg.norm(away, axis=1)
    misses = away - (away * ahead).sum(1, keepdims=True) * ahead
    off = np.linalg.norm(misses, axis=1)
    across = (misses * poses[:, :3, 0]).sum(1)
    down = (misses * poses[:, :3, 1]).sum(1)
    elevations = away[:, 2] / distances
    spreads = np.linalg.svd(places - places.mean(0), compute_uv=False)

    series = {
        "distance": distances,
        "height": places[:, 2],
        "height over the crossing": away[:, 2],
        "elevation": elevations,
        "axis off the crossing": off,
        "axis beside the crossing": across,
        "axis below the crossing": down,
        "tilt": ahead[:, 2],
    }
    found = {
        f"{name}, {what}": float(measure(values))
        for name, values in series.items()
        for what, measure in (
            ("mean", np.mean),
            ("least", np.min),
            ("greatest", np.max),
            ("deviation", np.std),
        )
    }
    found |= {
        f"{name}, first": values[episode.first] for name, values in series.items()
    }
    found |= {f"crossing, {axis}": crossing[axis] for axis in range(3)}
    found |= {f"extent, {axis}": np.ptp(places, axis=0)[axis] for axis in range(3)}
    found |= {f"spread, {axis}": spreads[axis] for axis in range(3)}
    found |= {
        "crossing off the axis": float(np.linalg.norm(crossing[:2])),
        "first view": episode.first,
        "views": len(poses),
        "held": episode.held,
        "unit": episode.metres_per_unit,
        "focal length": episode.intrinsics[0][0],
        "size of the file": len(msgspec.json.encode(episode)),
    }
    return found


def standardised(values: Float, like: Float) -> Float:
    """Features, (N, F), in units of the deviations of others, (M, F); constant ones are 0."""
    scale = like.std(0)
    return (values - like.mean(0)) / np.where(scale > 1e-12, scale, np.inf)


def nearest(known: Float, names: Names, asked: Float) -> Names:
    """Names of the nearest known features, (M, F), to those that are asked for, (N, F)."""
    squares = (known**2).sum(1) - 2 * asked @ known.T
    return names[squares.argmin(1)]


def linear(known: Float, names: Names, asked: Float) -> Names:
    """Names by a ridge regression of the features, (M, F), on the things."""
    things, rows = np.unique(names, return_inverse=True)
    ones = np.eye(len(things))[rows]
    gram = known.T @ known + RIDGE * np.eye(known.shape[1])
    weights = np.linalg.solve(gram, known.T @ (ones - ones.mean(0)))
    return things[(asked @ weights + ones.mean(0)).argmax(1)]


def attacked(
    episodes: Sequence[tuple[FrozenEpisode, str]], rng: np.random.Generator
) -> list[Attack]:
    """Name each half of some episodes by what is learned from the other half.

    Args:
        episodes: what a method is told, and what they show.
        rng: draws the halves.

    Returns:
        All attacks, those that are right most often first.
    """
    names = np.array([name for _, name in episodes])
    measured = [features_of(episode) for episode, _ in episodes]
    values = np.array([list(one.values()) for one in measured], float)
    every = np.arange(values.shape[1])
    ways: list[tuple[str, Learner, NDArray[np.int64]]] = [
        ("all features, linear", linear, every),
        ("all features, nearest", nearest, every),
    ]
    ways += [(name, nearest, every[[row]]) for row, name in enumerate(measured[0])]

    halves = np.array_split(rng.permutation(len(names)), 2)
    chance = 1 / len(np.unique(names))
    attacks = []
    for way, learner, columns in ways:
        right = 0
        for asked, known in (halves, halves[::-1]):
            given = values[np.ix_(known, columns)]
            found = learner(
                standardised(given, given),
                names[known],
                standardised(values[np.ix_(asked, columns)], given),
            )
            right += int((found == names[asked]).sum())
        p = float(binom.sf(right - 1, len(names), chance))
        attacks.append(Attack(way, right, len(names), chance, p))
    return sorted(attacks, key=lambda attack: attack.p)


def tell_something(attacks: Sequence[Attack]) -> list[Attack]:
    """Attacks that are right more often than chance, corrected for their number (Bonferroni)."""
    return [attack for attack in attacks if attack.p * len(attacks) < LIKELY]


def drawn_episodes(names: Sequence[str], seed: int) -> list[tuple[FrozenEpisode, str]]:
    """What is told of all things in all places, and what they are."""
    how = FrozenTerms()
    found = []
    for name in names:
        for place in FROZEN_PLACES:
            views = draw_views(place, how, episode_rng(seed, place, name))
            episode = FrozenEpisode(
                place == "held",
                views.first,
                1 / STEPS_PER_METRE,
                as_matrix(CAMERA_MATRIX),
                tuple(map(as_matrix, views.told)),
            )
            found.append((episode, name))
    return found


def episodes_of(archive: Path) -> dict[str, tuple[FrozenEpisode, str]]:
    """What is told of the open episodes of an archive, and what they show, by their numbers."""
    frozen = FrozenArchive(archive)
    return {
        number: (frozen.episode(number), truth.thing)
        for number, truth in frozen.truths().items()
    }


def answer_all(archive: Path) -> None:
    """Answer lines of ``nextview-lab submit`` by the nearest other episode of an archive."""
    known = episodes_of(archive)
    values = np.array(
        [list(features_of(episode).values()) for episode, _ in known.values()]
    )
    names = np.array([name for _, name in known.values()])
    for look in map(json.loads, sys.stdin):
        answer: dict[str, object] = {"confidence": 0.0, "confident": False}
        if look["step"] == 1:
            fields = FrozenEpisode.__struct_fields__
            told = {field: look[field] for field in fields if field in look}
            episode = msgspec.convert({**told, "first": look["view"]}, FrozenEpisode)
            others = np.array([number != look["episode"] for number in known])
            given = values[others]
            measured = np.array([list(features_of(episode).values())])
            asked = standardised(measured, given)
            (name,) = nearest(standardised(given, given), names[others], asked)
        answer["name"] = str(name)
        if look["free"]:
            answer["next"] = look["free"][0]
        print(json.dumps(answer), flush=True)


def main(
    folder: tyro.conf.Positional[Path],
    seeds: tuple[int, ...] = (1, 2, 3, 4),
    answer: bool = False,
) -> None:
    """Name things by the poses of the cameras alone.

    Args:
        folder: of the scans, NAME.ply; with --answer of an archive.
        seeds: of the draws, each with all things in all places.
        answer: answer the lines of nextview-lab submit.
    """
    if answer:
        answer_all(folder)
        return
    names = names_to_stage(folder)
    episodes = [pair for seed in seeds for pair in drawn_episodes(names, seed)]
    attacks = attacked(episodes, np.random.default_rng(0))
    for attack in attacks[:5]:
        print(attack)
    print(
        f"better than chance: {len(tell_something(attacks))} of {len(attacks)} attacks"
    )


if __name__ == "__main__":
    tyro.cli(main)
