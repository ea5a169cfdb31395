"""The next view of things of known geometry, replayed: policies on the same episodes.

    python benchmarks/next_views.py SCANS OUT [--models ycb] [--draws 0 1] [--boxes 0] [--views 3]

SCANS holds the scans of the things that the memory knows, in metres, by their names. Each draw
shows every thing once, at its true size, through the sensor, with an azimuth, a first view and
errors of the setup of its own. A view of an episode is the same whoever asks for it: its noise
belongs to it. Policies go on from the same first view. ``--boxes`` is the mean number of boxes
around the thing that hide parts of it.

| policy | goes to |
|---|---|
| random | any view, with equal chance; the mean of ``--repeats`` runs |
| spread | the view farthest from all others |
| furthest | the farthest view of the local window |
| picture | where the remembered pictures of the leading things differ most |
| geometry | where the leading hypotheses, rendered, tell most of the thing |
| pose | where they tell most of thing and pose |
| ceiling | where they tell most if the truth and its pose are known beforehand |

A policy of your own is MODULE:CLASS; it is given the viewpoints, and may need "joint" and
"outlook".

Every episode is a line of OUT/episodes.jsonl as soon as it is finished. A run that was stopped goes
on where it was, and one with more policies, or more draws, adds what is missing. The tables are
printed and written to OUT/tables.md: accuracy after each number of views; the views until the
belief reaches 0.97, the share that reaches it, and how much of this is wrong; travel on the sphere;
the time of a decision, and of the last verification.
Differences to random are tested by a paired bootstrap over things (with ``--pairs`` over bodies),
with Holm's correction over the policies and numbers of views.

Beforehand it is settled: on look-alikes the policy "geometry" shall be 5 points above random after
two views, p < .001. Draws from 100 on are for choosing how a view is valued, those below are for
reporting.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from zlib import crc32

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.progress import track
from scipy.spatial import cKDTree

from nextview.benchmark.statistics import bootstrap_p, holm, interval, resample
from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.observation import Observation
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import ViewSphere, rotation_z
from nextview.policies.base import EpisodeState, Policy, best_view
from nextview.policies.baselines import Furthest, RandomAll, Spread
from nextview.policies.discriminate import Discriminate
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.policies.registry import make_policy
from nextview.recognition.evidence import Evidence
from nextview.simulation.scene import boxes_around
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import sensor_named
from nextview.things.depth_view import depth_view
from nextview.things.expected_views import Outlook
from nextview.things.leading import Hypotheses
from nextview.things.memory import TaughtRecogniser
from nextview.things.registration import FINE, align, start
from nextview.things.surface import Surface
from nextview.things.taught import TaughtThings
from nextview.things.verifier import FINE_SIDE, Verified

Float = NDArray[np.float64]

SPHERE = ViewSphere.named("40")
NEAREST = 0.25  # metres between the camera and the surface, at least
USUAL = 0.45  # metres between the camera and the centre, at most
RADII_AWAY = 5.0
CONFIDENT = 0.97
SAMPLES = 10_000  # of the bootstrap
TRUTH_BELIEF = 0.01  # in the true pose, beside the hypotheses, for the ceiling
POLICIES = ("random", "spread", "furthest", "picture", "geometry", "pose", "ceiling")
POINTS = 500  # of a surface, for the error of a pose


@dataclass(frozen=True)
class Setting:
    """How things are shown.

    Attributes:
        sensor: name of the sensor.
        boxes: mean number of boxes around a thing.
    """

    sensor: str
    boxes: float


class Episode:
    """A thing that can be looked at from all viewpoints. What was computed once is kept."""

    def __init__(
        self, things: TaughtThings, mesh: Mesh, thing: int, draw: int, setting: Setting
    ) -> None:
        """Place the thing, its camera and what stands around it."""
        self.things = things
        self.thing = thing
        self._seed = (thing, draw)
        self._views: dict[int, Observation] = {}
        self._in_camera: dict[int, Float] = {}
        self._evidence: dict[int, NDArray[np.floating]] = {}
        self._verified: dict[frozenset[int], tuple[Verified, float]] = {}

        rng = np.random.default_rng(self._seed)
        turn = rotation_z(rng.uniform(0, 2 * np.pi))
        self._standing = rotated(mesh, turn)
        radius = self._standing.metres
        assert radius is not None
        distance = max(NEAREST + radius, min(USUAL, RADII_AWAY * radius))
        sensor = sensor_named(setting.sensor).draw(rng)
        self._sensor = replace(sensor, radius=radius, distance=distance)
        boxes = int(rng.poisson(setting.boxes)) if setting.boxes else 0
        self._around = boxes_around(self._standing.vertices, boxes, rng) if boxes else None

        in_truth = np.eye(4)
        in_truth[:3, :3] = turn
        in_truth[:3, 3] = -(turn @ mesh.centre + self._standing.centre)
        self._in_truth = in_truth
        frame = self._camera(0).object_frame
        to_object = np.eye(4)
        to_object[:3, :3] = frame.axes
        to_object[:3, 3] = -frame.axes @ frame.centre
        self.true_pose = to_object @ in_truth
        self.start = self._first_view(rng)

    def _camera(self, view: int) -> SensedCamera:
        """The camera, with the errors of the episode's setup and the noise of one view."""
        rng = np.random.default_rng((*self._seed, 7))
        camera = SensedCamera(self._standing, self._sensor, rng, around=self._around)
        rng.spawn(view)
        return camera

    def _first_view(self, rng: np.random.Generator) -> int:
        """A view that shows the thing."""
        for view in rng.permutation(len(SPHERE)):
            if self.observation(int(view)).seen:
                return int(view)
        raise UsageError("a thing shows from no viewpoint")

    def observation(self, view: int) -> Observation:
        """What one viewpoint shows."""
        if view not in self._views:
            camera = self._camera(view)
            self._views[view] = camera.observe(SPHERE.poses[view])
            if camera.true_pose is not None:
                self._in_camera[view] = np.linalg.inv(camera.true_pose) @ self._in_truth
        return self._views[view]

    def log_evidence(self, view: int) -> NDArray[np.floating]:
        """What the features say of a view that shows the thing."""
        if view not in self._evidence:
            self._evidence[view] = self.things.log_evidence([self.observation(view)])[0]
        return self._evidence[view]

    def seen(self, views: list[int]) -> list[int]:
        """Those of some views that show the thing."""
        return [view for view in views if self.observation(view).seen]

    def verified(self, views: list[int]) -> tuple[Verified, float]:
        """What is found in some views, and the seconds of CPU that it took."""
        used = frozenset(self.seen(views))
        if used not in self._verified:
            order = sorted(used)
            observations = [self.observation(view) for view in order]
            evidence = np.stack([self.log_evidence(view) for view in order])
            begun = time.process_time()
            found = self.things.verify(observations, evidence)
            self._verified[used] = (found, time.process_time() - begun)
        return self._verified[used]

    def pose_error(self, views: list[int]) -> float | None:
        """Mean distance of the thing's surface where it is found from where it is (ADD-S),
        millimetres.

        As the last view sees it. None where the thing is not named right.
        """
        found, _ = self.verified(views)
        rows = np.flatnonzero(found.things == self.thing)
        if int(found.belief.argmax()) != self.thing or not len(rows):
            return None
        last = self.seen(views)[-1]
        number = sorted(self.seen(views)).index(last)
        scene = self.observation(last).scene
        radius = self.observation(last).radius
        assert scene is not None
        assert radius is not None
        camera = scene.pose.copy()
        camera[:3, 3] *= radius
        pose = found.poses[rows[0]].copy()
        pose[:3, 3] += found.cameras[rows[0], number]

        surface = self.things.verifier.caster.surfaces[self.thing]
        points = surface.sample(POINTS, np.random.default_rng(0))
        there, here = (
            points @ each[:3, :3].T + each[:3, 3]
            for each in (self._in_camera[last], np.linalg.inv(camera) @ pose)
        )
        return float(1000 * cKDTree(there).query(here)[0].mean())

    def aligned_truth(self, views: list[int]) -> Float:
        """The true pose, aligned with some views as the hypotheses are, (4, 4)."""
        verifier = self.things.verifier
        found = [depth_view(self.observation(view), FINE_SIDE) for view in self.seen(views)]
        shown = [view for view in found if view is not None]
        truth = start(np.array([self.thing]), self.true_pose[None, :3, :3], len(shown))
        centre = verifier.caster.centres[self.thing].astype(np.float64)
        place = self.true_pose[:3, :3] @ centre + self.true_pose[:3, 3]
        truth = replace(truth, centres=place[None])
        return align(verifier.caster, truth, shown, FINE, verifier.prior).poses(verifier.caster)[0]

    def state(self, views: list[int]) -> EpisodeState:
        """Where the episode stands, as a policy sees it."""
        seen = self.seen(views)
        calibration = self.things.recogniser.calibration
        classes = len(self.things.recogniser.classes)
        total = np.sum([self.log_evidence(view) for view in seen], axis=0)
        here = SPHERE.azimuth[views[-1]]
        joint = calibration.joint(total, len(seen), classes, here)
        visited = np.zeros((1, len(SPHERE)), bool)
        visited[0, views] = True
        found, _ = self.verified(views)
        return EpisodeState(
            current=np.array([views[-1]]),
            visited=visited,
            belief=found.belief[None],
            evidence=Evidence(np.zeros((1, classes))),
            step=len(views),
            joint=joint[None],
            outlook=[self.outlook(views)],
        )

    def outlook(self, views: list[int]) -> Outlook:
        """What is known when the next view is to be chosen."""
        observations = [self.observation(view) for view in self.seen(views)]
        return Outlook.of(self.things.verifier, self.verified(views)[0], observations)


@dataclass
class Ceiling:
    """Goes where a view tells most if the truth and its pose are known beforehand."""

    episode: Episode
    needs: tuple[str, ...] = ("outlook",)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """The free view that is expected to raise the log-belief in the truth most."""
        assert state.outlook is not None
        outlook = state.outlook[0]
        others = outlook.hypotheses
        rivals = others.things != self.episode.thing
        belief = np.append(TRUTH_BELIEF + others.belief[~rivals].sum(), others.belief[rivals])
        views = np.flatnonzero(state.visited[0]).tolist()
        hypotheses = Hypotheses(
            np.append(self.episode.thing, others.things[rivals]),
            np.concatenate([self.episode.aligned_truth(views)[None], others.poses[rivals]]),
            belief / belief.sum(),
        )
        cameras = outlook.cameras(SPHERE.directions)
        gain = replace(outlook, hypotheses=hypotheses).expect(cameras).gain(0)
        return best_view(SPHERE, state, gain[None] + 1e-9 * rng.random((1, len(SPHERE))))


@dataclass
class Run:
    """What one policy made of one episode.

    Attributes:
        views: that it took.
        right: whether the thing is named right after each.
        confidence: belief in the answer after each.
        decision: seconds of CPU of each choice.
        verification: seconds of CPU of each verification.
        pose_error: mean distance of the surface, millimetres; None where it is not named right.
    """

    views: list[int]
    right: list[bool] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    decision: list[float] = field(default_factory=list)
    verification: list[float] = field(default_factory=list)
    pose_error: list[float | None] = field(default_factory=list)


def run(episode: Episode, policy: Policy, count: int, rng: np.random.Generator) -> Run:
    """Take some views as a policy says."""
    made = Run([episode.start])
    while True:
        found, seconds = episode.verified(made.views)
        made.right.append(int(found.belief.argmax()) == episode.thing)
        made.confidence.append(float(found.belief.max()))
        made.verification.append(seconds)
        made.pose_error.append(episode.pose_error(made.views))
        if len(made.views) == count:
            return made
        state = episode.state(made.views)
        begun = time.process_time()
        if "outlook" in policy.needs:
            state = replace(state, outlook=[episode.outlook(made.views)])  # counts as its time
        view = int(policy.next_views(state, rng)[0])
        made.decision.append(time.process_time() - begun)
        made.views.append(view)


def policies_of(
    names: tuple[str, ...], things: TaughtThings
) -> dict[str, Callable[[Episode], Policy]]:
    """Policies by name, each made for an episode."""
    card = things.recogniser.card.card_path
    picture = Discriminate.from_card(card, SPHERE) if "picture" in names else None
    geometry = DiscriminateGeometry(SPHERE)
    known: dict[str, Callable[[Episode], Policy]] = {
        "random": lambda _: RandomAll(SPHERE),
        "spread": lambda _: Spread(SPHERE),
        "furthest": lambda _: Furthest(SPHERE),
        "picture": lambda _: picture,  # type: ignore[dict-item,return-value]
        "geometry": lambda _: geometry,
        "pose": lambda _: replace(geometry, goal="pose"),
        "ceiling": Ceiling,
    }
    for name in names:
        if ":" in name:
            own = make_policy(name, SPHERE)
            known[name] = lambda _, own=own: own  # type: ignore[misc]
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise UsageError(f"no policy is called {unknown[0]}; there are {', '.join(known)}")
    return {name: known[name] for name in names}


@dataclass(frozen=True, eq=False)
class Results:
    """All runs: of each policy and each thing the means over draws and repeats.

    Attributes:
        policies: their names, N of them.
        groups: what each of T things is drawn with in the bootstrap, (T,) int64.
        right: share that is named right after each view, (N, T, views).
        sure: share that is sure within the views, (N, T).
        sure_and_wrong: share that is sure and wrong, (N, T).
        until: views until it is sure; all, if it never is, (N, T).
        travel: radians on the sphere up to each view, (N, T, views).
        decision: seconds of a choice, by policy.
        verification: seconds of the last verification, by policy.
        pose_error: millimetres after each number of views, by policy; NaN where not named right.
    """

    policies: list[str]
    groups: NDArray[np.int64]
    right: Float
    sure: Float
    sure_and_wrong: Float
    until: Float
    travel: Float
    decision: dict[str, list[float]]
    verification: dict[str, list[float]]
    pose_error: dict[str, Float]

    @classmethod
    def read(cls, file: Path, pairs: bool) -> Results:
        """Read the lines of a run."""
        episodes = read_episodes(file)
        policies = [
            name for name in episodes[0]["runs"] if all(name in e["runs"] for e in episodes)
        ]
        names = sorted({episode["thing"] for episode in episodes})
        bodies = [name.partition("_")[0] if pairs else name for name in names]
        groups = np.unique(bodies, return_inverse=True)[1]
        parts: dict[str, list[list[NDArray]]] = {}
        decision: dict[str, list[float]] = {name: [] for name in policies}
        verification: dict[str, list[float]] = {name: [] for name in policies}
        pose_error = {}
        for policy in policies:
            rows: dict[str, list[NDArray]] = {}
            for name in names:
                runs = [
                    each
                    for episode in episodes
                    if episode["thing"] == name
                    for each in episode["runs"][policy]
                ]
                for key, value in _means(runs).items():
                    rows.setdefault(key, []).append(value)
                decision[policy] += [x for each in runs for x in each["decision"]]
                verification[policy] += [each["verification"][-1] for each in runs]
            every = [each for episode in episodes for each in episode["runs"][policy]]
            pose_error[policy] = np.array([each["pose_error"] for each in every], float)
            for key, values in rows.items():
                parts.setdefault(key, []).append(values)
        arrays = {key: np.array(values, float) for key, values in parts.items()}
        times = {"decision": decision, "verification": verification}
        return cls(policies, groups, pose_error=pose_error, **times, **arrays)

    @cached_property
    def weights(self) -> Float:
        """How often each thing is drawn in each sample of the bootstrap, (S, T)."""
        drawn = resample(int(self.groups.max()) + 1, SAMPLES, np.random.default_rng(0))
        return drawn[:, self.groups]

    def difference(self, values: Float, policy: str) -> tuple[float, float, float, float]:
        """Difference to random of some values, (N, T): itself, its 95 % interval and p-value."""
        per_thing = values[self.policies.index(policy)] - values[self.policies.index("random")]
        samples = self.weights @ per_thing / self.weights.sum(1)
        low, high = interval(samples[:, None])
        mean = float(per_thing.mean())
        p = bootstrap_p(np.array([mean]), samples[:, None])
        return mean, float(low[0]), float(high[0]), float(p[0])


def read_episodes(file: Path) -> list[dict]:
    """The episodes of a file, each once with all policies that it was replayed with."""
    found: dict[tuple[str, int], dict] = {}
    for line in file.read_text().splitlines() if file.exists() else []:
        episode = json.loads(line)
        known = found.setdefault((episode["thing"], episode["draw"]), episode)
        known["runs"] |= episode["runs"]
    return list(found.values())


def _means(runs: list[dict]) -> dict[str, NDArray]:
    """Means over some runs of one policy with one thing."""
    right = np.array([each["right"] for each in runs], float)
    confidence = np.array([each["confidence"] for each in runs])
    sure = confidence >= CONFIDENT
    ever = sure.any(1)
    last = np.where(ever, sure.argmax(1), sure.shape[1] - 1)
    wrong = ever & (right[np.arange(len(runs)), last] == 0)
    ways = [[0.0, *np.cumsum(SPHERE.arc[e["views"][:-1], e["views"][1:]])] for e in runs]
    return {
        "right": right.mean(0),
        "sure": ever.mean(),
        "sure_and_wrong": wrong.mean(),
        "until": (last + 1).mean(),
        "travel": np.array(ways).mean(0),
    }


def tables(results: Results, episodes: int) -> str:
    """The results as text."""
    count = results.right.shape[2]
    after = [f"after {k}" for k in range(1, count + 1)]
    error = [f"pose error after {k}, mm: median, 95 %" for k in range(2, count + 1)]
    head = ["policy", *after, "views until sure", "sure", "sure and wrong", "travel, rad", *error]
    head.append("decision, ms: median, 95 %")
    lines = [f"{episodes} episodes, {results.right.shape[1]} things", ""]
    lines += [_row(head), "|---" * len(head) + "|"]
    for n, policy in enumerate(results.policies):
        times = 1000 * np.array(results.decision[policy])
        spent = f"{np.median(times):.0f}, {np.quantile(times, 0.95):.0f}"
        accuracy = [f"{x:.3f}" for x in results.right[n].mean(0)]
        rest = [f"{x[n].mean():.3f}" for x in (results.until, results.sure, results.sure_and_wrong)]
        errors = [spread_of(results.pose_error[policy][:, k]) for k in range(1, count)]
        lines.append(
            _row(
                [policy, *accuracy, *rest, f"{results.travel[n, :, -1].mean():.2f}", *errors, spent]
            )
        )
    verification = 1000 * np.concatenate(list(results.verification.values()))
    lines += ["", f"verification of {count} views: {np.median(verification):.0f} ms (median)", ""]

    tests = []
    for policy in results.policies:
        if policy == "random":
            continue
        for k in range(1, count):
            tests.append(
                (policy, f"after {k + 1}", results.difference(results.right[:, :, k], policy))
            )
        tests.append((policy, "views until sure", results.difference(results.until, policy)))
    adjusted = holm(np.array([test[2][3] for test in tests]))
    lines += [
        _row(["policy", "measure", "difference to random", "95 % interval", "p (Holm)"]),
        "|---" * 5 + "|",
    ]
    for (policy, measure, (mean, low, high, _)), p in zip(tests, adjusted, strict=True):
        lines.append(
            _row([policy, measure, f"{mean:+.3f}", f"{low:+.3f} to {high:+.3f}", f"{p:.4f}"])
        )
    return "\n".join(lines)


def spread_of(values: Float) -> str:
    """Median and 95th percentile of those that are known."""
    known = values[~np.isnan(values)]
    return f"{np.median(known):.1f}, {np.quantile(known, 0.95):.1f}" if len(known) else "-"


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def load_things(models: str, scans: Path) -> tuple[TaughtThings, list[Mesh]]:
    """A memory's things of known geometry, and their scans; a memory without geometry takes it
    from the scans.
    """
    recogniser = TaughtRecogniser(models, threads=1)
    assert recogniser.card.memory is not None
    names = [thing.name for thing in recogniser.card.memory.things]
    known = TaughtThings.of(recogniser)
    if known is not None:
        names = list(known.names)
    files = {path.stem: path for path in scans.iterdir() if path.is_file()}
    missing = [name for name in names if name not in files]
    if missing:
        raise UsageError(f"{scans}: holds no scan of {missing[0]}")
    meshes = [load_mesh(files[name], unit="m") for name in track(names, "scans")]
    if known is not None:
        return known, meshes
    surfaces = [
        Surface.from_mesh(mesh, name).simplified() for mesh, name in zip(meshes, names, strict=True)
    ]
    return TaughtThings(recogniser, surfaces), meshes


def main(
    scans: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    models: str = "ycb",
    draws: tuple[int, ...] = (0,),
    views: int = 3,
    policies: tuple[str, ...] = POLICIES,
    repeats: int = 2,
    sensor: str = "wrist",
    boxes: float = 0.0,
    every: int = 1,
    pairs: bool = False,
) -> None:
    """Replay the policies and print the tables.

    Args:
        scans: folder of the scans.
        out: folder of the results; what is there already is not done again.
        models: memory of the things.
        draws: numbers of the draws.
        views: how many are taken.
        policies: which ones, or MODULE:CLASS.
        repeats: runs of the policy "random" in each episode.
        sensor: what the views are taken with.
        boxes: mean number of boxes around a thing.
        every: show every so many things only.
        pairs: the names of look-alikes begin with the number of their pair: things of one pair are
            drawn together in the bootstrap.
    """
    things, meshes = load_things(models, scans)
    chosen = policies_of(policies, things)
    out.mkdir(parents=True, exist_ok=True)
    file = out / "episodes.jsonl"
    done = {(e["thing"], e["draw"]): set(e["runs"]) for e in read_episodes(file)}

    wanted = [(t, d) for d in draws for t in range(len(meshes)) if (t - d) % every == 0]
    missing = [(t, d) for t, d in wanted if set(policies) - done.get((things.names[t], d), set())]
    for thing, draw in track(missing, "episodes"):
        left = set(policies) - done.get((things.names[thing], draw), set())
        episode = Episode(things, meshes[thing], thing, draw, Setting(sensor, boxes))
        runs = {}
        for name, make in ((name, make) for name, make in chosen.items() if name in left):
            times = repeats if name == "random" else 1
            rng = np.random.default_rng((thing, draw, crc32(name.encode())))
            runs[name] = [vars(run(episode, make(episode), views, rng)) for _ in range(times)]
        line = {"thing": things.names[thing], "draw": draw, "runs": runs}
        with file.open("a") as lines_file:
            lines_file.write(json.dumps(line) + "\n")

    results = Results.read(file, pairs)
    text = tables(results, len(read_episodes(file)))
    (out / "tables.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    tyro.cli(main)
