"""A simulated arm recognises objects on a table: how long does it move until it is right?

    python -m research.simulated_arm DATASET/ModelNet10 episodes.jsonl [--objects 50] [--runs 1]

Test objects of 10 cm radius stand on a table, turned at random; the camera on the wrist is a
simulated stereo camera (``cameras.sensors``, "stereo"), 0.4 m away. Each policy starts from the
same places with the same errors, and goes only where the arm can: joints are found by inverse
kinematics, nothing is touched, and a way of at most two straight lines in joint space leads there.
What moves cost is seconds at the joints' velocity limits. Episodes are appended to the file; the
same command goes on where it was stopped, and prints the table at the end.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import nextview
from benchmarks.shared import read_lines
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.geometry.viewsphere import Viewpoints
from nextview.policies.base import EpisodeState, travel_from
from nextview.sensing import ObservedObject
from research.arm import Arm, first_joints, put_down

DISTANCE = 0.4
"""Of the camera from the object, metres."""
HORIZON = 10.0
"""Seconds of motion that an episode counts which does not end right; the longest one is printed
with the table.
"""
POLICIES = ("gain", "gain, in cells", "nearest", "random")


@dataclass(frozen=True)
class Nearest:
    """The view to which the arm comes soonest."""

    sphere: Viewpoints
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> np.ndarray:
        """See ``Policy.next_views``."""
        return np.where(state.free, travel_from(self.sphere, state), np.inf).argmin(1)


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        episodes: file to which episodes are appended.
        models: bundled models by name, or a folder with models of your own and their policy gain.
        objects: so many of the test split, spread over it.
        runs: first views of each, from directions drawn from those in reach.
        radius: of the objects, metres.
        seed: decides where objects and arm are, the sensor's errors and what random draws.
    """

    dataset: tyro.conf.Positional[Path]
    episodes: tyro.conf.Positional[Path]
    models: str = "modelnet10"
    objects: int = 50
    runs: int = 1
    radius: float = 0.1
    seed: int = 0


def systems(models: str) -> dict[str, nextview.System]:
    """By policy."""
    gain = nextview.load(models, policy="gain", threads=1)
    made = {
        "gain": gain,
        "gain, in cells": gain,
        "random": nextview.load(models, policy="random-all", threads=1),
    }
    return made | {
        "nearest": replace(gain, policy=Nearest(gain.sphere), policy_name="nearest")
    }


def begin(mesh: nextview.Mesh, settings: Settings, which: tuple[int, int]) -> Arm:
    """The arm at a first view of an object: a direction that is drawn until one can be reached."""
    rng = np.random.default_rng([settings.seed, *which])
    arm = Arm([put_down(mesh, rng, settings.radius)], rng)
    joints = None
    while joints is None:
        joints = first_joints(
            arm,
            np.radians(rng.uniform(10, 60)),
            rng.uniform(0, 2 * np.pi),
            DISTANCE,
        )
    arm.joints = joints
    return arm


def episode(
    arm: Arm,
    system: nextview.System,
    name: str,
    label: str,
    seed: int,
) -> dict[str, Any]:
    """One episode: after each view the seconds moved so far, and whether the class believed most
    is right.
    """
    session = system.session(
        object=ObservedObject(life_size=False),
        distance=DISTANCE,
        seed=seed,
    )
    right = []
    moved = []

    def looked() -> None:
        right.append(
            session.models.classes[int(session.views[-1].belief.argmax())] == label
        )
        moved.append(arm.seconds)

    result = arm.run(session, looked, costs=name != "gain, in cells")
    # the first view after which it stays right
    kept = len(right) - right[::-1].index(False) if False in right else 0
    until = moved[kept] if kept < len(right) else HORIZON
    return {
        "right": right[-1],
        "confident": result.confident,
        "views": len(right),
        "moved": moved[-1],
        "until": until,
        "refused": arm.refused,
    }


def run(
    settings: Settings,
    done: dict[tuple[str, int, str], dict[str, Any]],
) -> Iterator[int]:
    """Append what is missing; yields how many episodes are done."""
    entries = [
        entry for entry in list_dataset(settings.dataset) if entry.split == "test"
    ]
    entries = entries[:: len(entries) // settings.objects][: settings.objects]
    by_policy = systems(settings.models)
    count = 0
    with settings.episodes.open("a", buffering=1) as file:
        for start in range(settings.runs):
            for i, entry in enumerate(entries):
                asked = [(entry.path.stem, start, name) for name in POLICIES]
                ended = next(
                    (done[each] for each in asked if each in done),
                    {"views": 0},
                )
                for name in (
                    each
                    for *_, each in asked
                    if (entry.path.stem, start, each) not in done
                ):
                    # the first view is the same for all, and no policy chose it
                    if ended["views"] != 1:
                        arm = begin(
                            nextview.load_mesh(entry.path),
                            settings,
                            (i, start),
                        )
                        ended = episode(
                            arm,
                            by_policy[name],
                            name,
                            entry.label,
                            settings.seed + start,
                        )
                    row = {
                        "object": entry.path.stem,
                        "start": start,
                        **ended,
                        "policy": name,
                    }
                    file.write(json.dumps(row) + "\n")
                count += len(POLICIES)
                yield count


def table(rows: list[dict[str, Any]], samples: int = 2000) -> Iterator[str]:
    """Means and 95 % intervals of a bootstrap over objects, and the difference to gain on the
    same starts.
    """
    objects = sorted({row["object"] for row in rows})
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(objects), size=(samples, len(objects)))

    def of(policy: str, what: str) -> np.ndarray:
        """The mean of each object, (objects,)."""
        return np.array(
            [
                np.mean(
                    [
                        r[what]
                        for r in rows
                        if r["policy"] == policy and r["object"] == name
                    ]
                )
                for name in objects
            ]
        )

    def shown(values: np.ndarray, digits: int) -> str:
        low, high = np.percentile(values[drawn].mean(1), [2.5, 97.5])
        return f"{values.mean():.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"

    yield "| policy | right | views | seconds of motion | until right | until right, less gain's |"
    yield "|---|---|---|---|---|---|"
    for policy in POLICIES:
        less = (
            ""
            if policy == "gain"
            else shown(of(policy, "until") - of("gain", "until"), 2)
        )
        cells = [
            shown(of(policy, "right"), 3),
            shown(of(policy, "views"), 2),
            shown(of(policy, "moved"), 2),
        ]
        yield f"| {policy} | {' | '.join(cells)} | {shown(of(policy, 'until'), 2)} | {less} |"


def main(settings: Settings) -> None:
    """Run the episodes that the file lacks, and print the table."""
    rows = read_lines(settings.episodes)
    done = {(row["object"], row["start"], row["policy"]): row for row in rows}
    track(
        run(settings, done),
        settings.objects * settings.runs * len(POLICIES),
        "recognising",
    )
    rows = [
        row for row in read_lines(settings.episodes) if row["start"] < settings.runs
    ]
    print("\n".join(table(rows)))
    longest = max(row["moved"] for row in rows)
    moves = sum(row["views"] - 1 for row in rows)
    print(
        f"{len(rows)} episodes; {moves} moves, the longest episode {longest:.1f} s; settings"
        f" {asdict(settings)}"
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        main(tyro.cli(Settings))
