"""Gymnasium environments to train or judge a policy; see docs/environments.md.

Importing this module registers them.

- ``nextview/Recognise-v0``: over a file of predictions, thousands of episodes in one batch, nothing
is rendered.
- ``nextview/RecogniseMesh-v0``: over meshes, rendered and shown to the networks as the agent goes.
- ``nextview/RecogniseThings-v0``: over taught things of known geometry, see ``thing_environment``.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from nextview.checks import extras, number, one_line, whole
from nextview.data.folders import list_dataset
from nextview.data.predictions import Predictions
from nextview.data.samples import SAMPLE_MESHES, sample_mesh
from nextview.errors import DatasetError, PredictionsError, SessionError, UsageError
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState
from nextview.policies.gain import (
    INPUTS,
    VISIBILITY,
    CellFrame,
    features,
    maps_of,
    mirrored_features,
    ordered,
    origin,
)
from nextview.policies.learned_tables import cells_from
from nextview.recognition.belief import Calibration, FixedLength, Stopping
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import Models, NetworkRecogniser, open_maps
from nextview.recognition.map_names import in_order
from nextview.recognition.model_card import find_models
from nextview.session.episode import Episodes
from nextview.simulation.simulated import SimulatedCamera
from nextview.training.rollout import OBJECTIVES, value_of
from nextview.types import Float, Float32, Index, Mask

with extras():
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

log = logging.getLogger(__name__)
PredictionsSource = str | Path | Predictions
CAMERAS = 16  # meshes that are kept ready to be looked at
_HERE = "nextview.benchmark.environments"
gymnasium.register(
    "nextview/Recognise-v0",
    f"{_HERE}:RecogniseEnv",
    vector_entry_point=f"{_HERE}:RecogniseVectorEnv",
)
gymnasium.register("nextview/RecogniseMesh-v0", f"{_HERE}:RecogniseMeshEnv")
gymnasium.register(
    "nextview/RecogniseThings-v0",
    "nextview.benchmark.thing_environment:RecogniseThingsEnv",
)
# objects to learn from, or objects to judge by; None for all
EnvironmentSplit = Literal["train", "test"] | None
Info = dict[str, Any]
# bound of the observation space for what a map network says; the networks of this project stay far
# below
MAP_LIMIT = 100.0


@dataclass(frozen=True)
class Rules:
    """What the agent sees, what it is paid for, and when an episode ends.

    Attributes:
        inputs: of an observation: "belief", "view" (what the last one alone says), "place" (the
            ring and which views were taken), "azimuth_bin", and predicted maps by name ("lem",
            "view_area-sphere").
        frame: where azimuths are counted from: or the "object" as it is believed to be turned.
        objective: or "belief" in the true class, or its "log-belief": what is paid is the change by
            a view.
        max_views: at most, at least 2; the first is not the agent's.
        threshold: belief that ends an episode after the second view or later; None takes all views.
        view_price: taken from the reward for each view.
        travel_price: taken from it for each grid cell of travel.
    """

    inputs: tuple[str, ...] = ("belief", "view", "place")
    frame: CellFrame = "camera"
    objective: str = "right"
    max_views: int = 5
    threshold: float | None = None
    view_price: float = 0.0
    travel_price: float = 0.0

    def __post_init__(self) -> None:
        if not self.inputs or VISIBILITY in self.inputs:
            raise UsageError(
                f"inputs are some of {', '.join(INPUTS)} and maps, not {', '.join(self.inputs)}"
            )
        for value, known in (
            (self.frame, get_args(CellFrame)),
            (self.objective, OBJECTIVES),
        ):
            if value not in known:
                raise UsageError(f"{value!r} is none of {', '.join(known)}")
        number(self.view_price, "the view_price", 0)
        number(self.travel_price, "the travel_price", 0)
        # says what is wrong with it
        Stopping(0.5 if self.threshold is None else self.threshold)

    @property
    def maps(self) -> tuple[str, ...]:
        """The maps among the inputs."""
        return maps_of(self.inputs)

    def stopping(self, calibration: Calibration) -> Stopping:
        """The rule that ends episodes, with the decay that the calibration asks for."""
        if self.threshold is None:
            return FixedLength(max_views=self.max_views)
        return AfterAction(self.threshold, self.max_views, calibration.correlation)


@dataclass(frozen=True)
class AfterAction(Stopping):
    """Stops as ``Stopping`` does, but never at the first view."""

    def threshold_at(self, n_views: Index | int) -> Float:
        """See ``Stopping``; infinity for one view."""
        return np.where(np.asarray(n_views) < 2, np.inf, super().threshold_at(n_views))


def rows(values: Any, n: int, below: int, what: str) -> Index:
    """Check whole numbers that an agent or a user chose.

    Args:
        values: the numbers; one number for one row.
        n: how many there have to be.
        below: upper limit, exclusive; the lower limit is 0.
        what: name of the numbers in the error message.

    Returns:
        The numbers, (n,) int64.

    Raises:
        UsageError: they are not n such numbers.
    """
    array = np.atleast_1d(np.asarray(values))
    if (
        array.shape != (n,)
        or array.dtype.kind not in "iu"
        or not ((array >= 0) & (array < below)).all()
    ):
        many = "a whole number" if n == 1 else f"{n} whole numbers"
        raise UsageError(
            f"{what}: {many} from 0 to {below - 1}, not {one_line(repr(values))}"
        )
    return array.astype(np.int64)


@dataclass(frozen=True)
class EnvironmentTask:
    """N objects, what is seen of them, and the rules.

    Attributes:
        labels: true class of each object, (N,).
        classes: names of the classes.
        sphere: of the views.
        calibration: from summed evidence to the belief.
        observe: from objects, (A,), and views, (A,), to the evidence of each view.
        rules: of an episode.
        balanced: whether each class is drawn as often as every other one.
    """

    labels: Index
    classes: tuple[str, ...]
    sphere: ViewSphere
    calibration: Calibration
    observe: Callable[[Index, Index], Evidence] = field(repr=False)
    rules: Rules = Rules()
    balanced: bool = False

    def __post_init__(self) -> None:
        whole(self.rules.max_views, "the number of views", 2, len(self.sphere))

    def begin(
        self,
        n: int,
        rng: np.random.Generator,
        options: Info | None = None,
    ) -> "Cohort":
        """Begin episodes.

        Args:
            n: number of episodes.
            rng: source of all random numbers.
            options: of ``reset``: "object" and "start" of each episode; what is missing is drawn.

        Returns:
            The episodes.

        Raises:
            UsageError: an option is not valid.
        """
        weight = 1 / np.bincount(self.labels)[self.labels]
        chance = weight / weight.sum() if self.balanced else None
        objects = rng.choice(len(self.labels), n, p=chance)
        starts = rng.integers(len(self.sphere), size=n)
        given = {"object": objects, "start": starts} | (options or {})
        below = {"object": len(self.labels), "start": len(self.sphere)}
        return Cohort(
            self,
            *(rows(given[name], n, most, name) for name, most in below.items()),
        )

    @property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Space of ``policies.gain.features``, (D,) float32; all but the maps in 0 to 1."""
        c = len(self.classes)
        rules = self.rules
        widths = {
            name: len(mirrored_features(self.sphere, c, (name,), rules.frame))
            for name in ordered(rules.inputs)
        }
        high = np.concatenate(
            [
                np.full(wide, MAP_LIMIT if name in rules.maps else 1.0)
                for name, wide in widths.items()
            ]
        )

        return gymnasium.spaces.Box(
            np.where(high > 1, -MAP_LIMIT, 0).astype(np.float32),
            high.astype(np.float32),
        )

    @property
    def action_space(self) -> gymnasium.spaces.Discrete:
        """Ring and azimuth steps ahead, as ``ring * azimuths + steps``; V actions."""
        return gymnasium.spaces.Discrete(len(self.sphere))


def replayed(
    predictions: PredictionsSource,
    split: EnvironmentSplit = "train",
    balanced: bool = False,
    rules: Rules = Rules(),
) -> EnvironmentTask:
    """Create the task of recognising the objects of predictions.

    Train on objects that the recogniser was not trained on (``nextview predict --held-out``).
    Predictions without splits, such as those of taught things, are used completely for "train".

    Args:
        predictions: the predictions, or their path.
        split: "train" (each shape once), "test", or None for all objects.
        balanced: whether every class is drawn equally often.
        rules: of the episodes.

    Returns:
        The task.

    Raises:
        PredictionsError: there are no objects of the split, or a map or the azimuth bins are
            missing.
    """
    p = (
        predictions
        if isinstance(predictions, Predictions)
        else Predictions.load(Path(predictions))
    )
    if split == "train" and not p.splits.any():
        log.warning(
            "the predictions name no splits, as those of taught things: all %d objects are taken",
            len(p),
        )
        split = None

    p = p if split is None else p.of_split(split)
    p = p.deduplicate() if split == "train" else p

    for name in rules.maps:
        if name not in p.maps:
            known = ", ".join((*INPUTS, *in_order(p.maps)))
            raise PredictionsError(
                f"these predictions hold no map {name!r}; inputs are some of {known}"
            )

    if (
        "azimuth_bin" in rules.inputs or rules.frame == "object"
    ) and p.azimuth_bins is None:
        raise PredictionsError(
            "these predictions hold no azimuth bins, which the inputs or the frame need"
        )

    p = replace(p, maps={name: p.maps[name] for name in rules.maps})
    return EnvironmentTask(
        p.labels,
        p.classes,
        p.sphere,
        p.calibration,
        p.evidence,
        rules,
        balanced,
    )


@dataclass
class Asked:
    """The policy of a cohort: goes to the free view nearest to the action.

    Attributes:
        sphere: of the views.
        views: that are asked for, one an episode.
        needs: what it asks of the state of an episode, see ``Policy.needs``.
    """

    sphere: ViewSphere
    views: Index
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Take the free view that is nearest to the one that the agent asked for.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return np.where(
            state.free,
            self.sphere.travel[self.views[state.episodes]],
            np.inf,
        ).argmin(1)


@dataclass(frozen=True)
class Seen:
    """What A episodes show after their actions.

    Attributes:
        observation: (A, D) float32.
        change: of the objective, (A,).
        price: of the view and of the way to it, (A,).
        ended: whether each episode is over, (A,) bool.
        info: for each episode "object", "view", "n_views", "travel" (cells so far), "answer",
            its "confidence", "prediction_target" and "action_mask", the actions that lead to
            a view not taken yet, (A, V) int8.
    """

    observation: Float32
    change: Float
    price: Float
    ended: Mask
    info: dict[str, NDArray[Any]]


class Cohort:
    """B episodes side by side, all at the same view.

    ``first`` is what is seen before any action.
    """

    def __init__(self, task: EnvironmentTask, objects: Index, starts: Index) -> None:
        self.task = task
        self.objects = objects
        self._asked = Asked(task.sphere, np.array(starts))
        # nothing is drawn
        rng = np.random.default_rng(0)
        stopping = task.rules.stopping(task.calibration)
        self.episodes = Episodes(
            task.sphere,
            self._asked,
            starts,
            stopping,
            rng,
            task.calibration,
        )
        self._visited = np.zeros((len(objects), len(task.sphere)), bool)
        self._value = np.zeros(len(objects))
        self._travel = np.zeros(len(objects))
        self.first = self._look(np.zeros(len(objects)))

    def step(self, actions: Index) -> Seen:
        """Continue all running episodes; a visited view is replaced by the nearest unvisited."""
        sphere = self.task.sphere
        running = self.episodes.running
        rules = self.task.rules
        # ``current`` is what comes next
        before = self.episodes.steps[-1].views[~self.episodes.steps[-1].stopped]
        self._asked.views[running] = self._reached[np.arange(len(running)), actions]
        self.episodes.keep_choice(self.episodes.next_choice())
        way = sphere.travel[before, self.episodes.current[running]]
        self._travel[running] += way
        return self._look(rules.view_price + rules.travel_price * way)

    def _look(self, price: Float) -> Seen:
        task = self.task
        running = self.episodes.running
        k = len(self.episodes.steps) + 1
        sphere = task.sphere
        calibration = task.calibration
        classes = len(task.classes)
        objects = self.objects[running]
        views = self.episodes.current[running]

        step = self.episodes.update(task.observe(objects, views))
        n_seen = np.maximum(step.seen, 1)
        self._visited[running, views] = True
        visited = self._visited[running]
        labels = task.labels[objects]

        azimuth_bins = calibration.azimuth_bins(
            step.total,
            n_seen,
            classes,
            sphere.azimuth[views],
        )
        state = EpisodeState(
            views,
            visited,
            step.belief,
            step.evidence,
            k,
            running,
            azimuth_bins,
        )
        value = value_of(
            calibration.log_belief(step.total, n_seen, classes),
            labels,
            task.rules.objective,
        )

        change = value - self._value[running] if k > 1 else np.zeros(len(running))
        self._value[running] = value
        reached = cells_from(sphere)[origin(sphere, state, task.rules.frame)]
        self._reached = reached[~step.stopped]

        info = {
            "object": objects,
            "view": views,
            "n_views": np.full(len(running), k),
            "travel": self._travel[running],
            "answer": step.belief.argmax(1),
            "confidence": step.belief.max(1),
            "prediction_target": labels,
            "action_mask": (~np.take_along_axis(visited, reached, 1)).astype(np.int8),
        }
        seen = features(sphere, state, task.rules.inputs, task.rules.frame).astype(
            np.float32
        )
        return Seen(seen, change, price, step.stopped, info)


class TaskEnv(gymnasium.Env[Any, Any]):
    """One episode at a time of any task."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # Gymnasium's own form

    def __init__(self, task: EnvironmentTask) -> None:
        self.task = task
        self.observation_space = task.observation_space
        self.action_space = task.action_space
        self._cohort: Cohort | None = None

    def reset(
        self,
        *,
        seed: int | None = None,
        options: Info | None = None,
    ) -> tuple[Any, Info]:
        """Begin an episode; see Gymnasium.

        Args:
            seed: of the draws; None to continue them.
            options: "object" and "start"; what is missing is drawn.

        Returns:
            The first observation and its info.
        """
        super().reset(seed=seed)
        self._cohort = self.task.begin(1, self.np_random, options)
        return self.observed(self._cohort.first), info_of(self._cohort.first)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        seen = self.go(action)
        return (
            self.observed(seen),
            float((seen.change - seen.price)[0]),
            bool(seen.ended[0]),
            False,
            info_of(seen),
        )

    def go(self, action: Any) -> Seen:
        """What is seen after an action."""
        if self._cohort is None or len(self._cohort.episodes.running) == 0:
            raise SessionError("no episode is under way; call reset")
        return self._cohort.step(rows(action, 1, len(self.task.sphere), "action"))

    def observed(self, seen: Seen) -> Any:
        """The observation of the one episode."""
        return seen.observation[0]


def info_of(seen: Seen) -> Info:
    """The info of a single episode."""
    return {name: values[0] for name, values in seen.info.items()}


class RecogniseEnv(TaskEnv):
    """Recognise an object from few views, looked up in predictions; see ``replayed``.

    ``rules`` are as for ``Rules``.
    """

    def __init__(
        self,
        predictions: PredictionsSource,
        split: EnvironmentSplit = "train",
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        super().__init__(replayed(predictions, split, balanced, Rules(**rules)))


class TaskVectorEnv(VectorEnv[Float32, Any, NDArray[Any]]):
    """Many episodes of a task at once, in at most as many cohorts as numbers of views."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # Gymnasium's own form
    metadata["autoreset_mode"] = AutoresetMode.SAME_STEP

    def __init__(self, task: EnvironmentTask, num_envs: int) -> None:
        self.task = task
        self.num_envs = whole(num_envs, "the number of environments", 1)
        self.single_observation_space = task.observation_space
        self.single_action_space = task.action_space
        self.observation_space = batch_space(task.observation_space, num_envs)
        self.action_space = batch_space(task.action_space, num_envs)
        self._cohorts: list[tuple[Cohort, Index]] = []

    def reset(
        self,
        *,
        seed: int | None = None,
        options: Info | None = None,
    ) -> tuple[Float32, Info]:
        """Begin an episode in every environment; see Gymnasium.

        Args:
            seed: of the draws; None to continue them.
            options: "object" and "start" of each episode; what is missing is drawn.

        Returns:
            The first observations, (E, D) float32, and their infos.
        """
        super().reset(seed=seed)
        cohort = self.task.begin(self.num_envs, self.np_random, options)
        self._cohorts = [(cohort, np.arange(self.num_envs))]
        return cohort.first.observation, cohort.first.info

    def step(self, actions: Any) -> tuple[Float32, NDArray, Mask, Mask, Info]:
        seen, info = self.go(actions)
        return (
            seen.observation,
            seen.change - seen.price,
            seen.ended,
            np.zeros(self.num_envs, bool),
            info,
        )

    def go(self, actions: Any) -> tuple[Seen, Info]:
        """Return the next observation of each episode, of a new one where an episode ended."""
        if not self._cohorts:
            raise SessionError("no episode is under way; call reset")

        actions = rows(actions, self.num_envs, len(self.task.sphere), "actions")
        wheres = [members[cohort.episodes.running] for cohort, members in self._cohorts]
        parts = [
            cohort.step(actions[where])
            for (cohort, _), where in zip(self._cohorts, wheres, strict=True)
        ]

        order = np.argsort(np.concatenate(wheres))
        names = ("observation", "change", "price", "ended")
        joined = {
            name: np.concatenate([getattr(part, name) for part in parts])[order]
            for name in names
        }
        info = {
            name: np.concatenate([part.info[name] for part in parts])[order]
            for name in parts[0].info
        }

        seen = Seen(**joined, info=info)
        self._cohorts = [
            (cohort, members)
            for cohort, members in self._cohorts
            if len(cohort.episodes.running)
        ]

        over = np.flatnonzero(seen.ended)
        if len(over) == 0:
            return seen, info
        last = seen.observation.copy()
        now = {name: values.copy() for name, values in info.items()}

        fresh = self.task.begin(len(over), self.np_random)
        self._cohorts.append((fresh, over))
        seen.observation[over] = fresh.first.observation
        for name, values in fresh.first.info.items():
            now[name][over] = values

        return seen, now | {
            "final_obs": last,
            "_final_obs": seen.ended,
            "final_info": info,
            "_final_info": seen.ended,
        }


class RecogniseVectorEnv(TaskVectorEnv):
    """See ``RecogniseEnv``, of which this runs ``num_envs`` side by side."""

    def __init__(
        self,
        num_envs: int,
        predictions: PredictionsSource,
        split: EnvironmentSplit = "train",
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        super().__init__(
            replayed(predictions, split, balanced, Rules(**rules)),
            num_envs,
        )


class RecogniseMeshEnv(TaskEnv):
    """Recognise an object by few views of its mesh.

    ``meshes`` are a folder, CLASS/train|test/MESH or CLASS/MESH; ``split`` None is for one without
    splits, as are the samples, the default. ``models`` are bundled ones by name, or a folder;
    ``viewpoints`` a layout of ``ViewSphere.named``. With ``depth`` the observation is {"state":
    (D,), "depth": (size, size) float32, object radii, 0 where there is no object}; ``size`` is a
    multiple of what the networks take, 112 for the bundled ones. ``balanced`` draws every class
    equally often; ``rules`` are options of ``Rules``. DatasetError: no such meshes, or a class that
    the recogniser does not know.
    """

    def __init__(
        self,
        meshes: str | Path | None = None,
        split: EnvironmentSplit = "train",
        models: str | Path = "modelnet10",
        viewpoints: str = "40",
        depth: bool = False,
        size: int = 224,
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        whole(size, "the side of an image", 1)
        given = Rules(**rules)
        found = find_models(models)
        sphere = ViewSphere.named(viewpoints)

        self._models = Models(
            NetworkRecogniser(found.recogniser),
            open_maps(found.maps, given.maps),
        )
        classes = self._models.classes
        calibration = self._models.recogniser.calibration

        objects: list[tuple[str, Callable[[], Mesh]]] = [
            (name, partial(sample_mesh, name)) for name in SAMPLE_MESHES
        ]
        if meshes is not None:
            entries = [
                e for e in list_dataset(Path(meshes)) if split in (None, e.split)
            ]
            objects = [(e.label, partial(load_mesh, e.path)) for e in entries]

        if not objects:
            raise DatasetError(
                f"{meshes}: holds no meshes of the split {split!r}; split=None takes all that"
                " there are"
            )
        for label, _ in objects:
            if label not in classes:
                raise DatasetError(
                    f"the recogniser knows no class {label!r}; it knows {', '.join(classes)}"
                )

        labels = np.array([classes.index(label) for label, _ in objects])
        self._camera = lru_cache(CAMERAS)(
            lambda k: SimulatedCamera(objects[k][1](), size, sphere.distance)
        )
        super().__init__(
            EnvironmentTask(
                labels,
                classes,
                sphere,
                calibration,
                self._rendered,
                given,
                balanced,
            )
        )

        self._depth = depth
        if depth:
            image = gymnasium.spaces.Box(
                0,
                np.float32(sphere.distance + 1),
                (size, size),
            )
            self.observation_space = gymnasium.spaces.Dict(
                {"state": self.task.observation_space, "depth": image}
            )

    def _rendered(self, objects: Index, views: Index) -> Evidence:
        poses = self.task.sphere.poses
        seen = [
            self._camera(int(k)).observe(poses[v])
            for k, v in zip(objects, views, strict=True)
        ]
        self._last = seen[-1]
        return self._models.evidence(seen)

    def observed(self, seen: Seen) -> Any:
        """The state, and the depth image if it is wanted."""
        state = super().observed(seen)
        return {"state": state, "depth": self._last.depth} if self._depth else state
