import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.special import log_softmax, softmax
from test_predictions import some_predictions
from tiny_models import make_map_network, make_recogniser

from nextview.belief import Calibration, Stopping
from nextview.benchmark.entries import default_entries
from nextview.benchmark.experiment import Grid, run_grid
from nextview.benchmark.replay import make_specs, replay, truncate
from nextview.benchmark.true_maps import true_lcm, true_lem
from nextview.cameras.simulated import SimulatedCamera
from nextview.data.predicting import predict
from nextview.data.predictions import Predictions
from nextview.data.rendering import render
from nextview.episode import run_episodes
from nextview.errors import EntryError, PolicyError
from nextview.mesh import load_mesh
from nextview.models.inference import MapNetwork, Models, Recogniser
from nextview.models.model_card import read_card
from nextview.policies.base import Evidence
from nextview.policies.registry import make_policy
from nextview.session import Session
from nextview.viewsphere import ViewSphere


@pytest.fixture(scope="module")
def specs():
    return make_specs(some_predictions(30), runs=4, seed=0)


def evidence_of(predictions: Predictions, objects: np.ndarray):
    def observe(episodes, views):
        rows = objects[episodes]
        return Evidence(predictions.logits[rows, views], {"lem": predictions.maps["lem"][rows, views]})

    return observe


@pytest.mark.parametrize("threshold_decay", [0.0, 0.6])
@pytest.mark.parametrize("threshold", [0.0, 0.7, 0.9, 0.99])
@pytest.mark.parametrize("name", ["lem", "lem-peak", "unidirectional"])
def test_a_path_cut_at_a_threshold_is_the_episode_under_that_threshold(specs, name, threshold, threshold_decay):
    p = specs.predictions
    policy = make_policy(name, p.sphere, specs.valley_classes("lem"))
    episodes = run_episodes(
        evidence_of(p, specs.objects),
        p.sphere,
        policy,
        specs.starts,
        Stopping(threshold, 5, threshold_decay),
        np.random.default_rng(0),
    ).outcome
    paths = replay(name, specs, max_views=5, seed=0)
    ends = truncate(paths, threshold, threshold_decay)
    for field in ("answer", "confidence", "n_views", "confident", "travel", "arc"):
        np.testing.assert_allclose(getattr(ends, field), getattr(episodes, field), atol=1e-12, err_msg=field)
    taken = np.arange(5) < ends.n_views[:, None]
    width = episodes.views.shape[1]
    np.testing.assert_array_equal(np.where(taken, paths.views, -1)[:, :width], episodes.views)


def test_all_policies_begin_with_the_same_views(specs):
    for name in default_entries(specs):
        paths = replay(name, specs, max_views=3, seed=0)
        if not paths.fixed or name.startswith("orbit"):
            np.testing.assert_array_equal(paths.views[:, 0], specs.starts)


def test_what_a_policy_does_depends_on_the_seed_and_on_nobody_else(specs):
    alone = replay("random", specs, 5, seed=3).views
    grid = Grid(specs, 4, (0.9,), 5, seed=3)
    list(run_grid(grid, ["furthest", "random-all", "random"]))
    np.testing.assert_array_equal(grid.paths["random"].views, alone)
    assert (replay("random", specs, 5, seed=4).views != alone).any()


def test_the_policy_is_asked_once_for_all_episodes_of_a_look(specs, monkeypatch):
    calls = []
    real = Asked.next_views
    monkeypatch.setattr(Asked, "next_views", lambda self, *a: calls.append(len(a[0].current)) or real(self, *a))
    replay("test_replay:Asked", specs, 5, seed=0)
    assert calls == [len(specs.objects)] * 4


@pytest.mark.parametrize("knows_bins", [False, True])
def test_oracle_gain_takes_the_view_that_helps_the_true_class_most(specs, knows_bins):
    calibration, likely = Calibration(0.8, 0.5), None
    if knows_bins:
        calibration = replace(calibration, bin_correlation=0.1)
        likely = log_softmax(np.random.default_rng(3).normal(size=(30, 40, 3, 8)), axis=3).astype(np.float32)
    specs = replace(specs, predictions=replace(specs.predictions, calibration=calibration, azimuth_bins=likely))
    p = specs.predictions
    for name, everywhere in [("oracle-gain", False), ("oracle-gain-all", True)]:
        views = replay(name, specs, 3, seed=0).views
        for e in range(0, len(views), 7):
            i, seen = specs.objects[e], list(views[e, :2])
            around = range(40) if everywhere else p.sphere.windows[seen[-1]].ravel()
            belief = {
                v: calibration.belief(p.log_evidence[i, [*seen, v]].astype(float).sum(0), 3, 3)[p.labels[i]]
                for v in around
                if v not in seen
            }
            assert belief[views[e, 2]] == pytest.approx(max(belief.values()), abs=1e-9)


def test_oracle_valley_differs_from_the_peak_for_valley_classes_alone(specs):
    valley = specs.labels == specs.predictions.classes.index("box")
    peak, oracle = (replay(name, specs, 2, 0).views[:, 1] for name in ("lem-peak", "oracle-valley"))
    np.testing.assert_array_equal(peak[~valley], oracle[~valley])
    assert (peak[valley] != oracle[valley]).all()


def test_each_map_has_the_valley_classes_of_its_own_card():
    p = some_predictions(6)
    lcm = {"maps": p.maps | {"lcm": p.maps["lem"]}, "valley_classes": {"lem": p.classes[:1], "lcm": p.classes[1:2]}}
    specs = make_specs(replace(p, **lcm), 2, 0)
    assert (specs.valley_classes("lem"), specs.valley_classes("lcm")) == ((0,), (1,))
    peak, valley = (replay(name, specs, 2, 0).views[:, 1] for name in ("lcm-peak", "lcm-oracle-valley"))
    assert {*np.flatnonzero(peak != valley)} == {*np.flatnonzero(specs.labels == 1)}
    given = make_specs(replace(p, **lcm), 2, 0, (2,))
    assert given.valley_classes("lem") == given.valley_classes("lcm") == (2,)


def test_true_maps_are_the_truth_around_each_view():
    p = some_predictions(4)
    i, v = 2, 9
    for ring in range(5):
        for column in range(3):
            seen = p.sphere.windows[v, ring, column]
            low, high = p.depth_entropy[i].min(), p.depth_entropy[i].max()
            assert true_lem(p)[i, v, ring, column] == pytest.approx((p.depth_entropy[i, seen] - low) / (high - low))
            belief = softmax(p.logits[i, seen].astype(float))
            right = belief.argmax() == p.labels[i]
            assert true_lcm(p)[i, v, ring, column] == pytest.approx(belief.max() if right else 0)


def test_fixed_views_are_the_ones_their_name_says(specs):
    p = specs.predictions
    sure = softmax(p.logits.astype(float), axis=2)[np.arange(len(p)), :, p.labels][specs.objects]
    entropy = p.depth_entropy[specs.objects]
    for name, values in [
        ("best-5", sure),
        ("worst-5", -sure),
        ("high-entropy-5", entropy),
        ("low-entropy-5", -entropy),
    ]:
        paths = replay(name, specs, max_views=3, seed=0)
        taken = np.take_along_axis(values, paths.views, 1)
        np.testing.assert_allclose(np.sort(taken), np.sort(values)[:, -5:], err_msg=name)
        total = np.take_along_axis(p.logits[specs.objects], paths.views[..., None], 1).sum(1)
        ends = truncate(paths, 0.1)
        np.testing.assert_array_equal(ends.n_views, 5)  # whatever is believed
        np.testing.assert_array_equal(ends.answer, total.argmax(1))
        np.testing.assert_allclose(ends.confidence, softmax(total.astype(float), axis=1).max(1), rtol=1e-5)


def test_orbits_go_round_their_ring_and_then_over_the_whole_sphere(specs):
    ring, sphere = replay("orbit-8", specs, 5, 0), specs.predictions.sphere
    assert (sphere.ring[ring.views] == sphere.ring[specs.starts][:, None]).all()
    np.testing.assert_allclose(truncate(ring, None).travel, 7)
    everywhere = replay("orbit-40", specs, 5, 0)
    np.testing.assert_array_equal(np.sort(everywhere.views), np.tile(np.arange(40), (len(specs.objects), 1)))
    best = truncate(everywhere, None).answer == specs.predictions.logits.sum(1).argmax(1)[specs.objects]
    assert best.all()


def test_random_all_reaches_every_other_view_equally_often():
    p = some_predictions(1)
    specs = make_specs(p, runs=20_000, seed=0)
    steps = (replay("random-all", specs, 2, 0).views[:, 1] - specs.starts) % 40
    counts = np.bincount(steps, minlength=40)
    assert counts[0] == 0
    assert counts[1:].std() < 4 * np.sqrt(20_000 / 39)


@dataclass(frozen=True)
class Asked:
    """A user's policy: the next view by number."""

    sphere: ViewSphere
    needs: tuple[str, ...] = ()

    def next_views(self, state, rng):
        return (state.current + 1) % len(self.sphere)


class Backwards(Asked):
    def next_views(self, state, rng):
        return state.current


class Beyond(Asked):
    def next_views(self, state, rng):
        return np.where(state.episodes == 7, 40, super().next_views(state, rng))


class Raises(Asked):
    def next_views(self, state, rng):
        if (state.episodes == 11).any():
            raise RuntimeError("no idea")
        return super().next_views(state, rng)


class Short(Asked):
    def next_views(self, state, rng):
        return np.array([1])


class Unmakeable:
    pass


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Backwards", r"chose view \d+, which was visited before \(object thing_0\)"),
        ("Beyond", r"chose view 40, which is not on the sphere \(object thing_7\)"),
        ("Raises", r"raised RuntimeError: no idea, at test_replay.py:\d+ \(object thing_11\)"),
        ("Short", "has to return 120 integers"),
        ("Unmakeable", "cannot be made"),
        ("Missing", "cannot be made"),
    ],
)
def test_a_policy_that_fails_is_named_with_the_object_and_the_others_are_kept(specs, name, sentence):
    grid = Grid(specs, 4, (0.9,), 5, 0)
    path = f"test_replay:{name}"
    assert list(run_grid(grid, ["furthest", path, "test_replay:Asked"])) == [1, 2, 3]
    assert set(grid.paths) == {"furthest", "test_replay:Asked"}
    with pytest.raises(ValueError, match=sentence):
        raise EntryError(grid.failures[path])
    assert path in grid.failures[path]


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("clever", "no policy is called 'clever'; there are random, .*best-K"),
        ("lcm", "needs the map 'lcm'"),
        ("best-41", "between 1 and 40"),
        ("best-0", "between 1 and 40"),
    ],
)
def test_a_contestant_that_cannot_take_part_is_refused(specs, name, sentence):
    with pytest.raises(ValueError, match=sentence):
        replay(name, specs, 5, 0)


def test_a_damaged_policy_is_named_and_not_left_out(specs, tmp_path, monkeypatch):
    broken = tmp_path / "broken.json"
    broken.write_text("{}")
    monkeypatch.setattr("nextview.benchmark.entries.bundled_policies", lambda: {"broken": broken})
    monkeypatch.setattr("nextview.policies.registry.bundled_policies", lambda: {"broken": broken})
    with pytest.raises(PolicyError, match="not a policy card"):
        default_entries(specs)


def test_the_contestants_are_those_that_the_predictions_allow(specs):
    names = default_entries(specs)
    assert {"lem", "oracle-valley", "true-lcm", "orbit-8", "orbit-40"} <= set(names)
    assert not any(name.startswith("lcm") for name in names)
    p = specs.predictions
    with_lcm = make_specs(replace(p, maps={**p.maps, "lcm": p.maps["lem"]}), 1, 0)
    assert {"lcm", "lcm-peak", "lcm-oracle-valley"} <= set(default_entries(with_lcm))
    other = make_specs(replace(p, maps={"view_area": p.maps["lem"]}), 4, 0)  # of no valley classes
    assert [name for name in default_entries(other) if "view_area" in name] == ["view_area", "view_area-peak"]
    for name, same in (("view_area", "lem-peak"), ("view_area-oracle-valley", "lem-peak")):
        np.testing.assert_array_equal(replay(name, other, 3, 0).views, replay(same, specs, 3, 0).views)
    without = make_specs(replace(p, maps={}), 1, 0)
    assert not {"lem", "lem-peak", "oracle-valley"} & set(default_entries(without))
    for name in default_entries(with_lcm):
        replay(name, with_lcm, 2, 0)


def sample_meshes(folder: Path) -> None:
    rng = np.random.default_rng(0)
    makers = {
        "ball": lambda: trimesh.creation.icosphere(2),
        "box": trimesh.creation.box,
        "pillar": lambda: trimesh.creation.capsule(count=[12, 12]),
    }
    for label, make in makers.items():
        for n in range(2):
            mesh = make()
            mesh.apply_scale(rng.uniform(0.5, 2, 3))
            path = folder / label / "test" / f"{label}_{n}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            mesh.export(path)


def real_meshes(folder: Path) -> None:
    if "NEXTVIEW_DATA" not in os.environ:
        pytest.skip("NEXTVIEW_DATA names no folder with ModelNet10")
    for label in ("chair", "desk", "toilet"):
        for source in sorted((Path(os.environ["NEXTVIEW_DATA"]) / "ModelNet10" / label / "test").glob("*.off"))[:2]:
            target = folder / label / "test" / source.name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.symlink_to(source.resolve())


class ToItsBack:
    """Goes round the ring to where the side opposite to that which the recogniser calls 0 is likely to be seen."""

    needs = ("azimuth_bins",)

    def __init__(self, sphere):
        self.sphere = sphere

    def next_views(self, state, rng):
        n, rows = self.sphere.azimuths, np.arange(len(state.current))
        seen = (state.belief[:, :, None] * state.azimuth_bins).sum(1)  # (B, azimuth bins)
        to = (self.sphere.azimuth_index[state.current][:, None] + n // 2 - np.arange(n)) % n
        views = self.sphere.ring[state.current][:, None] * n + to
        return views[rows, np.where(state.visited[rows[:, None], views], -1.0, seen).argmax(1)]


@pytest.mark.parametrize("meshes", [sample_meshes, real_meshes])
def test_replay_and_a_live_camera_with_the_networks_take_the_same_views(meshes, tmp_path):
    meshes(tmp_path / "meshes")
    sphere = ViewSphere.named("40")
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", sphere, 64, workers=1))
    classes = sorted(path.name for path in (tmp_path / "meshes").iterdir())
    recogniser = make_recogniser(tmp_path, classes, size=32, azimuth_bins=8)
    calibrated = json.loads(recogniser.read_text()) | {"calibration": Calibration(0.6, 0.7).to_dict()}
    recogniser.write_text(json.dumps(calibrated))
    lem = make_map_network(tmp_path, valleys=(classes[0],))
    cards = [read_card(recogniser)], {"lem": read_card(lem)}
    list(predict(tmp_path / "views.zarr", tmp_path / "p.npz", *cards, workers=1))
    p = Predictions.load(tmp_path / "p.npz")
    specs = make_specs(p, runs=2, seed=0)
    models = Models(Recogniser(recogniser, 1), {"lem": MapNetwork(lem, 1)})
    # A threshold that some reach: the middle of all confidences after two views.
    threshold = float(np.median(replay("lem", specs, 2, 0).confidences[:, 1]))
    for name in ("lem", "lem-peak", "unidirectional", "test_replay:ToItsBack"):
        policy = make_policy(name, sphere, specs.valley_classes("lem"))
        paths = replay(name, specs, 5, 0)
        ends = truncate(paths, threshold)
        for e, (i, start) in enumerate(zip(specs.objects, specs.starts, strict=True)):
            label = classes[p.labels[i]]
            mesh = load_mesh(tmp_path / "meshes" / label / "test" / f"{p.names[i]}.off")
            camera = SimulatedCamera(mesh, 64, sphere.distance)
            live = Session(models, policy, sphere, int(start), Stopping(threshold)).run(camera)
            assert [view.index for view in live.views] == paths.views[e, : ends.n_views[e]].tolist()
            assert live.answer == classes[ends.answer[e]]
            assert live.confident == ends.confident[e]
            assert live.confidence == pytest.approx(ends.confidence[e], abs=0.01)  # the store rounds
            assert live.travel == pytest.approx(ends.travel[e])
