"""The Gymnasium environment ``nextview/RecogniseThings-v0``: taught things with known geometry.

The observation is the joint belief over thing and pose, represented by the leading hypotheses.
Importing ``nextview_lab.benchmark.environments`` registers the environment.
"""

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from nextview.checks import one_of, whole
from nextview.errors import DatasetError, SessionError
from nextview.geometry.mesh import UNITS
from nextview.policies.learned_tables import cells_from
from nextview.teaching.thing_sources import find_things
from nextview.things.leading import MOST_LEADING
from nextview.things.taught import TaughtThings
from nextview_lab.benchmark.environments import Rules, rows
from nextview_lab.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    Occlusion,
    Setting,
    ThingEpisode,
)
from nextview_lab.benchmark.thing_runs import opened, scan_of
from nextview_lab.extras import extras
from nextview_lab.training.rollout import value_of

with extras():
    import gymnasium


KEPT_EPISODES = 64  # episodes whose views are kept in memory
FAR_METRES = 10.0  # bound of the positions of hypotheses
MOST_NATS = 20.0  # bound of the information of a view
LEAST_PAID_BELIEF = 1e-12  # lower bound of the belief in logarithmic rewards


class RecogniseThingsEnv(gymnasium.Env[Any, Any]):
    """Recognise a taught thing, alone or half hidden, by few views through a sensor.

    The observation is the joint belief over thing and pose. "belief" is the belief in each thing,
    (T,). "hypotheses" is the belief in each of the leading hypotheses, (H,), the likeliest first,
    padded with 0. "things" is the thing of each hypothesis, (H,), T for padding, and "poses" its
    pose in the frame of the last camera, (H, 3, 4), metres. "information" is the expected
    information of each action about the thing, (V,), nats, as used by the policy discriminate.
    "visited" marks the actions that lead to a visited view, (V,).

    An action is a ring and a number of azimuth steps ahead of the last view: ``ring * azimuths +
    steps``. An action that leads to a visited view goes to the nearest free one.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # Gymnasium's own form

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
        self.rules = Rules(**rules)
        whole(self.rules.max_views, "the number of views", 2, len(EPISODE_SPHERE))
        self.draws = whole(draws, "the number of draws", 1)
        self.things: TaughtThings = opened(models)
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
                partial(
                    scan_of,
                    self.things,
                    thing,
                    files[self.things.names[thing]],
                    unit,
                ),
                thing,
                draw,
                setting,
            )
        )
        self.action_space = gymnasium.spaces.Discrete(len(EPISODE_SPHERE))
        self.observation_space = self._space()
        self._episode: ThingEpisode | None = None
        self._views: list[int] = []

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

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; its first view is not chosen by the agent.

        Args:
            seed: of the random numbers; None to continue their sequence.
            options: "object", the number of a thing, and "draw"; random by default.
        """
        super().reset(seed=seed)
        given = options or {}
        drawn = {
            "object": self.np_random.integers(len(self.things.names)),
            "draw": self.np_random.integers(self.draws),
        }
        below = {"object": len(self.things.names), "draw": self.draws}
        thing, draw = (
            int(rows(given.get(name, drawn[name]), 1, most, name)[0])
            for name, most in below.items()
        )
        self._episode = self._begin(thing, draw)
        self._views = [self._episode.start]
        self._travel = 0.0
        self._over = False
        self._value = self._judged()

        return self._observed(), self._info()

    def step(
        self,
        action: Any,
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Take a view; the reward is the change of the objective minus the prices."""
        if self._episode is None or self._over:
            raise SessionError("no episode is under way; call reset")
        here = self._views[-1]
        wanted = cells_from(EPISODE_SPHERE)[
            here,
            int(rows(action, 1, len(EPISODE_SPHERE), "action")[0]),
        ]
        free = np.ones(len(EPISODE_SPHERE), bool)
        free[self._views] = False
        view = int(np.where(free, EPISODE_SPHERE.travel[wanted], np.inf).argmin())
        way = float(EPISODE_SPHERE.travel[here, view])
        self._views.append(view)
        self._travel += way

        before = self._value
        self._value = self._judged()
        rules = self.rules
        price = rules.view_price + rules.travel_price * way
        sure = rules.threshold is not None and self._belief.max() >= rules.threshold
        self._over = bool(sure or len(self._views) >= rules.max_views)
        return (
            self._observed(),
            self._value - before - price,
            self._over,
            False,
            self._info(),
        )

    def _judged(self) -> float:
        """Return the current objective."""
        assert self._episode is not None
        self._belief = self._episode.verified(self._views)[0].belief
        logs = np.log(np.maximum(self._belief, LEAST_PAID_BELIEF))[None]
        truth = np.array([self._episode.thing])
        return float(value_of(logs, truth, self.rules.objective)[0])

    def _observed(self) -> dict[str, Any]:
        assert self._episode is not None
        outlook = self._episode.outlook(self._views)
        leading = outlook.hypotheses
        count = len(leading.things)
        order = np.argsort(-leading.belief, kind="stable")
        reached = cells_from(EPISODE_SPHERE)[self._views[-1]]
        cameras = outlook.cameras(
            EPISODE_SPHERE.directions[[*reached, self._views[-1]]]
        )

        belief = np.zeros(MOST_LEADING, np.float32)
        belief[:count] = leading.belief[order]
        things = np.full(MOST_LEADING, len(self.things.names))
        things[:count] = leading.things[order]
        poses = np.zeros((MOST_LEADING, 3, 4), np.float32)
        poses[:count] = (np.linalg.inv(cameras[-1]) @ leading.poses[order])[:, :3]
        information = outlook.expect(cameras[:-1]).information()
        return {
            "belief": self._belief.astype(np.float32),
            "hypotheses": belief,
            "things": things,
            "poses": poses.clip(-FAR_METRES, FAR_METRES),
            "information": information.astype(np.float32).clip(0, MOST_NATS),
            "visited": np.isin(reached, self._views).astype(np.int8),
        }

    def _info(self) -> dict[str, Any]:
        assert self._episode is not None
        return {
            "object": self._episode.thing,
            "view": self._views[-1],
            "n_views": len(self._views),
            "travel": self._travel,
            "answer": int(self._belief.argmax()),
            "confidence": float(self._belief.max()),
            "travel_to": EPISODE_SPHERE.travel[self._views[-1]][
                cells_from(EPISODE_SPHERE)[self._views[-1]]
            ],
        }
