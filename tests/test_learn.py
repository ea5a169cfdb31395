"""Teaching things: what a folder holds, what is remembered, added and forgotten, and what
recognises them then.
"""

import shutil

import numpy as np
import pytest
import trimesh
from factories import SimulatedTable, TableCamera, poses_around, refused, write_off
from scipy.special import logsumexp

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import NextviewError, UsageError
from nextview.geometry.mesh import load_mesh, make_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState
from nextview.policies.discriminate import Discriminate
from nextview.recognition.belief import Calibration, log_evidence_of, reorient
from nextview.recognition.evidence import Evidence
from nextview.recognition.model_card import read_card
from nextview.recognition.novelty import unit
from nextview.simulation.sensor import SENSORS
from nextview.teaching.learn import learn
from nextview.things.approximate import NearestViews
from nextview.things.memory import AZIMUTHS, RINGS, by_ring, open_memory, similarities

THINGS = ("chair", "monitor", "table")
FORTY = ViewSphere.named("40")


def test_taught_things_are_recognised_through_a_sensor(taught, scans):
    system = nextview.load(models=taught)
    assert system.policy_name == "discriminate"
    assert system.classes == THINGS
    for name in THINGS:
        result = system.recognise(scans / f"{name}.off", sensor="wrist", seed=1)
        assert (result.answer, result.confident) == (name, True)
        np.testing.assert_allclose(result.views[-1].belief.sum(), 1)


def test_adding_leaves_what_is_known_as_it_was_and_removing_takes_it_away(
    tmp_path, taught, scans, capsys
):
    more, models = tmp_path / "more", tmp_path / "models"
    more.mkdir()
    shutil.copytree(taught, models)
    slab = make_mesh(
        sample_mesh("table").vertices * (1, 0.2, 1), sample_mesh("table").faces
    )
    write_off(more / "bench.off", slab)
    before = open_memory(taught / "memory.json")[1]
    learn(more, models, upright=True, add=True, workers=0)
    card = read_card(models / "memory.json")
    assert card.classes == ("bench", *THINGS)
    np.testing.assert_array_equal(
        open_memory(card.card_path)[1].views[1:], before.views
    )
    learn(models, models, remove=("bench",))
    card = read_card(models / "memory.json")
    assert card.classes == THINGS
    np.testing.assert_array_equal(
        open_memory(card.card_path)[1].held_out, before.held_out
    )
    alone = learn(models, models, remove=THINGS[1:]).notes[0]
    assert f"whatever is shown is {THINGS[0]} or unknown" in alone
    with pytest.raises(UsageError):
        learn(models, models, remove=("mug",))
    with pytest.raises(UsageError):
        learn(scans, models, add=True)
    assert "already knows things; --add adds others, --overwrite" in refused(
        capsys, "learn", str(scans), str(models)
    )


def test_a_run_that_was_stopped_goes_on_and_gives_the_same(
    tmp_path, knobs, knobs_memory, taught_afresh
):
    again = []

    def stopping(done, total, what):
        for count in done:
            if count == 2:
                raise KeyboardInterrupt
            again.append(count)

    with pytest.raises(KeyboardInterrupt):
        learn(
            knobs, tmp_path / "mine", unit="m", upright=True, workers=0, track=stopping
        )
    assert not (tmp_path / "mine").exists()
    counts = []
    learn(
        knobs,
        tmp_path / "mine",
        unit="m",
        upright=True,
        workers=0,
        track=lambda done, total, what: counts.extend(done),
    )
    assert counts[0] == 2  # what was finished is not looked at again
    assert (
        read_card(tmp_path / "mine/memory.json").sha256
        == read_card(knobs_memory / "memory.json").sha256
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]


def test_what_lies_too_flat_for_depth_is_told_when_it_is_taught(tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    sizes = {"card": (85.6, 54, 0.8), "tile": (60, 60, 20)}
    for name, sides in sizes.items():
        trimesh.creation.box(sides).export(scans / f"{name}.ply")
    found = learn(scans, tmp_path / "mine", unit="mm", workers=0)
    told = [note for note in found.notes if "where it lies flat" in note]
    assert len(told) == 1
    assert told[0].startswith("card: it is 0.8 mm high where it lies flat")
    assert told[0] in str(found)

    # What the note says is what a table shows: nothing stands there.
    system = nextview.load(tmp_path / "mine", threads=1)
    lies = np.eye(3)[None]
    for name, count in (("card", 0), ("tile", 1)):
        mesh = load_mesh(scans / f"{name}.ply", unit="mm")
        rng = np.random.default_rng(1)
        table = SimulatedTable.draw([mesh], rng, resting=lambda mesh: lies)
        camera = TableCamera(table, SENSORS["wrist"], rng)
        pose = poses_around(np.zeros(1), np.radians(50), 0.5, np.zeros(3))[0]
        scene = nextview.Scene(system)
        scene.update(camera.frame(pose))
        assert len(scene.objects) == count


def test_belief_in_classes_is_the_sum_over_their_things_and_azimuths():
    rng = np.random.default_rng(0)
    calibration = Calibration(1.0, 1.0, None, 0.4, (0, 0, 1, 2, 2, 2))
    logits, bins = rng.normal(0, 2, (3, 3)), rng.normal(0, 4, (3, 6, AZIMUTHS))
    azimuth = np.array([0, 3, 7]) * 2 * np.pi / AZIMUTHS
    total = log_evidence_of(logits, bins, azimuth).sum(0)
    belief, joint = (
        calibration.belief(total, 3, 3),
        calibration.joint(total, 3, 3, azimuth[2]),
    )
    pointing = (
        np.stack([reorient(b, a) for b, a in zip(bins, azimuth, strict=True)]).sum(0)
        / 1.8
    )
    by_hand = logits.mean(0) + [
        logsumexp(pointing[k]) for k in ([0, 1], [2], [3, 4, 5])
    ]
    np.testing.assert_allclose(np.log(belief), by_hand - logsumexp(by_hand), atol=1e-9)
    marginal = joint.sum(1)
    np.testing.assert_allclose(
        [marginal[:2].sum(), marginal[2], marginal[3:].sum()], belief, atol=1e-12
    )
    with pytest.raises(NextviewError, match="not of every class"):
        Calibration(hypotheses=(0, 2))


def test_similarity_is_a_cosine_between_rings_interpolated():
    rng = np.random.default_rng(0)
    views = rng.normal(size=(3, len(RINGS), AZIMUTHS, 5)).astype(np.float32)
    seen = rng.normal(size=(2, 5)).astype(np.float32)
    found = similarities(by_ring(views), seen, np.radians([27.0, 80.0]))
    np.testing.assert_allclose(
        found[0], (views[:, 1] + views[:, 2]) @ seen[0] / 2, rtol=1e-4
    )
    np.testing.assert_allclose(found[1], views[:, 4] @ seen[1], rtol=1e-4)


def test_the_nearest_of_many_views_are_those_of_an_exact_search():
    pytest.importorskip("faiss", reason="the extra 'large' is not installed")
    rng = np.random.default_rng(0)
    kinds, kind = rng.normal(size=(300, 256)), rng.integers(300, size=10_500)
    views = unit(kinds[kind] + 0.5 * rng.normal(size=(len(kind), 256))).astype(
        np.float32
    )
    seen = unit(kinds[:20] + 0.5 * rng.normal(size=(20, 256))).astype(np.float32)
    found = NearestViews(np.stack([views, views]))
    found, exact = (
        found.similarities(seen, np.full((20, 2), 0.5, np.float32)),
        seen @ views.T,
    )
    best = np.argsort(-exact, 1)[:, :20]
    close = np.isclose(
        np.take_along_axis(found, best, 1),
        np.take_along_axis(exact, best, 1),
        atol=1e-5,
    )
    assert close.mean() > 0.95
    np.testing.assert_array_less(found.max(1), exact.max(1) + 1e-5)


@pytest.mark.parametrize("place", [3, 21, 38])
def test_the_policy_goes_where_two_things_differ(place):
    # Two things that look alike from everywhere but from one view; the object's azimuth is known,
    # and not zero.
    views = np.zeros((2, len(RINGS), AZIMUTHS, 2), np.float32)
    views[..., 0] = 1
    ring, azimuth = divmod(place, 8)
    views[1, ring, (2 * azimuth + 5) % AZIMUTHS] = (0, 1)
    policy = Discriminate(FORTY, views, np.array([0, 1]))
    current = 10
    joint = np.zeros((1, 2, AZIMUTHS))
    joint[0, :, (2 * (current % 8) + 5) % AZIMUTHS] = 0.5
    visited = np.arange(40)[None] == current
    evidence = Evidence(np.zeros((1, 2)))
    state = EpisodeState(
        np.array([current]), visited, np.full((1, 2), 0.5), evidence, 1, joint=joint
    )
    assert policy.next_views(state, np.random.default_rng(0)).tolist() == [place]
    rivals = policy.rivals(joint[0], FORTY.azimuth[current])
    np.testing.assert_array_equal(rivals.classes, [0, 1])
    np.testing.assert_array_equal(rivals.alike, np.arange(40) != place)
