"""Several collections at once: a thing by its geometry, else a class, else none of them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import box
from test_poses import known, meshes, metric_scans  # noqa: F401  (fixtures)

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import ModelError
from nextview.geometry.mesh import make_mesh
from nextview.recognition.inference import Models, NetworkRecogniser
from nextview.session.recogniser import ThingRecogniser
from nextview.session.several import SeveralRecognisers


def memory_of(folder) -> ThingRecogniser:
    return ThingRecogniser(folder / "memory.json", 1)


@pytest.fixture(scope="module")
def several(known):  # noqa: F811
    return SeveralRecognisers(
        {"modelnet10": NetworkRecogniser(threads=1), "mine": memory_of(known)}
    )


@pytest.fixture(scope="module")
def system(several):
    return replace(
        nextview.load(threads=1, policy="spread", unknown=0.02),
        models=Models(several, {}),
    )


@pytest.fixture(scope="module")
def alone():
    """The network without memories."""
    return nextview.load(threads=1, policy="spread")


def test_memories_take_precedence_and_shared_names_are_distinguished(several, known):  # noqa: F811
    assert several.classes[:4] == ("block", "bottle", "carton", "mug")
    assert several.classes[4:] == NetworkRecogniser(threads=1).classes
    twice = SeveralRecognisers({"mine": memory_of(known), "theirs": memory_of(known)})
    assert twice.classes[0] == "block (mine)"
    assert twice.classes[4] == "block (theirs)"


def test_the_accuracy_of_the_cameras_is_that_of_all_memories(several):
    library = several.for_cameras(0.001, 0.002).library
    assert library.camera == (0.002, 0.001)


@pytest.mark.parametrize("name", ["mug", "block"])
def test_a_thing_is_named_with_its_pose(system, meshes, name):  # noqa: F811
    result = system.recognise(meshes[name], seed=2)
    assert result.answer == name
    assert result.confident
    assert result.pose_of == name
    assert result.beliefs[name] > 0.9


@pytest.mark.parametrize("name", ["chair", "table", "monitor"])
@pytest.mark.parametrize("unit", ["cm", None])
def test_a_class_is_named_where_no_thing_explains_what_is_seen(
    system, alone, name, unit
):
    shown = replace(sample_mesh(name), unit=unit)
    result = system.recognise(shown, start=12, seed=2)
    assert result.answer == name
    assert result.pose is None
    assert result.why_no_pose
    by_network = alone.recognise(shown, start=12, seed=2)
    ours = result.views[0].belief[4:]
    np.testing.assert_allclose(
        ours / ours.sum(), by_network.views[0].belief, atol=0.02 if unit else 1e-6
    )


def test_an_object_of_neither_kind_is_unknown(system):
    ring = trimesh.creation.torus(0.09, 0.008)
    stranger = trimesh.util.concatenate(
        [ring, box((0.01, 0.01, 0.14), (0.09, 0, 0.07))]
    )
    result = system.recognise(
        make_mesh(stranger.vertices, stranger.faces, unit="m"), seed=1
    )
    assert result.unknown
    assert (result.answer, result.pose) == (None, None)


def test_incompatible_models_are_rejected():
    network = NetworkRecogniser(threads=1)
    with pytest.raises(ModelError):
        SeveralRecognisers({"a": network, "b": network})
