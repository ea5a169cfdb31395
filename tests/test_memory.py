"""A memory of taught things whose hash is right, but whose values do not fit: each is refused in
one sentence.
"""

import json
import shutil

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from nextview.errors import ModelError
from nextview.files import sha256_of
from nextview.geometry.mesh import load_mesh
from nextview.recognition.model_card import read_card
from nextview.session.recogniser import open_recogniser
from nextview.things.memory import open_memory

FLOATS = ("rotations", "radii", "boxes")
ARRAYS = (*FLOATS, "pictures", "places", "faces", "counts")


@pytest.fixture
def models(knobs_memory, tmp_path):
    """A copy of a memory of three things."""
    return shutil.copytree(knobs_memory, tmp_path / "mine")


def open_weights(models):
    return load_file(read_card(models / "memory.json").path)


def write_weights(models, arrays):
    """Replace the arrays of a memory; the card has the new hash, and the file's name of earlier
    versions.
    """
    weights, card = models / "memory.safetensors", models / "memory.json"
    ordered = {name: np.array(values, order="C") for name, values in arrays.items()}
    save_file(ordered, weights)
    about = json.loads(card.read_text())
    card.write_text(json.dumps(about | {"sha256": sha256_of(weights)}))


def with_value(values, value):
    changed = values.copy()
    changed.flat[-1] = value
    return changed


def lengthened(values, axis):
    return np.concatenate([values, values.take([-1], axis)], axis)


OF_EACH = {
    "one dimension less": lambda values: values[0],
    "empty": lambda values: values[:0],
    "16-bit integers": lambda values: (
        values.astype(np.uint16) if values.dtype.kind == "f" else values / 1
    ),
}
OF_FLOATS = {
    "NaN": lambda values: with_value(values, np.nan),
    "infinite": lambda values: with_value(values, np.inf),
}
OF_ONE = {
    ("rotations", "mirrored"): lambda values: -values,
    ("radii", "zero"): lambda values: values * 0,
    ("radii", "negative"): lambda values: values * 0 - 0.1,
    ("radii", "finite, but absurd"): lambda values: values * 0 + 1e30,
    ("faces", "beyond the last"): lambda values: with_value(values, len(values)),
    ("faces", "all of one vertex"): lambda values: values * 0,
    ("counts", "negative"): lambda values: values * (-1, 1),
    ("counts", "none of one thing"): lambda values: values * [[2], [1], [0]],
    ("boxes", "mirrored"): lambda values: -values,
    ("boxes", "without extent"): lambda values: values * 0,
}


def array_mutations():
    for name in ARRAYS:
        yield name, "one less", lambda values: values[:-1]
        yield name, "one more", lambda values: lengthened(values, 0)
        yield name, "gone", lambda values: None
        for how, change in OF_EACH.items():
            yield name, how, change
    for name in FLOATS:
        for how, change in OF_FLOATS.items():
            yield name, how, change
    for (name, how), change in OF_ONE.items():
        yield name, how, change


@pytest.mark.parametrize("array", ARRAYS)
def test_every_array_is_checked(models, array):
    card, weights = (models / "memory.json").read_bytes(), open_weights(models)
    for name, how, change in array_mutations():
        if name == array:
            changed = change(weights[name])
            arrays = {key: values for key, values in weights.items() if key != name}
            write_weights(models, arrays | ({} if changed is None else {name: changed}))
            with pytest.raises(ModelError):
                open_memory(models / "memory.json")
                pytest.fail(how)
            (models / "memory.json").write_bytes(card)


def set_at(path, value):
    """A change that sets a field of a card; "novelty/0/3" is the fourth value of a list in a
    list.
    """

    def change(about):
        *above, last = [int(key) if key.isdigit() else key for key in path.split("/")]
        for key in above:
            about = about[key]
        about[last] = value(about[last]) if callable(value) else value

    return change


REFUSED = {
    "one class more": set_at("classes", lambda names: [*names, "mug"]),
    "one hypothesis more": set_at("calibration/hypotheses", lambda h: [*h, h[-1]]),
    "negative correlation": set_at("calibration/correlation", -0.1),
    "a temperature of next to nothing": set_at("calibration/temperature", 1e-30),
    "sizes of one class less": set_at("size/log_density", lambda rows: rows[:-1]),
    "one thing more": set_at("memory/things", lambda t: [*t, t[-1] | {"name": "mug"}]),
    "a thing twice": set_at("memory/things", lambda t: [*t[:-1], t[0]]),
    "no things": set_at("memory/things", []),
    "things by features of an earlier version": set_at("azimuth_bins", 16),
    "a symmetry about no axis": set_at(
        "memory/things/0/symmetries", [{"axis": [0, 0, 0], "order": 2}]
    ),
    "an unknown field": set_at("colour", "red"),
}


def test_a_card_that_does_not_fit_is_refused_by_its_name(models):
    card = models / "memory.json"
    content = card.read_text()
    for how, change in REFUSED.items():
        about = json.loads(content)
        change(about)
        card.write_text(json.dumps(about))
        with pytest.raises(ModelError):
            open_recogniser(card)
            pytest.fail(how)


def test_a_memory_of_an_earlier_version_is_read_where_it_knows_the_geometry(models):
    card, weights = models / "memory.json", open_weights(models)
    about = json.loads(card.read_text())
    gone = {"features_sha256": None, "weight": 1.0, "novelty": [], "usual": []}
    about["memory"] |= gone
    about["memory"]["things"] = [
        one | {"poses": 1} for one in about["memory"]["things"]
    ]
    card.write_text(json.dumps(about))
    things = len(weights["radii"])
    views = np.zeros((things, 5, 16, 0), np.float16)
    write_weights(models, weights | {"thing": np.arange(things), "views": views})
    assert open_recogniser(card).library.names == ("can", "knob", "plain")


def test_a_memory_holds_the_surface_of_each_thing_in_the_frame_of_its_file(
    knobs_memory, knobs
):
    library = open_recogniser(knobs_memory / "memory.json").library
    meshes = {path.stem: load_mesh(path, unit="m") for path in sorted(knobs.iterdir())}
    assert library.names == tuple(meshes)
    for surface, mesh in zip(library.caster.surfaces, meshes.values(), strict=True):
        in_file = mesh.vertices * mesh.radius + mesh.centre
        step = np.ptp(in_file, axis=0).max() / 65535
        np.testing.assert_allclose(surface.vertices, in_file, atol=step)
        np.testing.assert_array_equal(surface.faces, mesh.faces)
