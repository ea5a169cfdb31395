"""A memory of taught things whose hash is right, but whose values do not fit: each is refused in
one sentence.
"""

import json
import re
import shutil

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import nextview
from nextview.errors import ModelError
from nextview.files import sha256_of
from nextview.geometry.mesh import load_mesh
from nextview.recognition.inference import Features
from nextview.recognition.model_card import read_card
from nextview.things.memory import open_memory
from nextview.things.recogniser import open_recogniser
from nextview.things.stored_surfaces import StoredSurfaces
from nextview.things.surface import Surface

FLOATS = (
    "views",
    "rotations",
    "held_out",
    "held_out_views",
    "radii",
    "head",
    "head_bias",
    "boxes",
)
ARRAYS = (*FLOATS, "thing", "pictures", "places", "faces", "counts")


@pytest.fixture
def models(mixed_memory, tmp_path):
    """A copy of a memory of a thing of unknown size and three whose sizes are known."""
    return shutil.copytree(mixed_memory, tmp_path / "mine")


@pytest.fixture(scope="module")
def features():
    return Features(threads=1)


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


def rewrite(models, change):
    """Change the arrays of a memory."""
    arrays = open_weights(models)
    change(arrays)
    write_weights(models, arrays)


def with_value(values, value):
    changed = values.copy()
    changed.flat[-1] = value
    return changed


def lengthened(values, axis):
    return np.concatenate([values, values.take([-1], axis)], axis)


OF_EACH = {
    "0-d": lambda values: values.ravel()[0],
    "one dimension less": lambda values: values[0],
    "one dimension more": lambda values: values[None],
    "empty": lambda values: values[:0],
    "complex": lambda values: values.astype(np.complex64),
    "truth values": lambda values: values.astype(bool),
    "16-bit integers": lambda values: (
        values.astype(np.uint16) if values.dtype.kind == "f" else values / 1
    ),
}
OF_FLOATS = {
    "NaN": lambda values: with_value(values, np.nan),
    "infinite": lambda values: with_value(values, np.inf),
}
OF_ONE = {
    ("views", "twice as long"): lambda values: values * 2,
    ("rotations", "mirrored"): lambda values: -values,
    ("rotations", "sheared"): lambda values: (
        values + np.eye(3, k=1, dtype=np.float32) / 10
    ),
    ("held_out_views", "in degrees"): np.degrees,
    ("radii", "negative"): lambda values: values * 0 - 0.1,
    ("radii", "finite, but absurd"): lambda values: values * 0 + 1e30,
    ("head", "too large in all of a column"): lambda values: (
        values * 0 + 701 / np.sqrt(len(values))
    ),
    ("head_bias", "finite, but absurd"): lambda values: with_value(values, 1e30),
    ("thing", "beyond the last"): lambda values: values + 1,
    ("thing", "descending"): lambda values: values[::-1],
    ("faces", "beyond the last"): lambda values: with_value(values, len(values)),
    ("places", "of floats"): lambda values: values.astype(np.float32),
    ("places", "all in one corner"): lambda values: values * 0 + np.uint16(65535),
    ("faces", "all of one vertex"): lambda values: values * 0,
    ("counts", "negative"): lambda values: values * (-1, 1),
    ("counts", "beyond all numbers"): lambda values: values * 0 + 2**62,
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


def fewer_features(arrays):
    for name in ("views", "held_out"):
        kept = arrays[name].astype(np.float32)[..., :-1]
        arrays[name] = kept / np.maximum(
            np.linalg.norm(kept, axis=-1, keepdims=True), 1e-9
        )
    arrays["head"] = arrays["head"][:-1]


def fewer_classes(arrays):
    arrays["head"] = arrays["head"][:, :-1]
    arrays["head_bias"] = arrays["head_bias"][:-1]


def more_classes(arrays):
    arrays["head"] = lengthened(arrays["head"], 1)
    arrays["head_bias"] = lengthened(arrays["head_bias"], 0)


def fewer_things(arrays):
    for name in ("held_out", "held_out_views", "radii", "pictures"):
        arrays[name] = arrays[name][:-1]
    kept = arrays["thing"] < len(arrays["radii"])
    for name in ("views", "rotations", "thing"):
        arrays[name] = arrays[name][kept]
    vertices, faces = arrays["counts"][:-1].sum(0)
    arrays |= {"places": arrays["places"][:vertices], "faces": arrays["faces"][:faces]}
    arrays |= {name: arrays[name][:-1] for name in ("counts", "boxes")}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (fewer_features, "its views have 255 features, not 256"),
        (fewer_classes, "is of 1 classes, and its card of 2"),
        (more_classes, "is of 3 classes, and its card of 2"),
        (fewer_things, "its resting poses are not those of the things on its card"),
    ],
)
def test_arrays_that_fit_together_have_to_fit_card_and_features(
    models, change, sentence
):
    rewrite(models, change)
    with pytest.raises(
        ModelError, match=rf"^\S+/mine/memory\.safetensors: {re.escape(sentence)}"
    ):
        open_recogniser(models / "memory.json")
    with pytest.raises(ModelError):
        nextview.learn(models, models, remove=("block",))


def changed_card(models, change):
    card = models / "memory.json"
    about = json.loads(card.read_text())
    change(about)
    card.write_text(json.dumps(about))
    return card


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
    "no azimuth bins": set_at("azimuth_bins", 0),
    "other input": set_at("input", {"kind": "geometry", "size": 64}),
    "a map network": set_at("kind", "lem"),
    "one hypothesis more": set_at("calibration/hypotheses", lambda h: [*h, h[-1]]),
    "no hypotheses": set_at("calibration/hypotheses", []),
    "no calibration": lambda about: about.pop("calibration"),
    "no calibration of the bins": lambda about: about["calibration"].pop(
        "bin_correlation"
    ),
    "negative correlation": set_at("calibration/bin_correlation", -0.1),
    "a temperature of next to nothing": set_at("calibration/temperature", 1e-30),
    "endless densities of sizes": set_at("size/log_density/0/0", 1e300),
    "sizes of one class less": set_at("size/log_density", lambda rows: rows[:-1]),
    "descending sizes": set_at("size/radii_m", lambda radii: radii[::-1]),
    "one thing more": set_at("memory/things", lambda t: [*t, t[-1] | {"name": "mug"}]),
    "a thing twice": set_at("memory/things", lambda t: [*t[:-1], t[0]]),
    "no things": set_at("memory/things", []),
    "a thing without a name": set_at("memory/things/0/name", ""),
    "negative poses": set_at("memory/things/0/poses", -1),
    "other features": set_at("memory/features_sha256", "0" * 64),
    "no weight": set_at("memory/weight", 0.0),
    "endless weight": set_at("memory/weight", 1e300),
    "an empty row of novelty": set_at("memory/novelty", [[]]),
    "ragged novelty": set_at("memory/novelty/0", lambda row: row[:-1]),
    "novelty of text": set_at("memory/novelty/0/0", "NaN"),
    "an empty row of usual": set_at("memory/usual", [[]]),
    "usual of one class more": set_at(
        "memory/usual", lambda rows: [[*row, 0.0] for row in rows]
    ),
    "a symmetry of order one": set_at(
        "memory/things/0/symmetries", [{"axis": [0, 0, 1], "order": 1}]
    ),
    "a symmetry about no axis": set_at(
        "memory/things/0/symmetries", [{"axis": [0, 0, 0], "order": 2}]
    ),
    "an unknown field": set_at("memory/things/0/colour", "red"),
}


def test_a_card_that_does_not_fit_is_refused_by_its_name(models):
    card = models / "memory.json"
    content = card.read_text()
    for how, change in REFUSED.items():
        about = json.loads(content)
        change(Missing(about) if how == "an unknown field" else about)
        card.write_text(json.dumps(about))
        with pytest.raises(ModelError):
            open_recogniser(card)
            pytest.fail(how)


class Missing(dict):
    def __getitem__(self, key):
        return self.get(key)


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


def test_a_card_says_whether_there_are_features(knobs_memory, mixed_memory, tmp_path):
    features = read_card(mixed_memory / "memory.json").memory.features_sha256
    said = shutil.copytree(knobs_memory, tmp_path / "said")
    set_features = set_at("memory/features_sha256", features)
    card = changed_card(said, set_features)
    with pytest.raises(ModelError):
        open_memory(card)
    denied = shutil.copytree(mixed_memory, tmp_path / "denied")
    card = changed_card(denied, set_at("memory/features_sha256", None))
    with pytest.raises(ModelError):
        open_memory(card)
    card = changed_card(denied, set_at("azimuth_bins", 0))
    with pytest.raises(ModelError):
        open_memory(card)


def test_things_get_features_when_one_is_added_that_needs_them(
    knobs_memory, mixed_memory
):
    card, before = open_memory(knobs_memory / "memory.json")
    learned = [thing.name for thing in card.memory.things]
    card, memory = open_memory(mixed_memory / "memory.json")
    assert [thing.name for thing in card.memory.things] == ["block", "knob"]
    assert np.isnan(memory.radii).tolist() == [True, False]
    lengths = np.linalg.norm(memory.views.astype(np.float32), axis=-1)
    np.testing.assert_allclose(lengths, 1, atol=1e-2)
    # of the thing itself, as learned from its file
    (knob,) = (row for row, name in enumerate(learned) if name == "knob")
    assert memory.surfaces.counts[1].tolist() == before.surfaces.counts[knob].tolist()


def square(size, origin, name="square"):
    corners = (
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32) * size
        + origin
    )
    return Surface(
        name, corners.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    )


@pytest.mark.parametrize("many", [4, 70_000])
def test_stored_surfaces_come_back_as_they_were(many):
    rng = np.random.default_rng(3)
    points = (rng.normal(size=(many, 3)) * 0.1 + (5, -3, 1)).astype(np.float32)
    cloud = Surface("cloud", points, rng.integers(0, many, (9, 3)).astype(np.int32))
    stored = StoredSurfaces.of([square(0.3, (1, 2, 3)), None, cloud])
    assert len(stored) == 3
    assert stored.surface(1, "nothing") is None
    for number, surface in ((0, square(0.3, (1, 2, 3))), (2, cloud)):
        again = stored.surface(number, surface.name)
        np.testing.assert_allclose(
            again.vertices, surface.vertices, atol=np.ptp(points) / 65535
        )
        np.testing.assert_array_equal(again.faces, surface.faces)
