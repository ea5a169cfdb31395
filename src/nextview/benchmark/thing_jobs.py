"""One episode of the benchmark of things, and the policies that are replayed in it.

Workers import this module, and so neither pandas nor matplotlib.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from zlib import crc32

import numpy as np

from nextview.benchmark.own_things import OwnThings, own_things
from nextview.benchmark.thing_episodes import Setting, ThingEpisode
from nextview.benchmark.thing_policies import CEILINGS, policies_of
from nextview.benchmark.thing_replay import EpisodeRuns, ThingRun, run
from nextview.errors import DatasetError, ResultsError, UsageError
from nextview.files import read_record, write_record
from nextview.geometry.mesh import UNITS, Mesh, load_mesh
from nextview.policies.base import Policy
from nextview.recognition.model_card import find_models
from nextview.things.memory import TaughtRecogniser
from nextview.things.surface import Surface
from nextview.things.taught import TaughtThings

SCAN_APART = 0.2  # radii that a scan and what was taught of it may lie apart


@dataclass(frozen=True)
class ThingJob:
    """One episode, and the policies that are replayed in it.

    Attributes:
        models: name or folder of the memory.
        scan: file of the thing.
        unit: of its length.
        thing: number of the thing.
        draw: number of the draw.
        setting: how it is shown.
        views: how many each policy takes.
        repeats: runs of the policy random.
        policies: names.
        out: folder of the results.
        recogniser: MODULE:NAME of your own in the place of the memory; None for the memory.
    """

    models: str
    scan: Path
    unit: str
    thing: int
    draw: int
    setting: Setting
    views: int
    repeats: int
    policies: tuple[str, ...]
    out: Path
    recogniser: str | None = None

    @property
    def things(self) -> TaughtThings | OwnThings:
        """What may be believed."""
        return things_of(self.models, self.recogniser)

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.thing:04d}_{self.draw:02d}"

    @property
    def scan_name(self) -> str:
        """Of the thing."""
        return self.scan.stem

    @property
    def runs_file(self) -> Path:
        """Where its runs are written."""
        return self.out / "runs" / f"{self.name}.json"


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
    things = job.things
    chosen = policies_of(job.policies, things)
    folder = job.out / "episodes" / job.name
    episode = ThingEpisode(
        things,
        partial(scan_of, things, job.thing, job.scan, job.unit),
        job.thing,
        job.draw,
        job.setting,
        folder,
    )
    runs: dict[str, list[ThingRun]] = {}
    if job.runs_file.exists():
        runs |= read_record(job.runs_file, EpisodeRuns, "runs", ResultsError).runs
    # The ceiling verifies what others need, too.
    for name in sorted(job.policies, key=lambda name: name not in CEILINGS):
        runs[name] = replayed(episode, name, chosen[name], job)
    episode.save()
    job.runs_file.parent.mkdir(parents=True, exist_ok=True)
    done = EpisodeRuns(things.names[job.thing], job.draw, runs)
    write_record(job.runs_file, done, overwrite=True)


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
        (job.setting.seed, job.thing, job.draw, crc32(name.encode()))
    )
    times = job.repeats if name == "random" else 1
    return [run(episode, make(episode), job.views, rng) for _ in range(times)]
