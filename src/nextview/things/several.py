"""Several collections at once: taught things by their geometry, and the classes of a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from nextview.errors import ModelError
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import azimuth_of, direction_of
from nextview.recognition.belief import PLAIN_SUM, Calibration, log_evidence_of
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import NetworkRecogniser
from nextview.recognition.novelty import Novelty, Quantiles, ViewScore, values_of
from nextview.recognition.protocol import JointBelief
from nextview.things.memory import TaughtRecogniser
from nextview.things.recogniser import VerifiedRecogniser
from nextview.types import Floats

EXPLAINED = 0.02  # p-value from which on a scan explains what is seen
OTHERS = 1e-3  # share of the belief that is left to all but the collection that answers
LEAST_MODEL_BELIEF = 1e-12  # where the logarithm of a belief is taken


class SeveralRecognisers:
    """Names a taught thing if its geometry explains what is seen; else the classes answer.

    Attributes:
        name: of all collections together.
        classes: names of things and classes, those of each collection after the other. What two
            collections know by one name is told apart by the name of the collection.
        azimuth_bins: 0: collections tell apart azimuths of their own.
        calibration: the plain sum; each collection has its own.
        novelty: None: how novel an object is follows from all views together.
        members: the recognisers, the memories before the network.
    """

    azimuth_bins = 0
    calibration: Calibration = PLAIN_SUM

    def __init__(self, members: dict[str, NetworkRecogniser]) -> None:
        """Put collections together.

        Args:
            members: by the names of the collections: memories of things with their geometry, and
                at most one network, which comes last, however it is given.

        Raises:
            ModelError: two networks, no memory, or a memory without geometry.
        """
        memories: dict[str, VerifiedRecogniser] = {}
        networks: dict[str, NetworkRecogniser] = {}
        for name, member in members.items():
            if isinstance(member, VerifiedRecogniser):
                memories[name] = member
            elif isinstance(member, TaughtRecogniser):
                what = "knows no geometry of its things, by which they are told from others"
                raise ModelError(
                    f"{name}: {what}; teach them again from meshes with --unit"
                )
            else:
                networks[name] = member
        if len(networks) > 1 or not memories:
            together = ", ".join(members)
            raise ModelError(
                f"{together}: several collections are memories of things and at most one network"
            )

        for name, memory in memories.items():
            if memory.things.residuals is None:
                what = "does not say how well its things are usually explained"
                raise ModelError(f"{name}: {what}; teach them again")
        self.memories = tuple(memories.values())
        self.network = next(iter(networks.values()), None)
        self._collections: dict[str, NetworkRecogniser] = {**memories, **networks}
        self.members = tuple(self._collections.values())
        self.name = ", ".join(memories | networks)
        self.novelty: Quantiles | None = None
        self.classes = _told_apart(
            {name: one.classes for name, one in (memories | networks).items()}
        )
        self._said: WeakKeyDictionary[Observation, list[Floats]] = WeakKeyDictionary()
        self._novelties: WeakKeyDictionary[Observation, float] = WeakKeyDictionary()

    def __getstate__(self) -> dict[str, Any]:
        """All but what was said of observations so far, and what is made of the memories."""
        left_out = ("_said", "_novelties", "in_any_orientation")
        return {
            name: value for name, value in vars(self).items() if name not in left_out
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(
            state,
            _said=WeakKeyDictionary(),
            _novelties=WeakKeyDictionary(),
        )

    @cached_property
    def in_any_orientation(self) -> SeveralRecognisers:
        """The same for things that may be held, lean or fly: they need not rest."""
        tilted: dict[str, NetworkRecogniser] = {}
        for name, member in self._collections.items():
            if isinstance(member, VerifiedRecogniser):
                tilted[name] = member.in_any_orientation
            else:
                tilted[name] = member
        return SeveralRecognisers(tilted)

    def for_cameras(self, place: float, aim: float) -> SeveralRecognisers:
        """The same for cameras whose poses are known this well.

        Args:
            place: standard deviation of a camera's place along each axis, metres.
            aim: of the direction in which it looks, radians.
        """
        members: dict[str, NetworkRecogniser] = {}
        for name, member in self._collections.items():
            if isinstance(member, VerifiedRecogniser):
                members[name] = member.for_cameras(place, aim)
            else:
                members[name] = member
        return SeveralRecognisers(members)

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """What each view speaks for, each collection being as likely: for policies alone."""
        directions = np.stack(
            [direction_of(observation.pose) for observation in observations]
        )
        azimuths = azimuth_of(directions)
        logits = []
        said: list[list[Floats]] = [[] for _ in observations]
        for member in self.members:
            found = member(observations)
            logs = log_evidence_of(found.logits, found.azimuth_bins, azimuths)
            belief = member.calibration.belief(logs, 1, len(member.classes))
            logits.append(np.log(np.maximum(belief, LEAST_MODEL_BELIEF)))
            for of_view, row in zip(said, logs, strict=True):
                of_view.append(row)

        for observation, of_view in zip(observations, said, strict=True):
            self._said[observation] = of_view
        seen = np.array([observation.seen for observation in observations])
        return Evidence(np.concatenate(logits, 1), seen=seen)

    def together(
        self,
        observations: Sequence[Observation],
        total: Floats,
        counted: int,
    ) -> JointBelief:
        """What is believed of an object by all views of it.

        Args:
            observations: the views, in one object frame; something is seen in each.
            total: is not used: each collection sums its own evidence.
            counted: how many they are.
        """
        unknown = [
            observation for observation in observations if observation not in self._said
        ]
        if unknown:
            self(unknown)
        totals = [
            np.sum([self._said[observation][k] for observation in observations], axis=0)
            for k in range(len(self.members))
        ]
        judged = [
            memory.together(observations, own, counted)
            for memory, own in zip(self.memories, totals, strict=False)
        ]
        best = int(
            np.argmax([-1.0 if one.p_value is None else one.p_value for one in judged])
        )
        explained = (
            judged[best].p_value is not None
            and (judged[best].p_value or 0) >= EXPLAINED
        )
        if explained or self.network is None:
            return self._placed(best, judged[best])

        network = self.network
        belief = network.calibration.belief(totals[-1], counted, len(network.classes))
        p_value = self._p_value_of_class(observations)
        joint = JointBelief(
            belief,
            p_value=p_value,
            why_no_pose=_why_no_pose(judged[best]),
        )
        return self._placed(len(self.memories), joint)

    def outlook(self, observations: Sequence[Observation], joint: JointBelief) -> Any:
        """Return what can be foreseen by the memory that answers.

        Args:
            observations: the views.
            joint: what they say together.

        Returns:
            The outlook; None if a class answers.
        """
        if joint.found is None:
            return None
        member, own = joint.found
        return None if own is None else self.memories[member].outlook(observations, own)

    def _placed(self, member: int, joint: JointBelief) -> JointBelief:
        """What one collection believes, as a belief in the classes of all."""
        sizes = [len(one.classes) for one in self.members]
        first = sum(sizes[:member])
        others = sum(sizes) - sizes[member]
        belief = np.full(sum(sizes), OTHERS / max(others, 1))
        belief[first : first + sizes[member]] = (
            (1 - OTHERS) * joint.belief if others else joint.belief
        )

        poses = []
        for candidate in joint.poses:
            poses.append(replace(candidate, label=first + candidate.label))
        is_memory = member < len(self.memories)
        return replace(
            joint,
            belief=belief,
            poses=tuple(poses),
            found=(member, joint) if is_memory else None,
        )

    def _p_value_of_class(self, observations: Sequence[Observation]) -> float | None:
        """Share of objects of the network's classes that are as novel; None if it does not tell."""
        network = self.network
        assert network is not None
        if not isinstance(network.novelty, Novelty):
            return None
        asked = [one for one in observations if one not in self._novelties]
        scores = [ViewScore(one, network.novelty_scores) for one in asked]
        for observation, value in zip(
            asked,
            values_of(scores, whole=True),
            strict=True,
        ):
            self._novelties[observation] = value
        return network.novelty.of_views([self._novelties[one] for one in observations])


def _why_no_pose(joint: JointBelief) -> str:
    """Why no taught thing is named, in words."""
    return joint.why_no_pose or "it is a class, and none of the taught things"


def _told_apart(classes: dict[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Names of all classes; what several collections know is followed by the collection."""
    every = [name for names in classes.values() for name in names]
    twice = {name for name in every if every.count(name) > 1}
    return tuple(
        f"{name} ({collection})" if name in twice else name
        for collection, names in classes.items()
        for name in names
    )
