"""Recogniser of taught things, by their geometry."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import NetworkRecogniser
from nextview.recognition.model_card import find_card
from nextview.recognition.protocol import JointBelief
from nextview.sensing.observation import Observation
from nextview.sensing.sighting import Sighting
from nextview.session.target import into_object, view_of
from nextview.things.fusion import cell_of
from nextview.things.library import Library, closed, near_turns
from nextview.things.memory import open_memory
from nextview.things.naming import LIKELY, named, pose_candidates, why_in_doubt
from nextview.things.world import World, aligned, balanced
from nextview.types import Floats, Index, Mask
from nextview.views.expected_views import Outlook

NO_SCALE = "the scale of the views is not known in metres"
NO_NAME = "every name is ruled out"
NOTHING_FITS = "no taught thing explains the views"
OTHER_SIZE = 5.0  # times smaller or larger than all things are: it is none of them


class ThingRecogniser(NetworkRecogniser):
    """Recognises taught things in all views together: by what explains their pixels best.

    The evidence of single views is that of the size alone.

    Attributes:
        library: the things.
        labels: class of each of them, (T,) int64.
        ruled_out: classes that the object is not, (C,) bool.
    """

    def __init__(self, model: str | Path, threads: int = 0) -> None:
        """Open a memory.

        Args:
            model: name of a bundled memory, or the path of its card.
            threads: number of threads; 0 for one on each core.

        Raises:
            ModelError: see ``open_memory``.
        """
        self.card, self.memory = open_memory(model)
        self.classes = self.card.classes
        self.azimuth_bins = 0
        self.calibration = self.card.calibration
        self.novelty = None
        self.ruled_out = np.zeros(len(self.classes), bool)
        about = self.card.memory
        assert about is not None
        surfaces = []
        for number, thing in enumerate(about.things):
            surface = self.memory.surfaces.surface(number, thing.name)
            # made of frames, and as rough as its cells
            if thing.upright and thing.sha256 is None:
                surface = replace(surface, error=cell_of(surface.radius))
            surfaces.append(surface)
        self.labels: Index = np.array(self.calibration.hypotheses)
        symmetries = {thing.name: thing.symmetries for thing in about.things}
        near = {
            thing.name: near_turns(thing.near_symmetries, thing.symmetries)
            for thing in about.things
        }
        turns = {
            thing.name: closed(near_turns(thing.near_symmetries, ()))
            for thing in about.things
        }
        self.library = Library(surfaces, symmetries, near, turns, threads)
        self._last: tuple[tuple[Observation | Sighting, ...], World] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without what was explained last."""
        return vars(self) | {"_last": None}

    def by_shape(self, observations: Sequence[Observation]) -> Evidence:
        """Uniform evidence: single views are not judged by their shape."""
        shape = len(observations), len(self.classes)
        return Evidence(np.zeros(shape, np.float32))

    def without(self, names: Collection[str]) -> ThingRecogniser:
        """The same recogniser for an object that is none of some classes.

        Args:
            names: of the classes.

        Returns:
            A copy that shares the memory.
        """
        other = copy(self)
        other.ruled_out = self.ruled_out | np.array(
            [name in names for name in self.classes]
        )
        other._last = None
        return other

    def for_cameras(self, place: float, aim: float) -> ThingRecogniser:
        """The same recogniser for cameras with another pose accuracy.

        Args:
            place: standard deviation of the position of a camera along each axis, metres.
            aim: standard deviation of its viewing direction, radians.

        Returns:
            A copy that shares the memory.
        """
        other = copy(self)
        other.library = self.library.for_cameras(place, aim)
        other._last = None
        return other

    def together(
        self,
        observations: Sequence[Observation],
        total: Floats,
        counted: int,
    ) -> JointBelief:
        """Belief about an object, given all its views.

        Args:
            observations: the views, in one object frame; each shows the object.
            total: sum of their log-evidence, (D,).
            counted: number of views.

        Returns:
            The belief in each class and the candidate poses. If the scale is not known, or no
            thing explains the views, the belief by size alone and the reason.
        """
        classes = len(self.classes)
        if self.ruled_out.all():
            belief = np.full(classes, 1 / classes)
            return JointBelief(belief, p_value=0.0, why_no_pose=NO_NAME, doubt=NO_NAME)
        alone = self.calibration.belief(total, counted, classes)
        alone = np.where(self.ruled_out, 0, alone + 1e-12)
        alone = alone / alone.sum()
        if any(observation.radius is None for observation in observations):
            return JointBelief(alone, why_no_pose=NO_SCALE, doubt=NO_SCALE)
        radius = float(observations[-1].radius or 0.0)
        radii = self.library.radii
        if not radii.min() / OTHER_SIZE < radius < radii.max() * OTHER_SIZE:
            return JointBelief(alone, p_value=0.0, why_no_pose=NOTHING_FITS)

        world = self.explained(observations)
        thing = max(
            (one for one in world.things if one.row >= 0),
            key=lambda one: one.gain,
            default=None,
        )
        found = None if thing is None else named(world, thing, ())
        if thing is None or found is None:
            unknown = max(world.things, key=lambda one: one.gain, default=None)
            return JointBelief(
                alone,
                p_value=0.0,
                why_no_pose=NOTHING_FITS,
                found=None if unknown is None else (world, unknown, (), {}),
            )
        belief = np.zeros(classes)
        labels = self.labels[world.hypotheses.things[found.rows]]
        np.add.at(belief, labels, found.probabilities)
        belief[~self.ruled_out] += 1e-12
        belief /= belief.sum()
        # a name is as likely as it is right, and the others share the rest
        best = int(belief.argmax())
        others = np.where(np.arange(classes) == best, 0, belief)
        rest = others.sum() or 1.0
        belief = np.where(
            np.arange(classes) == best, found.right, others * (1 - found.right) / rest
        )
        moves = sum(
            view.frame.camera_to_world is not view.camera for view in world.views
        )
        poses = pose_candidates(world, found, self.labels)
        to_object = into_object(observations[-1])
        return JointBelief(
            belief / belief.sum(),
            poses=tuple(one.moved(to_object) for one in poses),
            camera_error=1000 * self.library.camera[1] if moves else 0.0,
            p_value=found.right,
            doubt=why_in_doubt(world, found) if found.right < LIKELY else "",
            found=(world, thing, poses, found.beliefs(world)),
        )

    def explained(self, observations: Sequence[Observation]) -> World:
        """Return what explains the object in some views best, in the world of ``view_of``."""
        among: Mask = ~self.ruled_out[self.labels]
        # the object frame may change, and what was seen stays
        seen = tuple(one.sighting or one for one in observations)
        known = 0
        world = World(self.library, alone=True)
        if self._last is not None and self._last[0] == seen[: len(self._last[0])]:
            known = len(self._last[0])
            world = self._last[1]
        for observation in observations[known:]:
            # what is looked at is an object, and no piece of a wall
            world = replace(world.with_view(view_of(observation)), flat=())
            world = aligned(aligned(world).searched(among)).numbered()
        world = balanced(world)
        self._last = (seen, world)
        return world

    def outlook(self, observations: Sequence[Observation], joint: JointBelief) -> Any:
        """The state from which the next view is chosen.

        Args:
            observations: the views, in one object frame; each shows the object.
            joint: result of ``together`` for them.

        Returns:
            The leading hypotheses and their surroundings; None where the views show nothing.
        """
        if joint.found is None:
            return None
        world, thing, poses, beliefs = joint.found
        return Outlook.of(world, thing, poses, beliefs, into_object(observations[-1]))


def open_recogniser(model: str | Path, threads: int = 0) -> NetworkRecogniser:
    """Open a recogniser, or a memory of taught things.

    Args:
        model: name of a bundled model, or the path of its card.
        threads: number of threads; 0 for one on each core.

    Returns:
        The recogniser that the card describes.

    Raises:
        ModelError: the model is missing or damaged.
    """
    if find_card(model).memory is None:
        return NetworkRecogniser(model, threads)
    return ThingRecogniser(model, threads)
