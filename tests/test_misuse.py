"""Wrong values at the doors of the Python interface: one sentence, and no other error."""

import numpy as np
import pytest

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import NextviewError
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.observed_object import ObservedObject
from nextview.simulation.sensor import Sensor

JUNK = (
    None,
    True,
    -1,
    2.5,
    np.nan,
    np.inf,
    10**40,
    "",
    "a",
    "\0",
    b"x",
    [],
    [1],
    [[1, 2], [3]],
    {"a": 1},
    object(),
    object,
    1j,
    np.zeros(0),
    np.zeros((4, 4)),
    np.array("x"),
    np.array([None]),
)
SPHERE = nextview.ViewSphere.named("40")
CAMERA = nextview.SimulatedCamera(sample_mesh("chair"), 32)
SEEN = CAMERA.observe(SPHERE.poses[3])


@pytest.fixture(scope="module")
def system():
    return nextview.load(policy="spread", threads=1)


def begun(system):
    session = system.session(start=3)
    session.update(SEEN)
    return session


def set_and_go_on(system, name, value):
    session = begun(system)
    setattr(session, name, value)
    session.update(CAMERA.observe(session.pose))


def doors(call, names, **sound):
    """A door for each of some arguments; the others are as they should be."""

    def door(name):
        return lambda system, junk: call(**(sound | {name: junk}))

    return {f"{call.__qualname__} {name}": door(name) for name in names.split()}


DOORS = {
    "recognise": lambda system, junk: system.recognise(
        sample_mesh("chair"), sensor=junk
    ),
    "session start": lambda system, junk: system.session(start=junk),
    "session seed": lambda system, junk: system.session(seed=junk),
    "session object": lambda system, junk: system.session(object=junk),
    "session distance": lambda system, junk: system.session(distance=junk),
    "update": lambda system, junk: system.session().update(junk),
    "update again": lambda system, junk: begun(system).update(junk),
    "failed": lambda system, junk: begun(system).failed(junk),
    "reachable": lambda system, junk: set_and_go_on(system, "reachable", junk),
    "travel cost": lambda system, junk: set_and_go_on(system, "travel_cost", junk),
    "Scene models": lambda system, junk: nextview.Scene(junk),
    **doors(
        nextview.load,
        "models policy threshold risk max_views viewpoints threads unknown recogniser",
        policy="spread",
    ),
    **doors(nextview.make_policy, "sphere", name="lem"),
    **doors(nextview.Stopping, "threshold max_views threshold_decay"),
    **doors(
        nextview.ViewSphere, "azimuths distance", elevations=(0.0, 30.0), azimuths=8
    ),
    **doors(nextview.Directions, "directions distance", directions=np.eye(3)),
    **doors(nextview.Directions.fibonacci, "n"),
    **doors(
        nextview.Observation,
        "depth pose intrinsics radius image",
        **{name: getattr(SEEN, name) for name in ("depth", "pose", "intrinsics")},
    ),
    **doors(
        nextview.SimulatedCamera, "size distance intrinsics", mesh=sample_mesh("chair")
    ),
    **doors(CAMERA.observe, "pose"),
    **doors(
        Frame,
        "depth intrinsics pose mask image axes pixel_centre",
        depth=SEEN.depth,
        intrinsics=SEEN.intrinsics,
    ),
    **doors(ObservedObject, "up point"),
    **doors(Box, "low high axes", low=[0, 0, 0], high=[1, 1, 1]),
    **doors(
        ObjectFrame, "centre radius axes", centre=[0, 0, 0], radius=1.0, axes=np.eye(3)
    ),
    **doors(Sensor, "noise height"),
}


@pytest.mark.parametrize("door", DOORS)
def test_a_wrong_value_is_one_sentence(system, door):
    refused = []
    for junk in JUNK:
        try:
            DOORS[door](system, junk)
        except NextviewError as error:
            refused.append(str(error))
    # The rest is what the door takes, such as None or infinity.
    assert len(refused) >= len(JUNK) - 3
    assert all(sentence.strip() and "\n" not in sentence for sentence in refused)
