"""The Gymnasium environment ``nextview/RecogniseThings-v0``: taught things with known geometry.

The observation is the joint belief over thing and pose, represented by the leading hypotheses.
Importing ``nextview_lab.benchmark.environments`` registers the environment.
"""

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from nextview.checks import one_of, whole
from nextview.errors import DatasetError
from nextview.geometry.mesh import UNITS
from nextview.policies.learned_tables import cells_from
from nextview.teaching.thing_sources import find_things
from nextview.things.expected_model import MOST_LEADING
from nextview.types import Float, Index
from nextview_lab.benchmark.environments import Rules, ViewsEnv
from nextview_lab.benchmark.known_things import things_of
from nextview_lab.benchmark.thing_episodes import (
    EPISODE_SPHERE,
    Occlusion,
    Setting,
    ThingEpisode,
)
from nextview_lab.benchmark.thing_runs import scan_of
from nextview_lab.extras import extras
from nextview_lab.training.rollout import value_of

with extras():
    import gymnasium


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
        belief = self._episode.verified(self.views)[0].belief
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
