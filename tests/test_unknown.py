"""Objects of no class that the recogniser knows: the novelty score, how it is fitted, and what a
session answers.
"""

import hashlib
import json

import numpy as np
import pytest
import trimesh
from factories import meshed

import nextview
from nextview import ModelError, SimulatedCamera, Stopping
from nextview.cli.episode_table import print_episode
from nextview.data.samples import sample_mesh
from nextview.geometry.mesh import make_mesh
from nextview.recognition.novelty import Novelty, as_stored, read_novelty
from nextview.session.result_json import episode_as_json


def some_score(rng, f=7, neighbours=40, objects=50, levels=31, n_views=4) -> Novelty:
    return Novelty(
        quantiles=np.sort(rng.normal(size=(n_views, levels)), axis=1).astype(
            np.float32
        ),
        objects=np.array([objects]),
        neighbours=as_stored(units(rng, neighbours, f)),
        standard=np.array([[-0.8, 0.2], [-0.9, 0.1]], np.float32),
    )


def units(rng, n, f):
    rows = rng.normal(size=(n, f))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


# Files and cards


def test_a_score_is_read_as_it_was_written_and_what_is_missing_damaged_or_another_is_refused(
    tmp_path,
):
    score, path = (
        some_score(np.random.default_rng(6)),
        tmp_path / "a.novelty.safetensors",
    )
    sha256 = score.save(path)
    again = read_novelty(path, sha256)
    for name, values in vars(score).items():
        np.testing.assert_array_equal(getattr(again, name), values)
    with pytest.raises(ModelError):
        again.scores(np.zeros((1, 8)))
    with pytest.raises(ModelError):
        read_novelty(tmp_path / "b.novelty.safetensors", sha256)
    with pytest.raises(ModelError):
        read_novelty(path, "0" * 64)
    for content in (b"", b"PK\x03\x04", path.read_bytes()[:200]):
        path.write_bytes(content)
        with pytest.raises(ModelError):
            read_novelty(path, hashlib.sha256(content).hexdigest())


# Sessions


class FixedNovelty:
    """A novelty score of which a test says what it is."""

    joint = False
    least_p_value = 0.0

    def __init__(self, p):
        self.p = p

    def of_views(self, scores):
        return self.p


def recognised(p, unknown, camera=None):
    system = nextview.load()
    recogniser = system.models.recogniser
    before, recogniser.novelty = recogniser.novelty, FixedNovelty(p)
    try:
        session = nextview.Session(
            system.models,
            system.policy,
            system.sphere,
            3,
            Stopping(0.9, 2),
            unknown=unknown,
        )
        return session.run(camera or SimulatedCamera(sample_mesh("chair")))
    finally:
        recogniser.novelty = before


def test_an_object_more_novel_than_the_rate_allows_has_no_answer(capsys):
    usual, novel = recognised(0.3, 0.05), recognised(0.03, 0.05)
    print_episode(recognised(1.0, 0.05), "chair", "gain")
    assert "100 % of known objects fit as badly" in " ".join(
        capsys.readouterr().out.split()
    )
    assert (usual.answer, usual.unknown, usual.novelty) == ("chair", False, 0.3)
    assert (novel.answer, novel.unknown, novel.novelty) == (None, True, 0.03)
    assert novel.most_like == "chair"
    assert novel.confidence == 0.0
    told = "none of the 10 known classes (most like a chair): 3 % of known objects are as novel"
    assert repr(novel).startswith(told)
    assert "\n" not in repr(novel)
    told = json.loads(episode_as_json(novel, "chair"))
    assert (told["answer"], told["unknown"], told["novelty"], told["most_like"]) == (
        None,
        True,
        0.03,
        "chair",
    )
    np.testing.assert_array_equal(usual.views[0].belief, novel.views[0].belief)


@pytest.fixture(scope="module")
def wary():
    return nextview.load()


def scrambled(seed):
    """A chair whose triangles lie anywhere."""
    mesh, rng = sample_mesh("chair"), np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    corners = (
        corners
        - corners.mean(1, keepdims=True)
        + rng.uniform(-0.6, 0.6, (len(corners), 1, 3))
    )
    return make_mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def test_a_ball_and_a_scrambled_chair_are_unknown_and_the_samples_are_not(wary):
    for mesh in (meshed(trimesh.creation.icosphere(3)), scrambled(0), scrambled(1)):
        result = wary.recognise(mesh, start=3)
        assert (result.answer, result.unknown) == (None, True)
        assert result.novelty < 0.02
    for name in ("chair", "table", "monitor"):
        assert wary.recognise(sample_mesh(name), start=3).answer == name


def test_a_suspicious_object_gets_more_views_and_no_confident_answer():
    usual, suspicious = recognised(0.5, 0.05), recognised(0.2, 0.05)
    assert (usual.confident, len(usual.views)) == (True, 1)
    assert (suspicious.answer, suspicious.confident, len(suspicious.views)) == (
        "chair",
        False,
        2,
    )
