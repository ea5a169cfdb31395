"""Fixtures that all tests share: one tiny pipeline, built once per run, also by several
pytest-xdist workers.

A test that alters a file of it copies the file first. And: the order of the files; Hypothesis
without deadlines (slow is not wrong).
"""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import factories
import kept_results
import pytest
import trimesh
from factories import meshes_of
from filelock import FileLock
from hypothesis import settings

import nextview
from nextview import runtime
from nextview.data.samples import sample_mesh
from nextview.recognition.belief import Calibration
from nextview.recognition.inference import MapNetwork, Models, NetworkRecogniser
from nextview.teaching import learn as learn_module
from nextview.teaching import shown_views
from nextview.teaching.learn import learn
from nextview.things import visible_points
from nextview.things.memory import open_memory

LONG = (
    "test_training.py",
    "test_scene_changes.py",
    "test_scene.py",
    "test_poses.py",
    "test_several_cameras.py",
    "test_learn.py",
    "test_pages.py",
    "test_kills.py",
    "test_workflow.py",
)
"""Files that take longest: begun first, no process is left alone with one at the end."""

settings.register_profile("nextview", deadline=None)
settings.load_profile("nextview")


def pytest_collection_modifyitems(items):
    last = len(LONG)
    place = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path.name, last))


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Callable[[str, Callable[[Path], object]], Path]:
    """``shared(name, make)``: a folder that ``make(folder)`` fills, once for all workers."""
    root = tmp_path_factory.getbasetemp()
    root = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "shared"
    root.mkdir(exist_ok=True)

    def folder(name: str, make: Callable[[Path], object]) -> Path:
        with FileLock(root / f"{name}.lock"):
            if not (root / name).exists():
                part = root / f"{name}.part"
                shutil.rmtree(part, ignore_errors=True)
                part.mkdir()
                make(part)
                part.rename(root / name)
        return root / name

    return folder


@pytest.fixture(scope="session", autouse=True)
def few_episodes():
    """Let ``learn`` test each thing in one episode: they take most of its time, and it only tells
    their outcome.
    """
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(shown_views, "ENOUGH_TESTS", 1)
        yield


@pytest.fixture(scope="session", autouse=True)
def kept_templates():
    """Keep the templates of each memory for the whole run, not only while they are in use."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(visible_points, "_IN_USE", {})
        yield


@pytest.fixture(scope="session", autouse=True)
def kept_things(shared):
    """Teach each thing, test each memory, and find the resting poses of each thing on a table
    once in a run, in whichever tests that happens.
    """
    folder = shared("kept", lambda folder: None)
    with pytest.MonkeyPatch.context() as patched:
        for module, name, given in (
            (learn_module, "teach", kept_results.of_teach),
            (learn_module, "show", kept_results.of_show),
            (factories, "resting_poses", kept_results.of_mesh),
        ):
            function = getattr(module, name)
            kept = kept_results.Kept(function, folder, given)
            patched.setattr(module, name, kept)
        yield


@pytest.fixture(scope="session", autouse=True)
def kept_networks():
    """Prepare each file of a network once in a process, and run it in one thread: the processes of
    pytest-xdist have the other cores. Its hash is compared whenever it is opened.
    """
    prepare = runtime.OnnxFile
    prepared = {}

    def kept(content, options, opened):
        if opened not in prepared:
            options.intra_op_num_threads = 1
            prepared[opened] = prepare(content, options, opened)
        return prepared[opened]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(runtime, "OnnxFile", kept)
        yield


@pytest.fixture
def taught_afresh(monkeypatch):
    """Teach and test things as if for the first time, where a test asks for the same twice."""
    for name in ("teach", "show"):
        kept = getattr(learn_module, name)
        monkeypatch.setattr(learn_module, name, kept.function)


@pytest.fixture(scope="session")
def scans(shared) -> Path:
    """Three meshes in one folder, metres."""

    def make(folder: Path) -> None:
        for name in factories.FURNITURE:
            mesh = sample_mesh(name)
            metric = replace(mesh, vertices=0.5 * mesh.vertices)
            factories.write_off(folder / f"{name}.off", metric)

    return shared("scans", make)


@pytest.fixture(scope="session")
def taught(shared, scans) -> Path:
    """The models that know them."""
    return (
        shared(
            "taught",
            lambda folder: learn(
                scans, folder / "mine", unit="m", upright=True, workers=0
            ),
        )
        / "mine"
    )


@pytest.fixture(scope="session")
def knobs(shared) -> Path:
    """Three things in metres: a box, the same with a knob, and a can."""

    def make(folder: Path) -> None:
        body = factories.box((0.08, 0.08, 0.1), (0, 0, 0.05))
        body.export(folder / "plain.ply")
        knob = factories.box((0.02, 0.02, 0.02), (0.05, 0, 0.06))
        trimesh.util.concatenate([body, knob]).export(folder / "knob.ply")
        trimesh.creation.cylinder(0.04, 0.12).export(folder / "can.ply")

    return shared("knobs", make)


@pytest.fixture(scope="session")
def knobs_memory(shared, knobs) -> Path:
    """A memory of them."""

    def make(folder: Path) -> None:
        learn(knobs, folder / "mine", unit="m", upright=True, workers=0)

    return shared("knobs_memory", make) / "mine"


@pytest.fixture(scope="session")
def ycb():
    """The system that knows the bundled household things."""
    return nextview.load("ycb", threads=1)


@pytest.fixture(scope="session")
def ycb_meshes():
    """Some of these things, by name."""
    return meshes_of(("cracker_box", "mug", "banana", "tomato_soup_can"))


@pytest.fixture(scope="session")
def household(shared) -> Path:
    """Scans of ten things that the bundled memory knows, metres."""

    def make(folder: Path) -> None:
        names = [thing.name for thing in open_memory("ycb")[0].memory.things][:10]
        for mesh in meshes_of(names).values():
            factories.write_scan(mesh, folder)

    return shared("household", make)


@pytest.fixture(scope="session")
def furniture(shared) -> Path:
    """Meshes of boxes: FURNITURE's 3 classes, 4 for training and 2 for tests of each,
    CLASS/SPLIT/CLASS_K.off.
    """
    return shared("furniture", factories.write_furniture)


@pytest.fixture(scope="session")
def models(shared) -> Path:
    """A folder of tiny networks for FURNITURE: tiny.json (recogniser, 8 azimuth bins,
    calibrated), tiny-lem.json.
    """

    def make(folder: Path) -> None:
        card = factories.make_recogniser(
            folder, factories.FURNITURE, size=32, azimuth_bins=8
        )
        calibration = {"temperature": 0.8, "correlation": 0.3, "bin_correlation": 0.2}
        held_out = [f"{label}_{k}" for label in factories.FURNITURE for k in (2, 3)]
        factories.change_card(card, calibration=calibration, held_out=held_out)
        factories.make_map_network(folder, valleys=("table",))

    return shared("models", make)


@pytest.fixture(scope="session")
def tiny(models):
    """They, opened, with a calibration of several views: by no views at all one cannot divide."""
    recogniser = NetworkRecogniser(models / "tiny.json")
    recogniser.calibration = Calibration(0.8, 1.0, bin_correlation=1.5)
    return Models(recogniser, {"lem": MapNetwork(models / "tiny-lem.json")})
