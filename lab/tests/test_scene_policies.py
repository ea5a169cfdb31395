"""Choosing views among things: what is expected to show, by closed forms; policies by it; scenes
in replay and live.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pipeline import scene_predictions
from test_policies import state_of as state_at
from test_scenes import GRID, scene_of

from nextview.errors import DatasetError
from nextview.geometry.observation import SceneView
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.registry import make_policy
from nextview.sensing.expected_visibility import SeenScene, expected_visibility
from nextview_lab.benchmark import statistics
from nextview_lab.benchmark.entries import default_entries
from nextview_lab.benchmark.published import ACCURACY, read_table
from nextview_lab.benchmark.replay import make_specs, replay
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.scene_views import SceneSight, scene_intrinsics, scene_views
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import EntryError
from nextview_lab.worlds.scene_cameras import SHOWS_TARGET, OccludedCamera, SceneCamera
from nextview_lab.worlds.scene_layout import Block

TEN = tuple(read_table(ACCURACY[10]))
POSITIONS = GRID.poses[:, :3, 3]
BEFORE = Block(1.6, 0.0, 0.0, 0.2, 2.6, 2.2)
"""Hides the ball from the front, and nothing from behind."""


def looks(scene, *views: int) -> list[SceneView]:
    """What a camera without errors sees of a scene."""
    k = scene_intrinsics(GRID.distance, 80)
    camera, found = SceneCamera(scene, k, (80, 80)), []
    for view in views:
        depth, owner = camera.look(GRID.poses[view])
        found.append(SceneView(depth, owner == SHOWS_TARGET, GRID.poses[view], k, True))
    return found


def state_of(visibility, belief=None, reachable=None) -> EpisodeState:
    """One episode after view 0."""
    belief, bins = (
        np.full((1, 10), 0.1) if belief is None else belief,
        np.full((1, 10, 8), 1 / 8),
    )
    evidence = Evidence(np.log(belief), {"lem-sphere": np.zeros((1, 5, 8))}, bins)
    share = np.asarray(visibility, float).reshape(1, 40)
    known = {"azimuth_bins": bins, "reachable": reachable, "visibility": share}
    return replace(state_at(GRID, 0, belief=belief), evidence=evidence, **known)


# What is expected to show


def test_occlusion_by_a_box_agrees_with_an_error_free_camera():
    scene = scene_of(BEFORE)
    truth = np.array(
        [OccludedCamera(scene, 64).visible_share(pose) for pose in GRID.poses]
    )
    seen = SeenScene.of(looks(scene, 2, 4, 14, 22, 30))
    found = expected_visibility(seen, POSITIONS)
    least, most = (expected_visibility(seen, POSITIONS, dense) for dense in (1000, 0))
    assert found[0] < 0.1
    assert found[4] > 0.85
    assert np.corrcoef(found, truth)[0, 1] > 0.95
    assert np.abs(found - truth).mean() < 0.1
    assert (least - 0.1 <= truth).all()
    assert (truth <= most + 0.1).all()


def test_the_denser_unseen_space_is_taken_to_be_the_less_shows():
    seen = SeenScene.of(looks(scene_of(BEFORE), 12))
    shares = [
        expected_visibility(seen, POSITIONS, density) for density in (0, 0.2, 1, 1000)
    ]
    for more, less in pairwise(shares):
        assert (less <= more + 1e-12).all()
    assert shares[-1].sum() < shares[1].sum() < shares[0].sum()


# Policies


def test_visibility_goes_where_most_shows_and_may_go():
    share = np.linspace(0, 1, 40)
    policy, rng = make_policy("visibility", GRID), np.random.default_rng(0)
    assert policy.next_views(state_of(share), rng)[0] == 39
    reachable = np.ones((1, 40), bool)
    reachable[0, 30:] = False
    assert policy.next_views(state_of(share, reachable=reachable), rng)[0] == 29
    near = make_policy("visibility@10", GRID).next_views(state_of(share), rng)[0]
    assert GRID.travel[0, near] == 1
    # by chance
    assert (
        len({int(policy.next_views(state_of(np.ones(40)), rng)[0]) for _ in range(50)})
        > 10
    )


def test_the_product_goes_where_gain_goes_if_everything_shows():
    rng, gain, product = (
        np.random.default_rng(0),
        make_policy("gain", GRID),
        make_policy("visible-gain", GRID),
    )
    assert product.travel_weight == gain.travel_weight
    for _ in range(20):
        state = state_of(np.ones(40), rng.dirichlet(np.ones(10), 1))
        np.testing.assert_array_equal(
            product.next_views(state, rng),
            gain.next_views(state, rng),
        )
    assert set(product.needs) == {*gain.needs, "visibility"}


def test_the_product_avoids_occluded_views():
    rng, product = np.random.default_rng(0), make_policy("visible-gain@0", GRID)
    state = state_of(np.ones(40), rng.dirichlet(np.ones(10), 1))
    best = int(product.next_views(state, rng)[0])
    share = np.ones((1, 40))
    share[0, best] = 0.05
    assert int(product.next_views(replace(state, visibility=share), rng)[0]) != best
    values = product.view_values(replace(state, visibility=np.zeros((1, 40))))
    np.testing.assert_allclose(values, 0)


# In scenes


@pytest.fixture(scope="module")
def predictions(cluttered_views) -> Predictions:
    return scene_predictions(cluttered_views, TEN)


def test_expected_visibility_in_a_store_agrees_with_its_frames(cluttered_views):
    opened = ViewStore.open(cluttered_views)
    sight = SceneSight.of(opened, opened.names[1:])
    visited = np.zeros((3, 40), bool)
    visited[0, [3, 17]] = visited[1, [3]] = visited[2, [17, 3]] = True
    found = sight.visibility(np.array([2, 2, 2]), visited)
    scene = scene_views(opened, 3)
    expected = expected_visibility(
        SeenScene.of([scene.scene_view(3), scene.scene_view(17)]),
        POSITIONS,
    )
    np.testing.assert_allclose(found[0], expected, atol=1e-6)
    np.testing.assert_array_equal(found[0], found[2])
    assert not np.allclose(found[0], found[1])
    np.testing.assert_array_equal(
        sight.of_scenes(np.array([2, 0])).visibility(np.array([0]), visited[:1]),
        found[:1],
    )
    with pytest.raises(DatasetError, match="holds no scene"):
        SceneSight.of(opened, ["nothing@light-0"])


def test_no_policy_goes_where_no_camera_can(predictions):
    specs = make_specs(predictions, 2, 0)
    reachable = specs.scenes.reachable
    assert not reachable.all()
    entries = "random-all", "random", "visibility", "visibility@0.05"
    for name in (*entries, "true-visible_share-all", "oracle-gain-all"):
        views = replay(name, specs, 4, 0).views
        assert reachable[specs.objects[:, None], views].all(), name
    entries = default_entries(specs)
    assert {"visibility", "true-visible_share-all", "random-all"} <= set(entries)
    assert not any(name.startswith(("best-", "orbit-")) for name in entries)
    with pytest.raises(EntryError, match="cannot be reached"):
        replay("orbit-40", specs, 4, 0)


def test_views_without_the_target_are_no_evidence(predictions):
    hidden = ~predictions.seen
    assert hidden.any()
    scene, view = np.argwhere(hidden)[0]
    assert not predictions.evidence(np.array([scene]), np.array([view])).seen[0]
    of_size = np.full((len(predictions), 10), np.float32(0.3))
    sized = replace(predictions, logits=predictions.logits + 0.3, of_size=of_size)
    np.testing.assert_array_equal(sized.seen, predictions.seen)


# Replay


def test_scenes_without_their_store_are_not_treated_as_single_objects(
    predictions,
    tmp_path,
):
    lost = replace(predictions, store=str(tmp_path / "lost.zarr"))
    with pytest.raises(
        DatasetError,
        match=r"of scenes, and there is no view store at .*lost.zarr any more",
    ):
        make_specs(lost, 1, 0)
    with pytest.raises(
        DatasetError,
        match="are of scenes, and name no view store; predict again",
    ):
        make_specs(replace(predictions, store=""), 1, 0)
    alone = replace(lost, names=tuple(f"thing_{i}" for i in range(len(lost))))
    assert make_specs(alone, 1, 0).scenes is None


def test_scenes_around_one_target_are_drawn_together():
    names = ("a@light-0", "b@light-0", "a@heavy-0", "c@heavy-0", "a@heavy-1")
    families = statistics.target_families(names)
    weights = statistics.resample_families(families, 200, np.random.default_rng(0))
    for same in (2, 4):
        np.testing.assert_array_equal(weights[:, 0], weights[:, same])
    # as many targets as there are
    np.testing.assert_array_equal(weights[:, [0, 1, 3]].sum(1), 3)
    plain = statistics.resample(5, 200, np.random.default_rng(0))
    np.testing.assert_array_equal(
        statistics.resample_families(
            statistics.target_families(tuple("abcde")),
            200,
            np.random.default_rng(0),
        ),
        plain,
    )
