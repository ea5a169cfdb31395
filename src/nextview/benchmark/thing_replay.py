"""A policy replayed in one episode, and the record of what it made of it."""

import time
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from nextview.benchmark.thing_episodes import ThingEpisode
from nextview.benchmark.thing_policies import THING_POLICIES
from nextview.errors import PolicyError
from nextview.policies.base import Policy


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
