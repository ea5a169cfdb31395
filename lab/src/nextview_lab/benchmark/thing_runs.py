"""Run policies in one episode of the benchmark of things.

Workers import this module, so it imports neither pandas nor matplotlib.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import msgspec
import numpy as np

from nextview.checks import number, one_of, plugin_errors, whole
from nextview.errors import DatasetError, PolicyError, UsageError
from nextview.geometry.mesh import UNITS, Mesh, load_mesh
from nextview.policies.base import EpisodeState, Policy
from nextview.simulation.sensor import sensor_named
from nextview_lab.benchmark.jobs import Job, Settings
from nextview_lab.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    KnownThings,
    Occlusion,
    Setting,
    ThingEpisode,
    things_of,
)
from nextview_lab.benchmark.thing_policies import (
    BEST_BLIND,
    CEILINGS,
    THING_POLICIES,
    policies_of,
)

SCAN_APART = 0.2  # radii, largest distance between a scan and the taught surface


class ThingRun(msgspec.Struct, frozen=True):
    """Results of one policy in one episode.

    Attributes:
        views: in order.
        right: whether the thing is named correctly after each view.
        confidence: belief in the answer after each view.
        p_value: share of known things that are explained as badly after each view; None if it was
            not fitted.
        decision: CPU time of each choice, seconds.
        pose_error: mean distance of the surface (ADD-S), millimetres, after each view; None if the
            thing is not named correctly.
    """

    views: list[int]
    right: list[bool]
    confidence: list[float]
    p_value: list[float | None]
    decision: list[float]
    pose_error: list[float | None]


class EpisodeRuns(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Results of all policies in one episode: one run each, several for "random".

    Attributes:
        thing: its name.
        draw: number of the draw.
        runs: by policy.
    """

    thing: str
    draw: int
    runs: dict[str, list[ThingRun]]


def run(
    episode: ThingEpisode,
    name: str,
    policy: Policy,
    count: int,
    rng: np.random.Generator,
) -> ThingRun:
    """Take some views with a policy.

    Args:
        episode: the thing.
        name: of the policy, for messages.
        policy: chooses all views but the first.
        count: number of views.
        rng: for random policies.

    Returns:
        The results after each view.

    Raises:
        PolicyError: the policy raises an error, or chooses no free view.
    """
    views = [episode.start]
    made: dict[str, list[Any]] = {
        name: [] for name in ThingRun.__struct_fields__ if name != "views"
    }

    while True:
        found = episode.verified(views)
        made["right"].append(episode.named_right(views))
        made["confidence"].append(float(found.belief.max()))
        made["p_value"].append(episode.p_value(views))
        made["pose_error"].append(episode.pose_error(views))
        if len(views) == count:
            return ThingRun(views=views, **made)

        begun = time.process_time()
        # the CPU time of a choice includes the prediction of views
        state = episode.state(views, policy.needs)
        view = _choice(name, policy, state, rng)
        made["decision"].append(time.process_time() - begun)
        views.append(view)


def _choice(
    name: str, policy: Policy, state: EpisodeState, rng: np.random.Generator
) -> int:
    """Return the view that a policy chooses in one episode; PolicyError if it is none."""
    with plugin_errors(lambda said: PolicyError(f"policy {name} raised {said}")):
        chosen = np.asarray(policy.next_views(state, rng))
    if chosen.shape != (1,) or not np.issubdtype(chosen.dtype, np.integer):
        raise PolicyError(
            f"policy {name} has to return one integer for each episode, in an array"
        )
    view = int(chosen[0])
    if not 0 <= view < state.free.shape[1]:
        raise PolicyError(
            f"policy {name} chose view {view}, which is not on the sphere"
        )
    if not state.free[0, view]:
        raise PolicyError(f"policy {name} chose view {view}, which was visited before")
    return view


def policies_in(runs: Sequence[EpisodeRuns]) -> tuple[str, ...]:
    """Return the policies that were run in all episodes, those of the package first."""
    there = set.intersection(*(set(each.runs) for each in runs))
    own = sorted(there - set(THING_POLICIES))
    return (*(name for name in THING_POLICIES if name in there), *own)


@dataclass(frozen=True)
class ThingSettings(Settings):
    """Conditions, policies and statistics.

    Attributes:
        models: name or folder of the memory that was taught the scans; by default they are taught
            first, into OUT/memory.
        sensor: simulated depth camera, NAME or NAME:STRENGTH (docs/your_camera.md).
        occlusion: "none" shows things alone, "half" and "heavy" among boxes that leave half and a
            third of them visible.
        draws: episodes per thing, each with another rotation and first view.
        reference: policy with which the others are compared; it is always included. best-blind is
            the rule that ignores the images (random, spread, furthest, fixed or ring) and is best
            after the first view in other episodes of the same things.
        choose_seed: seed of these other episodes.
        recogniser: MODULE:NAME of your own recogniser, which replaces the memory; its classes are
            the things, and nothing is taught. Policies that need the hypotheses of a memory are not
            included.
        threshold: belief from which an answer counts as confident, unless the thing is explained
            worse than nine in ten known ones; a session would continue in that case, too.
        repeats: runs of the policy random in each episode.
        unit: unit of length of the scan files.
        families: count things whose names are equal up to the first _, such as variants of one
            scan, as one in intervals and p-values.
    """

    models: str | None = None
    sensor: str = "wrist"
    occlusion: Occlusion = "none"
    draws: int = 1
    views: tuple[int, ...] = (1, 2, 3, 5)
    reference: str = "random"
    choose_seed: int = 1
    recogniser: str | None = None
    threshold: float = 0.97
    repeats: int = 2
    unit: str = "m"
    families: bool = False

    def check(self) -> None:
        """Check the settings before any work is done.

        Raises:
            UsageError: a number, a unit or a sensor is invalid.
        """
        for value, what in ((self.draws, "draws"), (self.repeats, "repeats")):
            whole(value, f"the number of {what}", 1)
        super().check()
        whole(self.views[-1], "a number of views", 2, len(EPISODE_SPHERE))

        if number(self.threshold, "the threshold", 0) >= 1:
            raise UsageError(f"a threshold is below 1, not {self.threshold}")
        one_of(self.unit, UNITS, "the unit")

        if self.reference == BEST_BLIND and self.choose_seed == self.seed:
            raise UsageError(
                "the best blind rule is chosen in other episodes than it is compared in: give"
                f" --choose-seed another value than --seed, {self.seed}"
            )
        if self.recogniser is not None and self.models is not None:
            raise UsageError("a recogniser of your own takes no --models")
        sensor_named(self.sensor)


@dataclass(frozen=True)
class ThingJob(Job):
    """One episode, and the policies to run in it.

    Attributes:
        models: name or folder of the memory.
        scan: file of the thing.
        thing: number of the thing.
        draw: number of the draw.
    """

    models: str
    scan: Path
    thing: int
    draw: int


def work(job: ThingJob) -> None:
    """Run the policies of a job, and write the results; PolicyError if one fails."""
    how: ThingSettings = job.settings
    things = things_of(job.models, how.recogniser)
    chosen = policies_of(job.policies, things)
    episode = ThingEpisode(
        things,
        scan_of(things, job.thing, job.scan, how.unit),
        job.thing,
        job.draw,
        Setting(how.sensor, how.occlusion, how.seed),
    )
    before = job.earlier(EpisodeRuns)
    runs: dict[str, list[ThingRun]] = {} if before is None else before.runs
    # The upper bound comes first, as it verifies views that the others use.
    for name in sorted(job.policies, key=lambda name: name not in CEILINGS):
        rng = np.random.default_rng(
            (how.seed, job.thing, job.draw, crc32(name.encode()))
        )
        times = how.repeats if name == "random" else 1
        try:
            runs[name] = [
                run(episode, name, chosen[name](episode), how.views[-1], rng)
                for _ in range(times)
            ]
        except PolicyError as error:
            raise PolicyError(f"{error} (object {things.names[job.thing]})") from error
    job.write(EpisodeRuns(things.names[job.thing], job.draw, runs))


def scan_of(
    things: KnownThings,
    thing: int,
    file: Path,
    unit: str,
) -> Mesh:
    """Load the scan of a thing, and check that it is the taught one.

    Args:
        things: known things.
        thing: its number among them.
        file: the scan.
        unit: of its lengths.

    Raises:
        DatasetError: its position or size differs from the taught surface, so that the poses would
            not be comparable.
    """
    mesh = load_mesh(file, unit=unit)
    surface = things.surface(thing)
    if surface is None:
        return mesh
    # corners of two bounding boxes
    ours = mesh.vertices * mesh.radius + mesh.centre
    boxes = [np.stack([one.min(0), one.max(0)]) for one in (ours, surface.vertices)]
    if np.abs(boxes[0] - boxes[1]).max() <= SCAN_APART * surface.radius:
        return mesh
    raise DatasetError(
        f"{file}: is not the scan that {surface.name} was taught from: it lies elsewhere, or is of"
        f" another size; its radius is {mesh.radius:.3g} m, and {surface.radius:.3g} m was taught."
        f" Is it in {unit}?"
    )
