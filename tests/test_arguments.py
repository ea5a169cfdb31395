"""Wrong arguments at every door of the Python interface: one sentence of nextview's own, never another error."""

import inspect
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import nextview
from nextview.arguments import as_line, takes_paths
from nextview.cameras.captured import read_capture
from nextview.cameras.sensors import SensedCamera, Sensor, SensorMix, sensor_named
from nextview.data.downloading import Archive, download
from nextview.data.measuring import measure
from nextview.data.predicting import predict
from nextview.data.predictions import Predictions
from nextview.data.rendering import render
from nextview.data.samples import sample_mesh
from nextview.data.store import ViewStore
from nextview.errors import NextviewError, UsageError
from nextview.measures.depth_entropy import depth_entropy, normalise_per_object
from nextview.measures.measured_view import MeasuredView
from nextview.measures.registry import find_measure
from nextview.models.collection import find_models
from nextview.models.model_card import find_card, read_card
from nextview.occupancy import Occupancy, SeenScene, VoxelGrid, expected_visibility, new_surface, new_volume
from nextview.occupancy.line_of_sight import visible_share
from nextview.sensing import Box, Frame, ObjectFrame, ObservedObject
from nextview.training.recipes import AgentRecipe, GainRecipe, MapRecipe, RecogniserRecipe
from nextview.viewsphere import viewpoints_of
from nextview.worlds import Placement, Scene, World, WorldCamera, build_scene
from nextview.worlds.drawing import Meshes, draw_world
from nextview.worlds.occluded_camera import OccludedCamera, SceneCamera
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
SCENE, GRID, PLACES = Scene(MESH), VoxelGrid(16), 3 * np.eye(3)
UNSEEN = Occupancy.unseen(GRID)


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
    **arguments(OccludedCamera, "scene size distance", scene=SCENE, size=32),
    **arguments(OccludedCamera(SCENE, 32).observe, "pose"),
    **arguments(SceneCamera, "scene intrinsics shape", scene=SCENE, intrinsics=SEEN.intrinsics, shape=(32, 32)),
    **arguments(SceneCamera(SCENE, SEEN.intrinsics, (32, 32)).look, "pose"),
    **arguments(SCENE.clearance, "positions"),
    **arguments(SCENE.reachable, "positions"),
    **arguments(Meshes, "folder files", folder=FILE, files=("chair.off",)),
    **arguments(
        draw_world,
        "target meshes level seed name",
        target="none.off",
        meshes=Meshes(FILE, ()),
        level="light",
        seed=0,
        name="a",
    ),
    **arguments(depth_entropy, "depth"),
    **arguments(MeasuredView, "depth", pose=SEEN.pose, intrinsics=SEEN.intrinsics),
    **arguments(normalise_per_object, "values"),
    **arguments(VoxelGrid, "n half centre"),
    **arguments(Occupancy.unseen, "grid region", grid=GRID),
    **arguments(
        UNSEEN.seen,
        "depth pose intrinsics object_mask",
        **{name: getattr(SEEN, name) for name in ("depth", "pose", "intrinsics")},
    ),
    **arguments(new_volume, "occupancy positions region", occupancy=UNSEEN, positions=PLACES),
    **arguments(new_surface, "occupancy positions region", occupancy=UNSEEN, positions=PLACES),
    **arguments(
        visible_share, "occupancy points positions density own", occupancy=UNSEEN, points=np.eye(3), positions=PLACES
    ),
    **arguments(
        expected_visibility, "seen positions density unseen_part", seen=SeenScene.unseen(GRID), positions=PLACES
    ),
    "a field of a sensor": lambda system, junk: [replace(Sensor(), **{field.name: junk}) for field in fields(Sensor)],
    **{
        f"a recipe's {field.name}": lambda system, junk, recipe=recipe, name=field.name: recipe(**{name: junk})
        for recipe in (RecogniserRecipe, MapRecipe, GainRecipe, AgentRecipe)
        for field in fields(recipe)
        if field.name != "measure"  # any word
    },
    **arguments(find_models, "models"),
    **arguments(find_card, "model"),
    **arguments(Archive, "url size sha256 folder", url="http://127.0.0.1/x.zip", size=1, sha256="0" * 64, folder="x"),
    **arguments(ViewStore.open, "path"),
    **arguments(Predictions.load, "path"),
    **arguments(read_card, "path"),
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


NO_PATHS = [5, True, b"x", object(), np.zeros(3), {}, "a\0b", Path("a\0b")]


@takes_paths("one", "other", many=("several",))
def taking(one, other=None, several=(), rest=None):
    return one, other, several, rest


def test_paths_may_be_strings_and_nothing_else():
    assert taking("a", None, ["b", Path("c")], "d") == (Path("a"), None, (Path("b"), Path("c")), "d")
    assert taking(Path("a")) == (Path("a"), None, (), None)
    for wrong in [*NO_PATHS, [Path("a")]]:
        for arguments in ({"one": wrong}, {"one": "a", "other": wrong}, {"one": "a", "several": [wrong]}):
            with pytest.raises(UsageError, match=r"^(one|other|each of several) is a path"):
                taking(**arguments)
    with pytest.raises(UsageError, match=r"^one is a path, not None"):
        taking(None)
    with pytest.raises(UsageError, match=r"^several are several paths, not 'abc'"):
        taking("a", several="abc")


@pytest.mark.parametrize("wrong", NO_PATHS, ids=lambda wrong: type(wrong).__name__)
@pytest.mark.parametrize("stage", [render, measure, predict, download, read_capture], ids=lambda stage: stage.__name__)
def test_a_stage_looks_at_its_paths_before_it_does_anything(stage, wrong):
    """Before the first step of those that go on in steps, and whatever the other arguments are."""
    parameters = inspect.signature(stage).parameters.values()
    path = next(p.name for p in parameters if p.name in ("dataset", "path", "destination", "folder"))
    required = [p.name for p in parameters if p.default is p.empty]
    sound = {name: "anywhere" if name == "out" else None for name in required}
    with pytest.raises(UsageError, match=f"^{path} is a path"):
        stage(**sound | {path: wrong})


def test_whatever_is_handed_in_makes_one_line():
    class Mute:
        def __repr__(self):
            raise RuntimeError

    assert as_line(Mute()) == "a Mute"
    assert as_line(10**5000) == "a int"
    assert as_line("a\nb\x1b[2J" + "x" * 1000).isprintable()
