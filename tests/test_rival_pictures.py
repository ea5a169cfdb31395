"""The two leading hypotheses as rendered, and the pixels in which they differ, in the explorer."""

import numpy as np
import pytest

from nextview.geometry.viewsphere import ViewSphere
from nextview.viewers.exploration import Exploration, shown_objects

SPHERE = ViewSphere.named("40")


@pytest.fixture
def walk(knobs, knobs_memory):
    """One view of the box without a knob."""
    shown = shown_objects(knobs / "plain.ply", unit="m")
    exploration = Exploration(
        shown, models=knobs_memory, sensor="wrist", start=20, threads=1
    )
    walk = exploration.walks[0]
    assert walk.rival_pictures(SPHERE.directions[0]) is None  # nothing was seen yet
    walk.step()
    return walk


def test_the_pixels_that_differ_are_those_of_the_knob(walk):
    outlook = walk.session.outlook
    names = [surface.name for surface in outlook.caster.surfaces]
    shares = []
    for view, direction in enumerate(SPHERE.directions):
        found = walk.rival_pictures(direction)
        assert {names[k] for k in found.things} == {"plain", "knob"}
        shares.append(found.share)
        # Where the knob lies, by a pinhole camera, in the picture of the hypothesis that has one.
        knob = int(np.flatnonzero([names[k] == "knob" for k in found.things])[0])
        hypotheses = outlook.hypotheses
        row = int(np.flatnonzero(hypotheses.things == found.things[knob])[0])
        place = hypotheses.poses[row] @ (0.06, 0.0, 0.06, 1.0)
        towards = place[:3] - (hypotheses.poses[row] @ (0, 0, 0.05, 1.0))[:3]
        facing = float(direction @ towards) / np.linalg.norm(towards)
        if facing > 0.9:
            assert found.share > 0.02, view
        if facing < -0.5:
            assert found.share < 0.01, view  # the body hides it
    assert max(shares) < 0.15
    assert walk.rival_pictures(SPHERE.directions[walk.next_view]).share > 0.6 * max(
        shares
    )
