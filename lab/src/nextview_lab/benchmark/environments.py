"""Gymnasium environments to train or evaluate a policy; see docs/environments.md.

Importing this module registers them:

- ``nextview/Recognise-v0``: replays a file of predictions, without rendering.
- ``nextview/RecogniseThings-v0``: taught things with known geometry; an observation is the
  joint belief over thing and pose, represented by the leading hypotheses.
"""

import logging
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from nextview.checks import number, one_of, whole
from nextview.errors import DatasetError, SessionError, UsageError
from nextview.geometry.mesh import UNITS
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
from nextview.session.episode import Episodes
from nextview.teaching.thing_sources import find_things
from nextview.types import Float, Index
from nextview.views.expected_model import MOST_LEADING
from nextview_lab.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    Occlusion,
    Setting,
    ThingEpisode,
    things_of,
)
from nextview_lab.benchmark.thing_runs import scan_of
from nextview_lab.data.predictions import Predictions
from nextview_lab.extras import extras
from nextview_lab.training.rollout import (
    OBJECTIVES,
    check_inputs,
    state_after,
    value_of,
)

with extras():
    import gymnasium

log = logging.getLogger(__name__)
PredictionsSource = str | Path | Predictions
_HERE = "nextview_lab.benchmark.environments"
gymnasium.register("nextview/Recognise-v0", f"{_HERE}:RecogniseEnv")
gymnasium.register(
    "nextview/RecogniseThings-v0",
    "nextview_lab.benchmark.environments:RecogniseThingsEnv",
)
# objects for training or for evaluation; None for all
EnvironmentSplit = Literal["train", "test"] | None
Info = dict[str, Any]
# bound of the observation space for map outputs, far above those of the networks of this project
MAP_LIMIT = 100.0


@dataclass(frozen=True)
class Rules:
    """Observations and rewards of the agent, and the end of an episode.

    Attributes:
        inputs: of an observation: "belief", "view" (the belief from the last view alone), "place"
            (the ring and the visited views), "azimuth_bin", and predicted maps by name ("lem",
            "view_area-sphere").
        frame: origin of azimuths: the "camera", or the "object" in its estimated orientation.
        objective: "right" answer, "belief" in the true class, or its "log-belief"; the reward is
            its change by a view.
        max_views: largest number of views, at least 2; the first view is not chosen by the agent.
        threshold: belief that ends an episode after the second view or later; None takes all views.
        view_price: subtracted from the reward for each view.
        travel_price: subtracted from the reward for each grid cell of travel.
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
        one_of(self.frame, get_args(CellFrame), "the frame")
        one_of(self.objective, OBJECTIVES, "the objective")
        number(self.view_price, "the view_price", 0)
        number(self.travel_price, "the travel_price", 0)
        # raises an error for an invalid threshold
        Stopping(0.5 if self.threshold is None else self.threshold)

    @property
    def maps(self) -> tuple[str, ...]:
        """Maps among the inputs."""
        return maps_of(self.inputs)

    def stopping(self, calibration: Calibration) -> Stopping:
        """Return the stopping rule, with the decay of the threshold from the calibration."""
        if self.threshold is None:
            return FixedLength(max_views=self.max_views)
        return AfterAction(self.threshold, self.max_views, calibration.correlation)


@dataclass(frozen=True)
class AfterAction(Stopping):
    """Stopping rule that never ends an episode at the first view."""

    def threshold_at(self, n_views: Index | int) -> Float:
        """Return the threshold, see ``Stopping``; infinity for one view."""
        return np.where(np.asarray(n_views) < 2, np.inf, super().threshold_at(n_views))


@dataclass
class Asked:
    """The policy of an agent: takes the view that it asks for, or the free one nearest to it.

    Attributes:
        sphere: of the views.
        view: the view.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    view: int
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Return the view, (1,).

        Args:
            state: of the episode.
            rng: source of all random numbers.
        """
        return np.where(state.free, self.sphere.travel[self.view], np.inf).argmin(1)


class ViewsEnv(gymnasium.Env[Any, Any]):
    """Episodes in which an agent takes views: its actions, its rewards, and their end.

    An action is a ring and a number of azimuth steps ahead: ``ring * azimuths + steps``. One that
    leads to a visited view goes to the nearest free one. The reward is the change of the objective
    minus the prices. Kinds of episodes define ``begin`` and ``take``.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # Gymnasium's own form

    def __init__(self, sphere: ViewSphere, rules: Rules) -> None:
        whole(rules.max_views, "the number of views", 2, len(sphere))
        self.sphere = sphere
        self.rules = rules
        self.action_space = gymnasium.spaces.Discrete(len(sphere))
        # view that each action leads to, (V,); None where no episode is under way
        self.reached: Index | None = None

    def begin(self, options: Info) -> int:
        """Begin an episode, and return its first view.

        Args:
            options: of ``reset``.
        """
        raise NotImplementedError

    def take(self, view: int) -> tuple[Any, float, Index | None, Info]:
        """Take a view: the observation, the objective, what actions lead to, and the info.

        Args:
            view: that is free.
        """
        raise NotImplementedError

    def reset(
        self,
        *,
        seed: int | None = None,
        options: Info | None = None,
    ) -> tuple[Any, Info]:
        """Begin an episode; its first view is not chosen by the agent.

        Args:
            seed: of the random numbers; None to continue their sequence.
            options: numbers of the episode; random by default.

        Returns:
            The first observation and its info.
        """
        super().reset(seed=seed)
        self.views = [self.begin(options or {})]
        self.travel = 0.0
        observation, self._value, self.reached, info = self.take(self.views[0])
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Take a view; see Gymnasium."""
        if self.reached is None:
            raise SessionError("no episode is under way; call reset")
        if isinstance(action, np.ndarray) and action.size == 1:
            action = action.item()
        chosen = whole(action, "an action", 0, len(self.sphere) - 1)
        away = self.sphere.travel[self.reached[chosen]].copy()
        away[self.views] = np.inf
        view = int(away.argmin())
        way = float(self.sphere.travel[self.views[-1], view])
        self.views.append(view)
        self.travel += way

        earlier = self._value
        observation, self._value, self.reached, info = self.take(view)
        price = self.rules.view_price + self.rules.travel_price * way
        over = self.reached is None
        return observation, self._value - earlier - price, over, False, info

    def drawn(self, options: Info, below: dict[str, int]) -> list[int]:
        """Return numbers of an episode: those of the options, or else random ones.

        Args:
            options: of ``reset``.
            below: upper limit of each number, exclusive, by name.

        Raises:
            UsageError: an option is not valid.
        """
        found = {name: self.np_random.integers(most) for name, most in below.items()}
        given = found | options
        return [whole(given[name], name, 0, most - 1) for name, most in below.items()]


class RecogniseEnv(ViewsEnv):
    """Recognise an object from few views that are looked up in predictions.

    Train on objects that the recogniser was not trained on (``nextview-lab predict --held-out``).
    The info holds "object", "view", "n_views", "travel" (cells so far), "answer", its "confidence",
    "prediction_target" and "action_mask", the actions that lead to an unvisited view, (V,) int8.
    """

    def __init__(
        self,
        predictions: PredictionsSource,
        split: EnvironmentSplit = "train",
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        """Take the objects of predictions.

        Args:
            predictions: the predictions, or their path. Those without splits, such as those of
                taught things, are all used for "train".
            split: "train" (each shape once), "test", or None for all objects.
            balanced: whether all classes are drawn equally often.
            rules: arguments of ``Rules``.

        Raises:
            PredictionsError: there are no objects of the split, or a map or the azimuth bins are
                missing.
        """
        given = Rules(**rules)
        p = (
            predictions
            if isinstance(predictions, Predictions)
            else Predictions.load(Path(predictions))
        )
        if split == "train" and not p.splits.any():
            log.warning(
                "the predictions name no splits, as those of taught things: all %d objects are"
                " taken",
                len(p),
            )
            split = None

        p = p if split is None else p.of_split(split)
        p = p.deduplicate() if split == "train" else p
        check_inputs(p, given.inputs, given.frame)

        super().__init__(p.sphere, given)
        self.predictions = replace(p, maps={name: p.maps[name] for name in given.maps})
        self.balanced = balanced
        c = len(p.classes)
        high = np.concatenate(
            [
                np.full(
                    len(mirrored_features(p.sphere, c, (name,), given.frame)),
                    MAP_LIMIT if name in given.maps else 1.0,
                )
                for name in ordered(given.inputs)
            ]
        )
        # of ``policies.gain.features``, (D,); all but the maps are in 0 to 1
        self.observation_space = gymnasium.spaces.Box(
            np.where(high > 1, -MAP_LIMIT, 0).astype(np.float32),
            high.astype(np.float32),
        )

    def begin(self, options: Info) -> int:
        """Begin an episode; see ``ViewsEnv``.

        Args:
            options: "object" and "start".
        """
        p = self.predictions
        weight = 1 / np.bincount(p.labels)[p.labels]
        chance = weight / weight.sum() if self.balanced else None
        object_ = {"object": self.np_random.choice(len(p), p=chance)}
        below = {"object": len(p), "start": len(p.sphere)}
        number, start = self.drawn(object_ | options, below)
        self._objects = np.array([number])
        self._asked = Asked(p.sphere, start)
        self._episodes = Episodes(
            p.sphere,
            self._asked,
            np.array([start]),
            self.rules.stopping(p.calibration),
            np.random.default_rng(0),  # not used for any draw
            p.calibration,
        )
        return start

    def take(self, view: int) -> tuple[Any, float, Index | None, Info]:
        """Take a view; see ``ViewsEnv``.

        Args:
            view: that is free.
        """
        episodes = self._episodes
        if episodes.steps:
            self._asked.view = view
            episodes.keep_choice(episodes.next_choice())
        p = self.predictions
        step = episodes.update(p.evidence(self._objects, np.array([view])))
        visited = np.zeros((1, len(p.sphere)), bool)
        visited[0, self.views] = True
        state = state_after(step, p, visited, len(self.views))

        logs = p.calibration.log_belief(
            step.total, np.maximum(step.seen, 1), len(p.classes)
        )
        labels = p.labels[self._objects]
        value = float(value_of(logs, labels, self.rules.objective)[0])
        inputs, frame = self.rules.inputs, self.rules.frame
        reached = cells_from(p.sphere)[origin(p.sphere, state, frame)][0]
        seen = features(p.sphere, state, inputs, frame)[0].astype(np.float32)
        info = {
            "object": self._objects[0],
            "view": view,
            "n_views": len(self.views),
            "travel": self.travel,
            "answer": step.belief[0].argmax(),
            "confidence": step.belief[0].max(),
            "prediction_target": labels[0],
            "action_mask": (~visited[0, reached]).astype(np.int8),
        }
        going = reached if len(episodes.running) else None
        return seen, value, going, info


KEPT_EPISODES = 64  # episodes whose views are kept in memory
FAR_METRES = 10.0  # bound of the positions of hypotheses
MOST_NATS = 20.0  # bound of the information of a view
LEAST_PAID_BELIEF = 1e-12  # lower bound of the belief in logarithmic rewards


class RecogniseThingsEnv(ViewsEnv):
    """Recognise a taught thing, alone or half hidden, by few views through a sensor.

    The observation is the joint belief over thing and pose. "belief" is the belief in each thing,
    (T,). "hypotheses" is the belief in each of the leading hypotheses, (H,), the likeliest first,
    padded with 0. "things" is the thing of each hypothesis, (H,), T for padding, and "poses" its
    pose in the frame of the last camera, (H, 3, 4), metres. "information" is the expected
    information of each action about the thing, (V,), nats, as used by the policy discriminate.
    "visited" marks the actions that lead to a visited view, (V,).

    """

    def __init__(
        self,
        scans: str | Path,
        models: str,
        sensor: str = "wrist",
        occlusion: Occlusion = "none",
        draws: int = 4,
        seed: int = 0,
        unit: str = "m",
        **rules: Any,
    ) -> None:
        """Open a memory, and find the scans of its things.

        Args:
            scans: folder of the scans.
            models: name or folder of the memory.
            sensor: simulated depth camera.
            occlusion: "none", or boxes that leave "half" or, if "heavy", a third visible.
            draws: number of episodes per thing.
            seed: of the episodes, see ``thing_episodes.Setting``.
            unit: unit of length of the scan files.
            rules: objective, max_views, threshold and prices, see ``environments.Rules``.

        Raises:
            DatasetError: there is no scan of a thing.
            UsageError: the rules are invalid.
        """
        super().__init__(EPISODE_SPHERE, Rules(**rules))
        self.draws = whole(draws, "the number of draws", 1)
        self.things = things_of(models, None)
        files = {thing.name: thing.path for thing in find_things(Path(scans)).things}
        missing = [name for name in self.things.names if name not in files]
        if missing:
            raise DatasetError(
                f"{scans}: holds no scan of {missing[0]}, which {models} knows"
            )

        one_of(unit, tuple(UNITS), "the unit")
        setting = Setting(sensor, occlusion, seed)
        self._begin = lru_cache(KEPT_EPISODES)(
            lambda thing, draw: ThingEpisode(
                self.things,
                scan_of(self.things, thing, files[self.things.names[thing]], unit),
                thing,
                draw,
                setting,
            )
        )
        self.observation_space = self._space()

    def _space(self) -> gymnasium.spaces.Dict:
        box = partial(gymnasium.spaces.Box, dtype=np.float32)
        count = len(self.things.names)
        views = len(EPISODE_SPHERE)
        return gymnasium.spaces.Dict(
            {
                "belief": box(0, 1, (count,)),
                "hypotheses": box(0, 1, (MOST_LEADING,)),
                "things": gymnasium.spaces.MultiDiscrete([count + 1] * MOST_LEADING),
                "poses": box(-FAR_METRES, FAR_METRES, (MOST_LEADING, 3, 4)),
                "information": box(0, MOST_NATS, (views,)),
                "visited": gymnasium.spaces.MultiBinary(views),
            }
        )

    def begin(self, options: dict[str, Any]) -> int:
        """Begin an episode; see ``ViewsEnv``.

        Args:
            options: "object", the number of a thing, and "draw".
        """
        below = {"object": len(self.things.names), "draw": self.draws}
        self._episode = self._begin(*self.drawn(options, below))
        return self._episode.start

    def take(self, view: int) -> tuple[Any, float, Index | None, dict[str, Any]]:
        """Take a view; see ``ViewsEnv``.

        Args:
            view: that is free.
        """
        belief = self._episode.verified(self.views).belief
        logs = np.log(np.maximum(belief, LEAST_PAID_BELIEF))[None]
        truth = np.array([self._episode.thing])
        value = float(value_of(logs, truth, self.rules.objective)[0])
        at = self.rules.threshold
        sure = at is not None and belief.max() >= at and len(self.views) > 1
        over = sure or len(self.views) >= self.rules.max_views
        reached = cells_from(EPISODE_SPHERE)[view]
        info = {
            "object": self._episode.thing,
            "view": view,
            "n_views": len(self.views),
            "travel": self.travel,
            "answer": int(belief.argmax()),
            "confidence": float(belief.max()),
            "travel_to": EPISODE_SPHERE.travel[view][reached],
        }
        return self._observed(belief), value, None if over else reached, info

    def _observed(self, believed: Float) -> dict[str, Any]:
        reached = cells_from(EPISODE_SPHERE)[self.views[-1]]
        belief = np.zeros(MOST_LEADING, np.float32)
        things = np.full(MOST_LEADING, len(self.things.names))
        poses = np.zeros((MOST_LEADING, 3, 4), np.float32)
        information = np.zeros(len(reached))
        outlook = self._episode.outlook(self.views)
        if outlook is not None:
            leading = outlook.hypotheses
            count = len(leading.things)
            order = np.argsort(-leading.belief, kind="stable")
            towards = EPISODE_SPHERE.directions[[*reached, self.views[-1]]]
            cameras = outlook.cameras(towards)
            belief[:count] = leading.belief[order]
            names = [outlook.caster.surfaces[k].name for k in leading.things[order]]
            things[:count] = [self.things.names.index(name) for name in names]
            poses[:count] = (np.linalg.inv(cameras[-1]) @ leading.poses[order])[:, :3]
            information = outlook.expect(cameras[:-1]).information()
        return {
            "belief": believed.astype(np.float32),
            "hypotheses": belief,
            "things": things,
            "poses": poses.clip(-FAR_METRES, FAR_METRES),
            "information": information.astype(np.float32).clip(0, MOST_NATS),
            "visited": np.isin(reached, self.views).astype(np.int8),
        }
