"""Wrong arguments at every door of the Python interface: one sentence of nextview's own, never another error."""

from pathlib import Path

import numpy as np
import pytest

import nextview
from nextview.cameras.sensors import SensedCamera, Sensor, SensorMix, sensor_named
from nextview.data.samples import sample_mesh
from nextview.errors import NextviewError
from nextview.measures.registry import find_measure
from nextview.sensing import Box, Frame, ObjectFrame, ObservedObject
from nextview.viewsphere import viewpoints_of
from nextview.worlds import Placement, Scene, World, WorldCamera, build_scene
from nextview.worlds.scene import mesh_hash

Recorder = pytest.importorskip("nextview.report.recording").Recorder

JUNK = {
    "None": None, "a truth": True, "-1": -1, "a half": 2.5, "NaN": np.nan, "infinity": np.inf, "huge": 10**40,
    "no word": "", "a word": "a", "a zero byte": "\0", "bytes": b"x", "an empty list": [], "a list": [1],
    "uneven lists": [[1, 2], [3]], "a tuple": (1, 2, 3), "a dict": {"a": 1}, "an object": object(), "a class": object,
    "complex": 1j, "no array": np.zeros(0), "zeros": np.zeros((4, 4)), "an array of words": np.array("x"),
    "an array of objects": np.array([None]), "a range": range(3),
}  # fmt: skip
MESH = sample_mesh("chair")
FILE = Path(__file__).parents[1] / "samples"
SPHERE = nextview.ViewSphere.named("40")
CAMERA = nextview.SimulatedCamera(MESH, 32)
SEEN = CAMERA.observe(SPHERE.poses[3])
RNG = np.random.default_rng(0)
WORLD = World("a", "light", 0, Placement("chair.off", mesh_hash(FILE / "chair.off")))


@pytest.fixture(scope="module")
def system() -> nextview.System:
    return nextview.load(policy="spread", threads=1)


class Gives:
    """A camera that gives the same, whatever it is."""

    def __init__(self, what):
        self.what = what

    def observe(self, pose):
        return self.what


def begun(system) -> nextview.Session:
    session = system.session(start=3)
    session.update(SEEN)
    return session


def setting(name, value, session) -> None:
    setattr(session, name, value)
    session.update(CAMERA.observe(session.pose))


def arguments(call, names: str, **sound) -> dict:
    """A door for each of some arguments, the others as they should be."""
    return {
        f"{call.__name__} {name}": lambda system, junk, name=name: call(**(sound | {name: junk}))
        for name in names.split()
    }


def of_system(name: str, **arguments):
    """A door of a method of the system."""
    return lambda system, junk: getattr(system, name)(
        **{key: junk if value is ... else value for key, value in arguments.items()}
    )


DOORS = {
    "recognise": lambda system, junk: system.recognise(junk),
    "recognise a camera": lambda system, junk: system.recognise(Gives(junk)),
    **{f"recognise {name}": of_system("recognise", what=MESH, **{name: ...}) for name in ("start", "seed", "sensor")},
    "session start": of_system("session", start=...),
    "session seed": of_system("session", seed=...),
    "session object": of_system("session", object=...),
    "session distance": of_system("session", distance=...),
    "run": lambda system, junk: system.session().run(junk),
    "update": lambda system, junk: system.session().update(junk),
    "update again": lambda system, junk: begun(system).update(junk),
    "failed": lambda system, junk: begun(system).failed(junk),
    "reachable": lambda system, junk: setting("reachable", junk, begun(system)),
    "reachable, a callable": lambda system, junk: setting("travel_cost", lambda *poses: junk, begun(system)),
    "travel_cost": lambda system, junk: setting("travel_cost", junk, begun(system)),
    "evidence": lambda system, junk: system.models.evidence(junk),
    "evidence of one": lambda system, junk: system.models.evidence([junk]),
    "Session models": lambda system, junk: nextview.Session(junk, system.policy, SPHERE),
    "Session policy": lambda system, junk: nextview.Session(system.models, junk, SPHERE),
    "Session sphere": lambda system, junk: nextview.Session(system.models, system.policy, junk),
    "Session rule": lambda system, junk: nextview.Session(system.models, system.policy, SPHERE, 0, junk),
    "Session rng": lambda system, junk: nextview.Session(system.models, system.policy, SPHERE, 0, None, junk),
    "Session unknown": lambda system, junk: nextview.Session(system.models, system.policy, SPHERE, unknown=junk),
    **arguments(nextview.load, "models policy threshold risk max_views viewpoints threads unknown", policy="spread"),
    **arguments(nextview.load_mesh, "path up unit max_faces", path=next(FILE.rglob("*.off"))),
    **arguments(nextview.make_policy, "name sphere valley_classes classes", name="lem", sphere=SPHERE),
    **arguments(nextview.Stopping, "threshold max_views threshold_decay"),
    **arguments(nextview.ViewSphere, "elevations azimuths distance", elevations=(0.0, 30.0), azimuths=8),
    **arguments(nextview.Directions, "directions distance", directions=np.eye(3)),
    **arguments(nextview.Directions.fibonacci, "n"),
    **arguments(nextview.ViewSphere.named, "name"),
    **arguments(viewpoints_of, "what"),
    **arguments(
        nextview.Observation,
        "depth pose intrinsics radius image",
        **{name: getattr(SEEN, name) for name in ("depth", "pose", "intrinsics")},
    ),
    **arguments(nextview.SimulatedCamera, "mesh size distance intrinsics shape", mesh=MESH, size=32),
    **arguments(CAMERA.observe, "pose"),
    **arguments(sensor_named, "text"),
    "Sensor": lambda system, junk: Sensor(noise=junk),
    "SensorMix": lambda system, junk: SensorMix(junk),
    "find_measure": lambda system, junk: find_measure(junk),
    "World.load": lambda system, junk: World.load(junk),
    "Recorder": lambda system, junk: Recorder(junk),
    **arguments(build_scene, "world meshes max_faces", world=WORLD, meshes=FILE),
    **arguments(WorldCamera, "scene sensor rng named viewpoints", scene=Scene(MESH)),
    **arguments(SensedCamera, "mesh sensor rng", mesh=MESH, sensor="kinect", rng=RNG),
    **arguments(
        Frame, "depth intrinsics pose mask image axes pixel_centre", depth=SEEN.depth, intrinsics=SEEN.intrinsics
    ),
    **arguments(ObservedObject, "up point box known rng"),
    **arguments(ObservedObject().add, "frame"),
    **arguments(Box, "low high axes", low=[0, 0, 0], high=[1, 1, 1]),
    **arguments(ObjectFrame, "centre radius axes", centre=[0, 0, 0], radius=1.0, axes=np.eye(3)),
}


@pytest.mark.parametrize("door", DOORS)
def test_a_wrong_argument_is_one_sentence(system, door):
    refused = []
    for what in JUNK.values():
        try:
            DOORS[door](system, what)
        except NextviewError as error:
            refused.append(str(error))
    assert len(refused) > len(JUNK) // 3
    assert all(said.strip() and "\n" not in said for said in refused)
