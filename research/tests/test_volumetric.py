"""Policies by what is unseen, by peaks of the whole sphere and by true measures; their way into
the benchmark.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pipeline import some_predictions
from scipy.ndimage import maximum_filter

import nextview
from nextview.geometry.mesh import make_mesh
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import ViewSphere, viewpoints_of
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.maps import SpherePeak, sphere_peaks
from nextview.policies.registry import make_policy
from nextview.recognition.belief import FixedLength
from nextview.sensing.expected_visibility import VoxelGrid
from nextview.session.episode import run_episodes
from nextview.session.session import Session
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.benchmark.entries import default_entries, is_oracle
from nextview_lab.benchmark.oracle import OracleMeasure
from nextview_lab.benchmark.replay import make_specs, replay
from nextview_lab.data.measures import measure
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.rendering import render
from nextview_lab.data.store import PLANNED, ViewStore
from nextview_lab.errors import EntryError
from research.new_volume import new_surface, new_volume
from research.plan import main as plan
from research.plan import plan as plan_store
from research.volumetric import Volumetric, occupancy_of

SPHERE = ViewSphere.named("40")
RING = ViewSphere((10.0, 50.0), 3)
"""Few views: every way from each of them is planned."""
SMALL = VoxelGrid(24)


def camera(shape=None, size=64):
    shape = shape or trimesh.creation.icosphere(3)
    return SimulatedCamera(make_mesh(shape.vertices, shape.faces), size)


def state_of(sphere, *episodes, **maps) -> EpisodeState:
    """Episodes that have visited these views and stand at the last."""
    visited = np.zeros((len(episodes), len(sphere)), bool)
    for row, views in enumerate(episodes):
        visited[row, list(views)] = True
    flat = np.full((len(episodes), 2), 0.5)
    current = np.array([views[-1] for views in episodes])
    return EpisodeState(
        current,
        visited,
        flat,
        Evidence(flat, maps),
        len(episodes[0]),
        np.arange(len(episodes)),
    )


# By what is unseen


@pytest.mark.parametrize("gain", [new_volume, new_surface])
def test_after_one_view_of_a_ball_the_other_side_is_most_new(gain):
    looks = camera()
    policy = Volumetric(SPHERE, gain, SMALL)
    state = replace(
        state_of(SPHERE, [8], [12]),
        observations=[[looks.observe(SPHERE.poses[v])] for v in (8, 12)],
    )
    chosen = policy.next_views(state, np.random.default_rng(0))
    assert (SPHERE.arc[[8, 12], chosen] > np.radians(100)).all()
    values = policy.view_values(state)
    assert (values[[0, 1], [8, 12]] < 0.1 * values.max(1)).all()
    for row, view in enumerate((8, 12)):  # each row by itself
        alone = replace(
            state_of(SPHERE, [view]),
            observations=[state.observations[row]],
        )
        np.testing.assert_array_equal(policy.view_values(alone)[0], values[row])


@pytest.mark.parametrize("viewpoints", ["40", "fibonacci:20"])
def test_a_session_hands_the_policy_what_was_seen(viewpoints):
    system = nextview.load(policy="volumetric", viewpoints=viewpoints)
    policy = replace(system.policy, grid=SMALL)
    box = camera(trimesh.creation.box([1, 2, 1.5]), 112)
    sphere = viewpoints_of(viewpoints)
    session = Session(system.models, policy, sphere, 3, FixedLength(max_views=4))
    while not session.done:
        session.update(box.observe(session.pose))
    seen = [view.observation for view in session.views]
    visited = {3}
    for k in (1, 2, 3):
        gains = new_volume(occupancy_of(seen[:k], SMALL), sphere.poses[:, :3, 3])
        np.testing.assert_array_equal(session.views[k - 1].values, gains)
        gains[list(visited)] = -1
        assert gains[session.views[k].index] == gains.max() > 0
        visited.add(session.views[k].index)


# Peaks of the sphere


def test_peaks_of_a_sphere_are_those_of_a_maximum_filter_that_wraps():
    rng = np.random.default_rng(0)
    for _ in range(20):
        values = rng.integers(0, 6, (1, 5, 8)) / 5.0
        wrapped = np.tile(values[0], (1, 3))
        peaks = (wrapped == maximum_filter(wrapped, 3, mode="constant", cval=-np.inf))[
            :,
            8:16,
        ]
        order = np.argsort(-sphere_peaks(values)[0].ravel(), kind="stable")
        expected = np.lexsort((np.arange(40), -values[0].ravel(), ~peaks.ravel()))
        np.testing.assert_array_equal(order, expected)


def test_the_map_of_the_sphere_is_counted_from_the_view():
    values = np.random.default_rng(0).random((2, 5, 8))
    state = state_of(SPHERE, [11], [24], **{"lem-sphere": values})
    on_sphere = SpherePeak(SPHERE, "lem-sphere").view_values(state)
    for row, azimuth in enumerate((3, 0)):
        for view in range(40):
            assert (
                on_sphere[row, view] == values[row, view // 8, (view % 8 - azimuth) % 8]
            )
    chosen = SpherePeak(SPHERE, "lem-sphere").next_views(
        state,
        np.random.default_rng(0),
    )
    scores = SpherePeak(SPHERE, "lem-sphere").scores(state)
    assert (
        scores[[0, 1], chosen].tolist()
        == np.where(state.free, scores, -9).max(1).tolist()
    )


# True measures


def test_the_oracle_of_a_measure_goes_to_the_highest_view_left():
    values = np.random.default_rng(0).random((2, 40))
    best = np.argsort(-values, 1)
    policy = OracleMeasure(SPHERE, values)
    state = state_of(SPHERE, [best[0, 0], best[0, 1]], [best[1, 1], best[1, 2]])
    assert policy.next_views(state, np.random.default_rng(0)).tolist() == [
        best[0, 2],
        best[1, 0],
    ]


def test_the_oracle_of_peaks_leaves_out_the_slope_below_a_peak():
    values = np.zeros((1, 40))
    values[0, [8, 9, 28]] = 1.0, 0.9, 0.5  # 9 is next to 8 and no peak
    chosen = OracleMeasure(SPHERE, values, peaks=True).next_views(
        state_of(SPHERE, [8]),
        np.random.default_rng(0),
    )
    assert chosen.tolist() == [28]


# In the benchmark


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A store of two meshes, planned and measured, and made-up predictions of it."""
    folder = tmp_path_factory.mktemp("stored")
    for label, mesh in (
        ("ball", trimesh.creation.icosphere(2)),
        ("box", trimesh.creation.box([1, 3, 2])),
    ):
        path = folder / "meshes" / label / "test" / f"{label}_1.off"
        path.parent.mkdir(parents=True)
        mesh.export(path)
    store = folder / "views.zarr"
    list(render(folder / "meshes", store, RING, 48, workers=0))
    views = ViewStore.open(store)
    rng = np.random.default_rng(0)
    predictions = Predictions(
        rng.normal(size=(2, 6, 3)).astype(np.float32),
        {},
        views.measure(),
        tuple(views.names),
        np.array([0, 1]),
        ("ball", "box", "pillar"),
        np.array(["test"] * 2),
        np.zeros(2, bool),
        RING,
        {},
        {},
        store=str(store),
    )
    return store, predictions


def test_the_benchmark_goes_the_way_that_was_planned(stored):
    store, predictions = stored
    specs = make_specs(predictions, 6, 0)
    with pytest.raises(EntryError, match="plans/volumetric is missing"):
        replay("volumetric", specs, 3, 0)
    assert "volumetric" not in default_entries(specs)
    plan(store, ("volumetric", "coverage"), workers=0)
    # nothing is left to do
    assert list(plan_store(store, ("volumetric", "coverage"), workers=0)) == [(2, 2)]
    assert {"volumetric", "coverage"} <= set(default_entries(specs))
    views = ViewStore.open(store)
    for name, gain in (("volumetric", new_volume), ("coverage", new_surface)):
        ways = views.rows(f"plans/{name}")
        assert ways.shape == (2, 6, PLANNED)
        np.testing.assert_array_equal(ways[:, :, 0], np.tile(np.arange(6), (2, 1)))
        paths = replay(name, specs, 3, 0)
        np.testing.assert_array_equal(
            paths.views,
            ways[specs.objects, specs.starts, :3],
        )
        # by hand
        seen = []
        way = ways[1, 5].astype(int)
        for k in range(3):
            seen.append(
                Observation(
                    views.depth(1)[way[k]],
                    RING.poses[way[k]],
                    views.intrinsics,
                )
            )
            gains = gain(occupancy_of(seen, VoxelGrid(64)), RING.poses[:, :3, 3])
            gains[way[: k + 1]] = -1
            assert gains[way[k + 1]] >= gains.max() - 1e-6
    with pytest.raises(EntryError, match="only 5 views are listed"):
        replay("volumetric", specs, 6, 0)


@pytest.mark.parametrize("name", ["volumetric", "coverage"])
def test_what_was_planned_is_where_the_policy_goes_by_itself(stored, name):
    """One episode at a time, each with frames of its own: nothing that was found for another can
    be used.
    """
    store, _ = stored
    plan(store, (name,), workers=0)
    views = ViewStore.open(store)
    policy = make_policy(name, RING)
    rule = FixedLength(max_views=PLANNED)
    rng = np.random.default_rng(0)
    for i in range(2):
        for start in range(len(RING)):

            def observe(episodes, at, i=i):
                frames = [
                    Observation(
                        views.depth(i)[view].copy(),
                        RING.poses[view],
                        views.intrinsics,
                    )
                    for view in at
                ]
                return Evidence(np.zeros((len(at), 2)), observations=frames)

            alone = run_episodes(observe, RING, policy, np.array([start]), rule, rng)
            np.testing.assert_array_equal(
                views.read(f"plans/{name}", i)[start],
                alone.outcome.views[0],
            )


def test_true_measures_come_from_the_store(stored):
    store, predictions = stored
    specs = make_specs(predictions, 4, 0)
    with pytest.raises(
        EntryError,
        match=r"nextview-lab measure \S+ --measures view_area makes it",
    ):
        replay("true-view_area-all", specs, 3, 0)
    list(measure(store, ["view_area"], workers=0))
    area = ViewStore.open(store).rows("measures/view_area")[specs.objects]
    ways = replay("true-view_area-all", specs, 3, 0).views
    for row, (start, way) in enumerate(zip(specs.starts, ways, strict=True)):
        left = np.delete(np.arange(6), start)
        assert sorted(area[row, way[1:]]) == pytest.approx(sorted(area[row, left])[-2:])
    best = replay("true-view_area-4", specs, 3, 0)
    assert best.fixed
    np.testing.assert_allclose(
        area[np.arange(8)[:, None], best.views],
        -np.sort(-area, 1)[:, :4],
    )
    entropy = replay("true-depth_entropy-4", specs, 3, 0).views
    np.testing.assert_array_equal(entropy, replay("high-entropy-4", specs, 3, 0).views)
    assert is_oracle("true-view_area-all")
    assert is_oracle("true-depth_entropy-all-peak")
    assert not is_oracle("volumetric")


def test_peaks_of_a_predicted_sphere_in_the_benchmark():
    p = some_predictions(4)
    sphere_map = np.random.default_rng(1).random((4, 40, 5, 8)).astype(np.float32)
    specs = make_specs(replace(p, maps={**p.maps, "lem-sphere": sphere_map}), 2, 0)
    assert "lem-sphere-peak" in default_entries(specs)
    ways = replay("lem-sphere-peak", specs, 4, 0).views
    assert all(len(set(way)) == 4 for way in ways.tolist())
