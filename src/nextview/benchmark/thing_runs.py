"""What policies make of one episode of the benchmark of things, and the job that replays them.

Workers import this module, and so neither pandas nor matplotlib.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from zlib import crc32

import msgspec
import numpy as np

from nextview.benchmark.jobs import Job
from nextview.benchmark.own_things import OwnThings, own_things
from nextview.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    Occlusion,
    Setting,
    ThingEpisode,
)
from nextview.benchmark.thing_policies import (
    BEST_BLIND,
    CEILINGS,
    THING_POLICIES,
    policies_of,
)
from nextview.checks import number, whole
from nextview.errors import DatasetError, PolicyError, UsageError
from nextview.geometry.mesh import UNITS, Mesh, load_mesh
from nextview.policies.base import Policy
from nextview.recognition.model_card import find_models
from nextview.simulation.sensor import sensor_named
from nextview.things.memory import TaughtRecogniser
from nextview.things.surface import Surface
from nextview.things.taught import TaughtThings

SCAN_APART = 0.2  # radii that a scan and what was taught of it may lie apart


class ThingRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one policy made of one episode.

    Attributes:
        views: that it took.
        right: whether the thing is named right after each.
        confidence: belief in the answer after each.
        p_value: share of known things that are explained as badly after each; None where that was
            not fitted.
        decision: seconds of CPU of each choice.
        verification: seconds of CPU of each verification.
        pose_error: mean distance of the surface (ADD-S), millimetres, after each; None where the
            thing is not named right.
    """

    views: list[int]
    right: list[bool]
    confidence: list[float]
    p_value: list[float | None]
    decision: list[float]
    verification: list[float]
    pose_error: list[float | None]


class EpisodeRuns(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What all policies made of one episode: each one run, "random" several.

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
    policy: Policy,
    count: int,
    rng: np.random.Generator,
) -> ThingRun:
    """Take some views as a policy says.

    Args:
        episode: the thing.
        policy: chooses all views but the first.
        count: how many views.
        rng: for policies that draw.

    Returns:
        What was believed after each.
    """
    views = [episode.start]
    made: dict[str, list[Any]] = {
        name: [] for name in ThingRun.__struct_fields__ if name != "views"
    }

    while True:
        found, seconds = episode.verified(views)
        made["right"].append(episode.named_right(views))
        made["confidence"].append(float(found.belief.max()))
        made["p_value"].append(episode.p_value(views))
        made["verification"].append(seconds)
        made["pose_error"].append(episode.pose_error(views))
        if len(views) == count:
            return ThingRun(views=views, **made)

        begun = time.process_time()
        # what is foreseen counts as its time
        state = episode.state(views, policy.needs)
        view = int(policy.next_views(state, rng)[0])
        made["decision"].append(time.process_time() - begun)
        if not state.free[0, view]:
            raise PolicyError(f"a policy chose the view {view}, which was taken before")
        views.append(view)


def policies_in(runs: Sequence[EpisodeRuns]) -> tuple[str, ...]:
    """The policies that all episodes were replayed with: the package's own first."""
    there = set.intersection(*(set(each.runs) for each in runs))
    own = sorted(there - set(THING_POLICIES))
    return (*(name for name in THING_POLICIES if name in there), *own)


@dataclass(frozen=True)
class ThingSettings:
    """Conditions, policies and statistics.

    Attributes:
        models: name or folder of the memory that knows the scans; by default they are taught first,
            into OUT/memory.
        sensor: simulated depth camera, NAME or NAME:STRENGTH, see nextview render --help.
        occlusion: "none" shows things alone, "half" and "heavy" among boxes that leave half and a
            third of them visible.
        draws: episodes per thing, each with another rotation and first view.
        views: numbers of views after which the policies are compared; episodes have the largest.
        policies: names, or MODULE:CLASS for your own; by default all that the recogniser
            allows. Only missing results are computed; your own policies always run again.
        reference: policy that the others are compared with; it always takes part. "best-blind" is
            the rule that ignores the images (random, spread, furthest, fixed or ring) and is best
            after the first view in other episodes of the same things.
        choose_seed: seed of these other episodes.
        recogniser: MODULE:NAME of your own in the place of the memory; its classes are the things,
            and nothing is taught. Policies that go by a memory's hypotheses do not take part.
        threshold: belief from which an answer counts as confident, unless the thing is explained
            worse than nine in ten known ones: then a session goes on, too.
        repeats: runs of the policy random in each episode.
        unit: unit of length of the scan files.
        families: things whose names are equal up to the first _, such as variants of one scan,
            count as one in intervals and p-values.
        samples: number of bootstrap samples.
        seed: seed of rotations, boxes, first views, noise and random policies.
    """

    models: str | None = None
    sensor: str = "wrist"
    occlusion: Occlusion = "none"
    draws: int = 1
    views: tuple[int, ...] = (1, 2, 3, 5)
    policies: tuple[str, ...] = ()
    reference: str = "random"
    choose_seed: int = 1
    recogniser: str | None = None
    threshold: float = 0.97
    repeats: int = 2
    unit: str = "m"
    families: bool = False
    samples: int = 10_000
    seed: int = 0

    def check(self) -> None:
        """See that it makes sense, before any work is done.

        Raises:
            UsageError: a number, a unit or a sensor that there is none of.
        """
        for value, what in ((self.draws, "draws"), (self.repeats, "repeats")):
            whole(value, f"the number of {what}", 1)
        whole(self.samples, "the samples of the bootstrap", 100)

        if not self.views or list(self.views) != sorted(set(self.views)):
            raise UsageError("the numbers of views ascend, as in --views 1 2 3 5")
        whole(self.views[0], "a number of views", 1, len(EPISODE_SPHERE))
        whole(self.views[-1], "a number of views", 2, len(EPISODE_SPHERE))

        if number(self.threshold, "the threshold", 0) >= 1:
            raise UsageError(f"a threshold is below 1, not {self.threshold}")
        if self.unit not in UNITS:
            raise UsageError(f"the unit is {', '.join(UNITS)}, not {self.unit}")

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
    """One episode, and the policies that are replayed in it.

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


@lru_cache(maxsize=1)
def opened(models: str) -> TaughtThings:
    """The things of a memory whose geometry is known.

    Raises:
        UsageError: it knows the geometry of none.
    """
    recogniser = TaughtRecogniser(find_models(models).recogniser, threads=1)
    things = TaughtThings.of(recogniser)
    if things is None:
        raise UsageError(
            f"{models}: knows the geometry of no thing; teach it with --unit"
        )
    return things


def things_of(models: str, recogniser: str | None) -> TaughtThings | OwnThings:
    """The things of a recogniser of your own, or else of a memory.

    Args:
        models: folder or name of the memory.
        recogniser: MODULE:NAME of your own; None for the memory.
    """
    return opened(models) if recogniser is None else own_things(recogniser)


def work(job: ThingJob) -> None:
    """Replay the policies of a job, and write down what they made of it."""
    how: ThingSettings = job.settings
    things = things_of(job.models, how.recogniser)
    chosen = policies_of(job.policies, things)
    episode = ThingEpisode(
        things,
        partial(scan_of, things, job.thing, job.scan, how.unit),
        job.thing,
        job.draw,
        Setting(how.sensor, how.occlusion, how.seed),
        job.out / "episodes" / job.name,
    )
    before = job.earlier(EpisodeRuns)
    runs: dict[str, list[ThingRun]] = {} if before is None else before.runs
    # The ceiling verifies what others need, too.
    for name in sorted(job.policies, key=lambda name: name not in CEILINGS):
        runs[name] = replayed(episode, name, chosen[name], job)
    episode.save()
    job.write(EpisodeRuns(things.names[job.thing], job.draw, runs))


def scan_of(
    things: TaughtThings | OwnThings,
    thing: int,
    file: Path,
    unit: str,
) -> Mesh:
    """The scan of a thing; of a taught one only if it is what was taught.

    Args:
        things: that are known.
        thing: its number among them.
        file: the scan.
        unit: of its lengths.

    Raises:
        DatasetError: it lies elsewhere than the surface that was taught, so that its size or its
            pose would be those of another thing.
    """
    mesh = load_mesh(file, unit=unit)
    if isinstance(things, OwnThings):
        return mesh
    surface = things.verifier.caster.surfaces[thing]
    if _apart(mesh, surface) <= SCAN_APART:
        return mesh

    for other in UNITS:
        if _apart(load_mesh(file, unit=other), surface) <= SCAN_APART:
            raise DatasetError(
                f"{file}: is not in {unit}, by what was taught of it; give --unit {other}"
                f" (unit={other!r})"
            )
    raise DatasetError(
        f"{file}: is not the scan that {surface.name} was taught from: it lies elsewhere, or is of"
        f" another size; its radius is {mesh.radius:.3g} m, and {surface.radius:.3g} m was taught"
    )


def _apart(mesh: Mesh, surface: Surface) -> float:
    """How far the corners of two bounding boxes are apart, radii of the surface."""
    ours = mesh.vertices * mesh.radius + mesh.centre
    boxes = [np.stack([one.min(0), one.max(0)]) for one in (ours, surface.vertices)]
    return float(np.abs(boxes[0] - boxes[1]).max() / surface.radius)


def replayed(
    episode: ThingEpisode,
    name: str,
    make: Callable[[ThingEpisode], Policy],
    job: ThingJob,
) -> list[ThingRun]:
    """The runs of one policy in one episode.

    Args:
        episode: what is sensed and verified.
        name: of the policy.
        make: the policy for an episode.
        job: starts, views and rules of all episodes.
    """
    rng = np.random.default_rng(
        (job.settings.seed, job.thing, job.draw, crc32(name.encode()))
    )
    times = job.settings.repeats if name == "random" else 1
    views = job.settings.views[-1]
    return [run(episode, make(episode), views, rng) for _ in range(times)]
