"""Test what was taught: are things named correctly in simulated views of a sensor?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.random import Generator

from nextview.geometry.mesh import make_mesh
from nextview.geometry.resting import rotated, stable_poses
from nextview.geometry.viewsphere import look_at_origin, rotation_z
from nextview.recognition.belief import Stopping
from nextview.sensing.observation import Observation
from nextview.session.recogniser import ThingRecogniser
from nextview.simulation.sensed_camera import SensedCamera

VIEWS_SHOWN = (1, 2, 3)  # numbers of views after which things are named
# most rendered views per test, including those that miss the thing
SHOWING_VIEWS_TRIED = 6
MOST_THINGS_SHOWN = 150  # most things in the test; more are sampled
ENOUGH_TESTS = 20  # of all things together, at least
HIGHEST = np.radians(72.0)  # elevation of the highest view


@dataclass(frozen=True)
class Shown:
    """Result of a test with one thing and some views.

    Attributes:
        thing: number of the thing.
        views: number of views.
        truth: class of the thing.
        named: class that it was given.
        confident: whether the name was confident.
        doubt: why it was not, in words; "" if it was.
    """

    thing: int
    views: int
    truth: int
    named: int
    confident: bool
    doubt: str


@dataclass(frozen=True)
class NeverConfident:
    """A thing that was confident in none of its tests, after all their views.

    Attributes:
        thing: number of the thing.
        tests: number of its tests.
        confused: class that it was most often confused with; None if it was named correctly.
        doubt: the most frequent doubt about it.
    """

    thing: int
    tests: int
    confused: int | None
    doubt: str


@dataclass(frozen=True)
class ShownThings:
    """Results of the tests.

    Attributes:
        accuracy: share of correct names after 1, 2 and 3 views; () without tests.
        confused: pairs of a true and an answered class, with the share of the cases, after two
            views.
        things: number of tested things.
        unseen: names of the things that no view showed well enough.
        never: tested things that were never confident.
    """

    accuracy: tuple[float, ...]
    confused: tuple[tuple[int, int, float], ...]
    things: int
    unseen: tuple[str, ...]
    never: tuple[NeverConfident, ...]


def to_be_shown(things: int, rng: Generator) -> list[tuple[int, int]]:
    """Choose the tests.

    Args:
        things: number of things.
        rng: samples from very many things.

    Returns:
        (thing, draw) of each test.
    """
    some = np.sort(rng.permutation(things)[:MOST_THINGS_SHOWN])
    tests = max(1, ENOUGH_TESTS // max(things, 1))
    return [(int(thing), draw) for thing in some for draw in range(tests)]


def show(card: Path, sensor: str, seed: int, item: tuple[int, int]) -> list[Shown]:
    """Test the recognition of one thing in simulated views of a sensor, in a random stable pose.

    Args:
        card: card of a memory.
        sensor: see ``sensor_named``.
        seed: seed of all draws.
        item: number of the thing, and number of the draw.

    Returns:
        Results after one or more views; empty if the thing is not visible.
    """
    thing, draw = item
    recogniser = _opened(card)
    rng = np.random.default_rng([seed, thing, draw])
    views = _views(recogniser, thing, sensor, rng)
    truth = int(recogniser.labels[thing])
    enough = Stopping.of(recogniser.calibration)

    found = []
    for count in VIEWS_SHOWN[: len(views)]:
        total = np.zeros(len(recogniser.classes))
        joint = recogniser.together(views[:count], total, count)
        sure = float(joint.belief.max()) >= float(enough.threshold_at(count))
        named = int(joint.belief.argmax())
        doubt = "" if sure else joint.doubt or "its name is not confident"
        found.append(Shown(thing, count, truth, named, sure, doubt))
    return found


@lru_cache(maxsize=1)
def _opened(card: Path) -> ThingRecogniser:
    """A memory, opened once."""
    return ThingRecogniser(card, threads=1)


def _views(
    recogniser: ThingRecogniser, thing: int, sensor: str, rng: Generator
) -> list[Observation]:
    """Random views of a thing that show it.

    Its stable pose is drawn by its probability after a throw; a thing that is known in its upright
    pose only stands.
    """
    surface = recogniser.library.caster.surfaces[thing]
    vertices = surface.vertices.astype(np.float64)
    mesh = make_mesh(vertices, surface.faces, surface.name, "m")
    about = recogniser.card.memory
    assert about is not None
    if about.things[thing].upright:
        lies = recogniser.memory.rotations[thing][None]
        shares = np.ones(1)
    else:
        stable = stable_poses(mesh)
        lies = stable.rotations
        shares = stable.shares

    turn = rotation_z(rng.uniform(0, 2 * np.pi)) @ lies[rng.choice(len(lies), p=shares)]
    camera = SensedCamera(rotated(mesh, turn), sensor, rng.spawn(1)[0])
    elevations = np.arcsin(rng.uniform(0, np.sin(HIGHEST), SHOWING_VIEWS_TRIED))
    azimuths = rng.uniform(0, 2 * np.pi, SHOWING_VIEWS_TRIED)
    found: list[Observation] = []
    for pose in look_at_origin(elevations, azimuths):
        observation = camera.observe(pose)
        if observation.seen:
            found.append(observation)
        if len(found) == max(VIEWS_SHOWN):
            break
    return found


def summary(shown: Sequence[Shown], unseen: Sequence[str]) -> ShownThings:
    """Sum up the results of tests.

    Args:
        shown: the results.
        unseen: names of the things that no view showed well enough.
    """
    accuracy = []
    for count in VIEWS_SHOWN:
        right = [one.named == one.truth for one in shown if one.views == count]
        if right:
            accuracy.append(float(np.mean(right)))

    twice = [one for one in shown if one.views == 2]
    pairs = Counter((one.truth, one.named) for one in twice if one.named != one.truth)
    of_class = Counter(one.truth for one in twice)
    confused = [(a, b, count / of_class[a]) for (a, b), count in pairs.items()]
    return ShownThings(
        tuple(accuracy),
        tuple(sorted(confused, key=lambda one: -one[2])),
        len({one.thing for one in shown}),
        tuple(unseen),
        tuple(_never(shown)),
    )


def _never(shown: Sequence[Shown]) -> list[NeverConfident]:
    """Things that were never confident and right after all views of a test."""
    found = []
    for thing in sorted({one.thing for one in shown}):
        own = [
            one for one in shown if one.thing == thing and one.views == VIEWS_SHOWN[-1]
        ]
        if not own or any(one.confident and one.named == one.truth for one in own):
            continue
        wrong = Counter(one.named for one in own if one.named != one.truth)
        confused = wrong.most_common(1)[0][0] if 2 * wrong.total() > len(own) else None
        doubts = Counter(one.doubt for one in own if one.doubt)
        doubt = doubts.most_common(1)[0][0] if doubts else ""
        found.append(NeverConfident(thing, len(own), confused, doubt))
    return found
