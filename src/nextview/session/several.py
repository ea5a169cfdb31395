"""Several collections in one recogniser: memories of taught things, and classes of a network."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from nextview.errors import ModelError
from nextview.geometry.viewsphere import azimuth_of, direction_of
from nextview.recognition.belief import PLAIN_SUM, Calibration, log_evidence_of
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import NetworkRecogniser
from nextview.recognition.novelty import Novelty, Quantiles, ViewScore, values_of
from nextview.recognition.protocol import JointBelief, least_p_value
from nextview.sensing.observation import Observation
from nextview.session.recogniser import ThingRecogniser
from nextview.things.library import Library
from nextview.things.surface import Surface
from nextview.types import Float, Floats

EXPLAINED = 0.02  # p-value from which a scan explains the views
OTHERS = 1e-3  # share of the belief for all collections except the one that answers
LEAST_MODEL_BELIEF = 1e-12  # lower bound of a belief before its logarithm


class SeveralRecognisers:
    """Answers with a taught thing if its geometry explains the views, otherwise with a class.

    Attributes:
        name: name of all collections together.
        classes: names of things and classes, concatenated over the collections. A name that occurs
            in two collections is followed by the name of its collection.
        azimuth_bins: 0: each collection has its own azimuth bins.
        calibration: the plain sum; each collection has its own calibration.
        novelty: None: the novelty of an object follows from all views together.
        members: the recognisers, the memories before the network.
    """

    azimuth_bins = 0
    calibration: Calibration = PLAIN_SUM

    def __init__(self, members: dict[str, NetworkRecogniser]) -> None:
        """Combine collections.

        Args:
            members: recognisers by the names of their collections: memories of things, and at most
                one network, which is moved to the end.

        Raises:
            ModelError: there are two networks, or no memory.
        """
        memories: dict[str, ThingRecogniser] = {}
        networks: dict[str, NetworkRecogniser] = {}
        for name, member in members.items():
            if isinstance(member, ThingRecogniser):
                memories[name] = member
            else:
                networks[name] = member
        if len(networks) > 1 or not memories:
            together = ", ".join(members)
            raise ModelError(
                f"{together}: several collections are memories of things and at most one network"
            )

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
        """The attributes without the cached evidence of observations."""
        left_out = ("_said", "_novelties")
        return {
            name: value for name, value in vars(self).items() if name not in left_out
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(
            state,
            _said=WeakKeyDictionary(),
            _novelties=WeakKeyDictionary(),
        )

    @property
    def least_p_value(self) -> float:
        """Largest of the smallest p-values of the collections: each of them may have to tell."""
        return max(least_p_value(member) for member in self.members)

    @cached_property
    def library(self) -> Library:
        """The things of known geometry of all collections, by their names in ``classes``."""
        surfaces: list[Surface] = []
        symmetries: dict[str, Any] = {}
        near: dict[str, Float] = {}
        turns: dict[str, Float] = {}
        first = 0
        for memory in self.memories:
            for surface, label in zip(
                memory.library.caster.surfaces, memory.labels, strict=True
            ):
                name = self.classes[first + int(label)]
                symmetries[name] = memory.library.symmetries.get(surface.name)
                near[name] = memory.library.near[surface.name]
                turns[name] = memory.library.turns[surface.name]
                surfaces.append(replace(surface, name=name))
            first += len(memory.classes)
        aim, place = self.memories[0].library.camera
        return Library(surfaces, symmetries, near, turns).for_cameras(place, aim)

    def without(self, names: Collection[str]) -> SeveralRecognisers:
        """The same recogniser for an object that is none of some taught things.

        Args:
            names: of the things, as in ``classes``.

        Raises:
            ModelError: one is a class of the network.
        """
        members: dict[str, NetworkRecogniser] = {}
        first = 0
        for name, member in self._collections.items():
            last = first + len(member.classes)
            shown = zip(self.classes[first:last], member.classes, strict=True)
            own = [alone for as_told, alone in shown if as_told in names]
            first = last
            if own and not isinstance(member, ThingRecogniser):
                raise ModelError(
                    f"{own[0]} is a class of a network; only taught things are ruled out"
                )
            members[name] = (
                member.without(own) if isinstance(member, ThingRecogniser) else member
            )
        return SeveralRecognisers(members)

    def for_cameras(self, place: float, aim: float) -> SeveralRecognisers:
        """The same recogniser for cameras with another pose accuracy.

        Args:
            place: standard deviation of the position of a camera along each axis, metres.
            aim: standard deviation of its viewing direction, radians.

        Returns:
            A copy that shares the memories.
        """
        members: dict[str, NetworkRecogniser] = {}
        for name, member in self._collections.items():
            if isinstance(member, ThingRecogniser):
                members[name] = member.for_cameras(place, aim)
            else:
                members[name] = member
        return SeveralRecognisers(members)

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """Evidence of each view, with equal prior for each collection; only policies use it.

        Args:
            observations: the views.

        Returns:
            Their evidence.
        """
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
        """Belief about an object, given all its views.

        Args:
            observations: the views, in one object frame; each shows the object.
            total: not used: each collection sums its own evidence.
            counted: number of views.

        Returns:
            The belief in the classes of all collections, and the candidate poses.
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
        """The state from which the memory that answers chooses the next view.

        Args:
            observations: the views.
            joint: result of ``together`` for them.

        Returns:
            The outlook; None if a class answers.
        """
        if joint.found is None:
            return None
        member, own = joint.found
        return None if own is None else self.memories[member].outlook(observations, own)

    def _placed(self, member: int, joint: JointBelief) -> JointBelief:
        """Embed the belief of one collection in the classes of all."""
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
        """p-value of the novelty among objects of the network's classes; None without a novelty
        score.
        """
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
    """Explain why no taught thing is the answer."""
    return joint.why_no_pose or "it is a class, and none of the taught things"


def _told_apart(classes: dict[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Names of all classes; a name that occurs twice is followed by its collection."""
    every = [name for names in classes.values() for name in names]
    twice = {name for name in every if every.count(name) > 1}
    return tuple(
        f"{name} ({collection})" if name in twice else name
        for collection, names in classes.items()
        for name in names
    )
