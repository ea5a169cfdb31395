"""Objects of no class that the recogniser knows: the novelty score, how it is fitted, and what a session answers."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.stats import kstest
from tests.tiny_models import make_recogniser

import nextview
from nextview import ModelError, SimulatedCamera, Stopping, UsageError
from nextview.calibration import stages
from nextview.calibration.novelty_score import fit_novelty, fit_perceptron, quantiles
from nextview.calibration.outliers import FAMILIES, make_up, rotation, turned_on_a_lathe
from nextview.cli.episode_table import as_json
from nextview.cli.main import main
from nextview.data.rendering import render
from nextview.data.samples import sample_mesh
from nextview.mesh import make_mesh
from nextview.models.inference import Recogniser
from nextview.models.model_card import read_card, write_card
from nextview.novelty import NEIGHBOUR, Novelty, novelty_path, read_novelty
from nextview.policies.base import Evidence
from nextview.viewsphere import ViewSphere


def some_score(rng, f=7, d=3, h=5, neighbours=40, objects=50, levels=31, n_views=4) -> Novelty:
    rows = rng.normal(size=(neighbours, d))
    return Novelty(
        middle=rng.normal(size=f).astype(np.float32),
        directions=rng.normal(size=(f, d)).astype(np.float16).astype(np.float32),
        neighbours=(rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float16).astype(np.float32),
        hidden=rng.normal(size=(f, h)).astype(np.float16).astype(np.float32),
        hidden_bias=rng.normal(size=h).astype(np.float32),
        output=rng.normal(size=h).astype(np.float32),
        output_bias=rng.normal(size=1).astype(np.float32),
        standard=np.array([[-0.8, 0.2], [1.5, 2.0]], np.float32),
        quantiles=np.sort(rng.normal(size=(n_views, levels)), axis=1).astype(np.float32),
        objects=np.array([objects]),
    )


# The score


def test_the_score_is_what_brute_force_gives():
    rng = np.random.default_rng(0)
    score, features = some_score(rng), rng.normal(size=(20, 7)).astype(np.float32)
    on = (features - score.middle) @ score.directions
    # Between unit vectors the squared distance is 2 less twice their product; the rows are units up to half precision.
    on /= np.linalg.norm(on, axis=1, keepdims=True)
    lengths = (score.neighbours**2).sum(1)
    products = (1 + lengths - cdist(on, score.neighbours) ** 2) / 2
    for row, found in enumerate(score.scores(features)):
        tenth = sorted(products[row], reverse=True)[NEIGHBOUR - 1]
        logit = score.output_bias[0]
        for j in range(5):
            units = sum(score.hidden[i, j] * (features[row, i] - score.middle[i]) for i in range(7))
            logit += score.output[j] * np.tanh(units + score.hidden_bias[j])
        assert found == pytest.approx((-tenth + 0.8) / 0.2 + (logit - 1.5) / 2.0, abs=1e-4)
    np.testing.assert_allclose(score.scores(features[:1]), score.scores(features)[:1], atol=1e-5)


@given(st.floats(-1e6, 1e6), st.floats(0, 1e6), st.integers(1, 9))
def test_a_stranger_object_has_no_higher_p_value(score, more, n_views):
    novelty = some_score(np.random.default_rng(1))
    first, second = novelty.p_value(score, n_views), novelty.p_value(score + more, n_views)
    assert 1 / 51 - 1e-12 <= second <= first <= 1


def test_p_values_beyond_the_last_quantiles_are_those_of_the_last():
    novelty, at = some_score(np.random.default_rng(1)), np.linspace(-3, 3, 20)
    np.testing.assert_array_equal(novelty.p_value(at, 4), novelty.p_value(at, 40))
    mixed = novelty.p_value(at, np.arange(20) % 6 + 1)
    np.testing.assert_array_equal(mixed, [novelty.p_value(x, k % 6 + 1) for k, x in enumerate(at)])


def test_p_values_of_objects_like_the_held_out_ones_are_uniform():
    """Of 4,000 objects, each with a mean of its own around which its views scatter, at 400 held-out ones."""
    rng = np.random.default_rng(2)

    def scores(n):
        return rng.gamma(3, size=(n, 1)) + rng.normal(size=(n, 12))

    labels = rng.choice(3, 400, p=(0.6, 0.3, 0.1))
    table = quantiles(scores(400), labels, 5)
    novelty = replace(some_score(rng), quantiles=table, objects=np.array([400]))
    for n in range(1, 6):
        p = novelty.p_value(scores(4000)[:, :n].mean(1), n)
        assert kstest(p, "uniform").statistic < 0.09  # 1.36 / sqrt(400) of the held-out ones, more as classes differ
        assert (p < 0.05).mean() == pytest.approx(0.05, abs=0.035)


def test_quantiles_weigh_the_classes_evenly():
    """Nine objects of one class score 0 to 8, one of another 100: half of the known objects are like that one."""
    scores = np.repeat(np.array([*range(9), 100.0])[:, None], 3, axis=1)
    table = quantiles(scores, np.array([0] * 9 + [1]), 3)
    assert table.shape == (3, 201)
    for row in table:  # one, two or three views of each object: the same
        assert row[0] == 0
        assert row[-1] == 100
        assert row[50] == pytest.approx(4, abs=0.5)  # a quarter of all is half of the first class
    assert table[2][150] == pytest.approx(100)


# Fitting


def test_the_perceptron_tells_a_ring_from_what_is_in_it():
    """No straight line does."""
    rng = np.random.default_rng(3)

    def ring(n):
        angle = rng.uniform(0, 2 * np.pi, n)
        return np.stack([3 * np.cos(angle), 3 * np.sin(angle)], 1) + rng.normal(size=(n, 2)) * 0.2 + (5, 7)

    def inside(n):
        return rng.normal(size=(n, 2)) * 0.5 + (5, 7)

    hidden, bias, output, last = fit_perceptron(inside(300), rng.integers(2, size=300), ring(500), rng)
    for rows, sign in ((inside(200), -1), (ring(200), 1)):
        assert (sign * (np.tanh(rows @ hidden + bias) @ output + last) > 0).mean() > 0.98


def test_what_is_fitted_finds_the_strange_and_keeps_the_rate_that_was_asked_for():
    rng, centres = np.random.default_rng(4), 6 * np.eye(3, 12)

    def objects(n, middle, views=12):
        return middle[:, None] + rng.normal(size=(n, 1, 12)) * 0.5 + rng.normal(size=(n, views, 12))

    def known(n):
        labels = rng.integers(3, size=n)
        return objects(n, centres[labels]), labels

    learned, labels = known(300)
    held_out, held_out_labels = known(300)
    made_up = rng.normal(size=(600, 12)) * 4
    score = fit_novelty(
        learned[:, :3].reshape(-1, 12).astype(np.float32),
        labels.repeat(3),
        made_up.astype(np.float32),
        held_out.astype(np.float32),
        held_out_labels,
        rng,
    )
    fresh, _ = known(2000)
    strange = objects(500, np.tile(6 * np.eye(12)[7], (500, 1)))  # of a class that nobody made up
    for n in (1, 3):
        p = [
            score.p_value(score.scores(rows[:, :n].reshape(-1, 12)).reshape(-1, n).mean(1), n)
            for rows in (fresh, strange)
        ]
        assert (p[0] < 0.05).mean() == pytest.approx(0.05, abs=0.03)
        assert (p[1] < 0.05).mean() > 0.9


@pytest.mark.parametrize("family", FAMILIES)
def test_made_up_objects_are_meshes_and_the_same_for_the_same_seed(family):
    one, other = sample_mesh("chair"), sample_mesh("table")
    for seed in range(20):
        made, again = (make_up(family, one, other, np.random.default_rng(seed)) for _ in range(2))
        np.testing.assert_array_equal(made.vertices, again.vertices)
        assert np.linalg.norm(made.vertices, axis=1).max() == pytest.approx(1)
    if family == "cut":
        assert len(one.faces) / 4 - 1 <= len(made.faces) <= 3 * len(one.faces) / 4 + 1


def test_rotations_are_rotations_in_every_direction():
    rng = np.random.default_rng(5)
    turned = np.array([rotation(rng) for _ in range(4000)])
    np.testing.assert_allclose(turned @ turned.swapaxes(1, 2), np.tile(np.eye(3), (4000, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turned), 1)
    assert np.abs(turned.mean(0)).max() < 0.05  # 3.5 standard errors
    assert kstest((turned[:, 2, 2] + 1) / 2, "uniform").pvalue > 0.001  # Archimedes: heights on a sphere are even


def test_a_lathe_turns_a_cone_of_the_right_volume():
    vertices, faces = turned_on_a_lathe(np.array([(0, -1), (1, -1), (0, 1)], float), 24)
    cone = trimesh.Trimesh(vertices, faces)
    base = 24 / 2 * np.sin(2 * np.pi / 24)  # area of the 24-gon
    assert abs(cone.volume) == pytest.approx(base * 2 / 3)


# Files and cards


def test_a_score_is_read_as_it_was_written(tmp_path):
    score = some_score(np.random.default_rng(6))
    sha256 = score.save(tmp_path / "a.novelty.safetensors")
    again = read_novelty(tmp_path / "a.novelty.safetensors", sha256)
    for name, values in vars(score).items():
        np.testing.assert_array_equal(getattr(again, name), values)


def test_a_score_that_is_missing_damaged_or_another_is_refused(tmp_path):
    path = tmp_path / "a.novelty.safetensors"
    sha256 = some_score(np.random.default_rng(6)).save(path)
    with pytest.raises(ModelError, match="missing"):
        read_novelty(tmp_path / "b.novelty.safetensors", sha256)
    with pytest.raises(ModelError, match="SHA-256 differs"):
        read_novelty(path, "0" * 64)
    for content in (b"", b"PK\x03\x04", path.read_bytes()[:200]):
        path.write_bytes(content)
        with pytest.raises(ModelError, match="not a novelty score"):
            read_novelty(path, hashlib.sha256(content).hexdigest())
    np.savez(path, middle=np.array([{}], object))
    with pytest.raises(ModelError, match="not a novelty score"):
        read_novelty(path, hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.mark.parametrize(
    "changed",
    [
        {"middle": np.full(7, np.nan, np.float32)},
        {"middle": np.zeros(6, np.float32)},
        {"output_bias": np.zeros(2, np.float32)},
        {"standard": np.zeros((2, 2), np.float32)},
        {"neighbours": np.ones((NEIGHBOUR - 1, 3), np.float32)},
        {"quantiles": np.array([[1.0, 0.0]], np.float32)},
        {"objects": np.array([0])},
    ],
)
def test_a_score_that_makes_no_sense_is_refused(changed):
    with pytest.raises(ModelError, match="no novelty score"):
        replace(some_score(np.random.default_rng(6)), **changed)


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """A folder of boxes of two classes, a store of their views, and a tiny recogniser that held some out."""
    folder, rng = tmp_path_factory.mktemp("boxes"), np.random.default_rng(7)
    for label, extent in (("flat", (3, 3, 1)), ("tall", (1, 1, 3))):
        (folder / "meshes" / label / "train").mkdir(parents=True)
        for k in range(6):
            box = trimesh.creation.box(np.array(extent) * rng.uniform(0.8, 1.25, 3))
            box.export(folder / "meshes" / label / "train" / f"{label}_{k}.off")
    list(render(folder / "meshes", folder / "views.zarr", ViewSphere.named("40"), 32, workers=0))
    card = make_recogniser(folder, ["flat", "tall"])
    write_card(card, replace(read_card(card), held_out=("flat_4", "flat_5", "tall_4", "tall_5")))
    return folder


def test_a_recogniser_is_taught_by_one_command(boxes, capsys, monkeypatch):
    monkeypatch.chdir(boxes)
    before = Recogniser("tiny.json")
    assert before.novelty is None
    main(["fit", "unknown", "views.zarr", "meshes", "tiny.json", "--made-up", "25", "--workers", "1"])
    assert "8 known objects against 25 made-up ones; false-alarm rates by 4 others" in " ".join(
        capsys.readouterr().err.split()
    )
    card, taught = read_card(boxes / "tiny.json"), Recogniser("tiny.json")
    assert card.training.commands[-1].startswith("nextview fit unknown views.zarr meshes tiny.json --made-up 25")
    assert "25 made-up" in card.fitted_to["novelty"]
    inputs = np.random.default_rng(0).integers(0, 256, (3, 4, 16, 16)).astype(np.uint8)
    evidence = taught.from_inputs(inputs)
    np.testing.assert_array_equal(evidence.logits, before.from_inputs(inputs).logits)
    np.testing.assert_array_equal(evidence.novelty, taught.novelty.scores(taught.features(inputs)))
    first = novelty_path(card.path).read_bytes()
    stages.fit_unknown(boxes / "views.zarr", boxes / "meshes", boxes / "tiny.json", 25, workers=0)
    assert novelty_path(card.path).read_bytes() == first  # the same whatever the number of processes


@pytest.mark.long
def test_what_is_known_through_sensors_is_known(boxes, capsys):
    sensed, few, sphere = boxes / "sensed.zarr", boxes / "few.zarr", replace(ViewSphere.named("40"), azimuths=3)
    list(render(boxes / "meshes", sensed, sphere, workers=0, sensor="mix"))
    arguments = (boxes / "views.zarr", boxes / "meshes", boxes / "tiny.json", 20)
    found = stages.fit_unknown(*arguments, sensed=(sensed, sensed), workers=0)
    assert (found.objects, found.held_out) == (8, 4)
    assert "clean and through sensors" in read_card(boxes / "tiny.json").fitted_to["novelty"]
    assert f"--sensed {sensed} {sensed}" in read_card(boxes / "tiny.json").training.commands[-1]
    list(render(boxes / "meshes", few, sphere, workers=0, sensor="mix", held_out=boxes / "tiny.json"))
    with pytest.raises(nextview.DatasetError, match="holds none of 8 objects"):
        stages.fit_unknown(*arguments, sensed=(few, few), workers=0)


def test_what_cannot_be_taught_is_said(boxes, tmp_path):
    card = make_recogniser(tmp_path, ["flat", "tall"])
    with pytest.raises(nextview.NextviewError, match=r"holds no object that .* was trained on, or none"):
        stages.fit_unknown(boxes / "views.zarr", boxes / "meshes", card)
    with pytest.raises(UsageError, match="at least one object"):
        stages.fit_unknown(boxes / "views.zarr", boxes / "meshes", card, made_up=0)
    write_card(card, replace(read_card(card), novelty_sha256="0" * 64))
    with pytest.raises(ModelError, match="novelty score is missing"):
        Recogniser(card)


# Sessions


class Strange:
    """A novelty score of which a test says what it is: that of the first feature."""

    def __init__(self, p):
        self.p = p

    def scores(self, features):
        return np.arange(len(features), dtype=float)

    def of_views(self, scores):
        return self.p if scores else 1.0


def recognised(p, unknown, camera=None):
    system = nextview.load()
    recogniser = system.models.recogniser
    before, recogniser.novelty = recogniser.novelty, Strange(p)
    try:
        session = nextview.Session(system.models, system.policy, system.sphere, 3, Stopping(0.97, 2), unknown=unknown)
        return session.run(camera or SimulatedCamera(sample_mesh("chair")))
    finally:
        recogniser.novelty = before


def test_an_object_stranger_than_the_rate_allows_has_no_answer():
    usual, strange = recognised(0.3, 0.05), recognised(0.03, 0.05)
    assert (usual.answer, usual.unknown, usual.novelty) == ("chair", False, 0.3)
    assert (strange.answer, strange.unknown, strange.novelty) == (None, True, 0.03)
    assert strange.most_like == "chair"
    assert strange.confidence == 0.0
    assert repr(strange).startswith("unknown (most like chair, ")
    assert "\n" not in repr(strange)
    told = json.loads(as_json(strange))
    assert (told["answer"], told["unknown"], told["novelty"], told["most_like"]) == (None, True, 0.03, "chair")
    np.testing.assert_array_equal(usual.views[-1].belief, strange.views[-1].belief)


def test_without_a_rate_a_class_is_always_named():
    assert recognised(0.0001, 0.0).answer == "chair"


@pytest.mark.parametrize("rate", [-0.1, 1.0, float("nan")])
def test_a_rate_that_is_none_is_refused(rate):
    with pytest.raises(UsageError, match="rate of known objects"):
        recognised(0.5, rate)


def test_where_nothing_is_seen_there_is_no_answer_and_no_novelty():
    speck = make_mesh(np.array([(0, 0, 0), (1e-4, 0, 0), (0, 1e-4, 0), (1, 1, 1), (1, 1, 1.0001), (1, 1.0001, 1)]),
                      np.array([(0, 1, 2), (3, 4, 5)]))  # fmt: skip
    result = recognised(0.001, 0.05, SimulatedCamera(speck))
    assert (result.seen, result.answer, result.most_like, result.unknown) == (False, None, None, False)
    assert result.novelty is None
    assert repr(result).startswith("nothing is seen")


def test_novelty_of_views_in_which_nothing_is_seen_does_not_count():
    from nextview.episode import _without_unseen

    evidence = Evidence(np.zeros((2, 3)), seen=np.array([True, False]), novelty=np.array([1.5, np.nan]))
    kept, seen = _without_unseen(evidence)
    np.testing.assert_array_equal(kept.novelty, [1.5, 0.0])
    np.testing.assert_array_equal(evidence.of(seen).novelty, [1.5])


def test_a_recogniser_that_was_not_taught_never_answers_unknown(tmp_path):
    make_recogniser(tmp_path, ["ball", "box"])
    result = nextview.load(tmp_path).recognise(sample_mesh("chair"))
    assert (result.novelty, result.unknown) == (None, False)
    assert result.answer in ("ball", "box")
    with pytest.raises(ModelError, match="cannot tell unknown objects; nextview fit unknown teaches it"):
        nextview.load(tmp_path, unknown=0.05)


@pytest.fixture(scope="module")
def wary():
    return nextview.load(unknown=0.05)


def scrambled(seed):
    """A chair whose triangles lie anywhere."""
    mesh, rng = sample_mesh("chair"), np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    corners = corners - corners.mean(1, keepdims=True) + rng.uniform(-0.6, 0.6, (len(corners), 1, 3))
    return make_mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def test_a_ball_and_a_scrambled_chair_are_unknown_and_the_samples_are_not(wary):
    ball = trimesh.creation.icosphere(3)
    for mesh in (make_mesh(ball.vertices, ball.faces), scrambled(0), scrambled(1)):
        result = wary.recognise(mesh, start=3)
        assert (result.answer, result.unknown) == (None, True)
        assert result.novelty < 0.05
    for name in ("chair", "table", "monitor"):
        assert wary.recognise(sample_mesh(name), start=3).answer == name


def test_the_command_says_that_it_does_not_know(tmp_path, capsys):
    mesh = scrambled(0)
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "heap.off")
    main(["recognise", str(tmp_path / "heap.off"), "--start", "3", "--unknown", "0.05"])
    said = " ".join(capsys.readouterr().out.split())
    assert "It is of no known class: most like a " in said
    assert "look at least as strange" in said
    main(["recognise", str(tmp_path / "heap.off"), "--start", "3"])
    assert "It is a " in capsys.readouterr().out


def test_features_that_hardly_vary_can_be_learned_too(tmp_path):
    """Those of a network that learned next to nothing: the first layer then holds numbers beyond half precision."""
    rng = np.random.default_rng(0)
    known, made_up = (1 + 1e-6 * rng.normal(size=(n, 6)) for n in (60, 30))
    held_out = 1 + 1e-6 * rng.normal(size=(9, 4, 6))
    score = fit_novelty(known, rng.integers(0, 2, 60), made_up, held_out, rng.integers(0, 2, 9), rng)
    assert np.abs(score.hidden).max() > np.finfo(np.float16).max
    sha = score.save(tmp_path / "a.novelty.safetensors")
    read = read_novelty(tmp_path / "a.novelty.safetensors", sha)
    np.testing.assert_array_equal(read.scores(held_out[0]), score.scores(held_out[0]))
