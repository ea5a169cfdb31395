"""Choosing views among things: what is expected to show, by closed forms; policies by it; worlds in replay and live."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from test_predictions import some_predictions
from test_worlds import BALL, GRID, meshes, scene_of, store, worlds  # noqa: F401
from tiny_models import make_recogniser

import nextview
from nextview.belief import Calibration, FixedLength, Stopping
from nextview.benchmark.entries import default_entries
from nextview.benchmark.experiment import Grid, run_grid
from nextview.benchmark.levels import by_level, levels_of
from nextview.benchmark.replay import make_specs, replay
from nextview.calibration.stages import fit_visibility
from nextview.cameras.simulated import SimulatedCamera
from nextview.data.planning import plan
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.data.world_drawing import tasks
from nextview.data.world_sight import WorldSight
from nextview.data.world_views import scene_intrinsics, world_views
from nextview.episode import Episodes
from nextview.errors import DatasetError, EntryError, ModelError, ObservationError, PolicyError, PredictionsError
from nextview.mesh import make_mesh
from nextview.models.model_card import read_card
from nextview.observation import SceneView
from nextview.occupancy import SeenScene, expected_visibility, shown_share
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.gain import INPUTS, VISIBILITY, Gain, features, mirrored, mirrored_features
from nextview.policies.registry import make_policy, with_cards
from nextview.policies.visibility import VisibleGain
from nextview.policies.volumetric import Volumetric
from nextview.sensing import Frame, ObservedObject
from nextview.session import Session
from nextview.viewsphere import Directions
from nextview.worlds import TARGET, Block, OccludedCamera, SceneCamera, WorldCamera

POSITIONS = GRID.poses[:, :3, 3]
BEFORE = Block(1.6, 0.0, 0.0, 0.2, 2.6, 2.2)
"""Hides the ball from the front, and nothing from behind."""


def looks(scene, *views: int) -> list[SceneView]:
    """What a camera without errors sees of a scene."""
    k = scene_intrinsics(GRID.distance, 80)
    camera, found = SceneCamera(scene, k, (80, 80)), []
    for view in views:
        depth, owner = camera.look(GRID.poses[view])
        found.append(SceneView(depth, owner == TARGET, GRID.poses[view], k, True))
    return found


def state_of(visibility, belief=None, reachable=None) -> EpisodeState:
    """One episode after view 0."""
    visited = np.zeros((1, 40), bool)
    visited[0, 0] = True
    belief = np.full((1, 10), 0.1) if belief is None else belief
    bins = np.full((1, 10, 8), 1 / 8)
    evidence = Evidence(np.log(belief), {"lem-sphere": np.zeros((1, 5, 8))}, bins)
    return EpisodeState(
        np.zeros(1, int), visited, belief, evidence, 1, azimuth_bins=bins, reachable=reachable,
        visibility=np.asarray(visibility, float).reshape(1, 40),
    )  # fmt: skip


# What is expected to show


def test_before_anything_is_seen_everything_may_show():
    found = expected_visibility(SeenScene.unseen(), POSITIONS)
    assert (found.least <= found.expected).all()
    assert (found.expected <= found.most).all()
    np.testing.assert_array_equal(found.most, 1)
    np.testing.assert_array_equal(found.least, 1)


def test_alone_on_its_table_all_of_it_shows_once_the_space_around_was_seen():
    found = expected_visibility(SeenScene.of(looks(scene_of(), *range(0, 40, 3))), POSITIONS)
    assert found.least[8:].min() > 0.95  # level with the table its edge is in doubt
    np.testing.assert_allclose(found.most, 1, atol=0.05)


def test_a_box_hides_what_is_behind_it_as_far_as_a_camera_without_errors_says():
    scene = scene_of(BEFORE)
    truth = np.array([OccludedCamera(scene, 64).visible_share(pose) for pose in GRID.poses])
    found = expected_visibility(SeenScene.of(looks(scene, 2, 4, 14, 22, 30)), POSITIONS)
    assert found.expected[0] < 0.1
    assert found.expected[4] > 0.85
    assert np.corrcoef(found.expected, truth)[0, 1] > 0.95
    assert np.abs(found.expected - truth).mean() < 0.1
    assert (found.least - 0.1 <= truth).all()
    assert (truth <= found.most + 0.1).all()


def test_the_denser_unseen_space_is_taken_to_be_the_less_shows():
    seen = SeenScene.of(looks(scene_of(BEFORE), 12))
    shares = [expected_visibility(seen, POSITIONS, density).expected for density in (0, 0.2, 1, 1000)]
    for more, less in pairwise(shares):
        assert (less <= more + 1e-12).all()
    found = expected_visibility(seen, POSITIONS)
    np.testing.assert_allclose(shares[0], found.most)
    np.testing.assert_allclose(shares[-1], found.least, atol=1e-12)


def test_the_order_of_frames_makes_no_difference_and_parts_are_put_together():
    first, second, third = looks(scene_of(BEFORE), 3, 14, 30)
    whole = SeenScene.of([first, second, third])
    parts = SeenScene.of([third]).and_also(SeenScene.of([second, first]))
    np.testing.assert_array_equal(whole.occupancy.cells, parts.occupancy.cells)
    assert whole.floor == parts.floor == pytest.approx(-1, abs=0.02)


def test_a_scene_of_two_shapes_is_refused():
    with pytest.raises(ObservationError, match="of one shape"):
        SceneView(np.zeros((4, 4), np.float32), np.zeros((4, 5), bool), np.eye(4), np.eye(3))


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
    assert len({int(policy.next_views(state_of(np.ones(40)), rng)[0]) for _ in range(50)}) > 10  # by chance


def test_the_product_goes_where_gain_goes_if_everything_shows():
    rng, gain, product = np.random.default_rng(0), make_policy("gain", GRID), make_policy("visible-gain", GRID)
    assert product.travel_weight == gain.travel_weight
    for _ in range(20):
        state = state_of(np.ones(40), rng.dirichlet(np.ones(10), 1))
        np.testing.assert_array_equal(product.next_views(state, rng), gain.next_views(state, rng))
    assert set(product.needs) == {*gain.needs, "visibility"}


def test_the_product_shuns_what_is_hidden():
    rng, product = np.random.default_rng(0), make_policy("visible-gain@0", GRID)
    state = state_of(np.ones(40), rng.dirichlet(np.ones(10), 1))
    best = int(product.next_views(state, rng)[0])
    share = np.ones((1, 40))
    share[0, best] = 0.05
    assert int(product.next_views(replace(state, visibility=share), rng)[0]) != best
    values = product.view_values(replace(state, visibility=np.zeros((1, 40))))
    np.testing.assert_allclose(values, 0)


def test_policies_by_what_shows_want_to_be_told_and_to_be_named_right():
    with pytest.raises(PolicyError, match="share of the object"):
        make_policy("visibility", GRID).view_values(replace(state_of(np.ones(40)), visibility=None))
    with pytest.raises(PolicyError, match="values no views"):
        make_policy("visible-class-table", GRID)
    with pytest.raises(PolicyError, match="does not weigh travel"):
        make_policy("random@1", GRID)
    with pytest.raises(PolicyError, match="at least 0"):
        make_policy("visibility@-1", GRID)
    with pytest.raises(PolicyError, match="at least 0"):
        make_policy("visible-gain@much", GRID)
    with pytest.raises(PolicyError, match="not negative"):
        VisibleGain(make_policy("gain", GRID), np.nan)


def test_a_name_may_be_that_of_a_card_of_ones_own():
    cards = {"gain": Path("mine/gain.json")}
    found = [with_cards(name, cards) for name in ("gain", "gain@1", "visible-gain", "visible-gain@1", "spread")]
    mine = "mine/gain.json"
    assert found == [mine, f"{mine}@1", f"visible-{mine}", f"visible-{mine}@1", "spread"]


def test_the_volume_behind_a_thing_does_not_come_into_view():
    """After a view from behind, the front is unseen; the box before it hides it from the front."""
    scene, policy = scene_of(BEFORE), Volumetric(GRID)
    camera = SimulatedCamera(BALL, 64)
    seen = [
        replace(camera.observe(GRID.poses[v]), scene=look) for v, look in zip((3, 5), looks(scene, 3, 5), strict=True)
    ]
    among = policy.view_values(replace(state_of(np.ones(40)), observations=[seen]))[0]
    alone = policy.view_values(
        replace(state_of(np.ones(40)), observations=[[replace(view, scene=None) for view in seen]])
    )[0]
    beside = [1, 7, 9, 15]  # there the box, of which only the edges were seen, hides what is unseen of the ball
    assert (among[beside] < 0.75 * alone[beside]).all()
    np.testing.assert_allclose(among[32:], alone[32:], rtol=0.1)


# Learned


@pytest.mark.parametrize("frame", ["camera", "object"])
def test_what_shows_is_told_to_networks_cell_by_cell(frame):
    rng = np.random.default_rng(0)
    state = replace(state_of(rng.random(40)), current=np.array([11]))
    whole = features(GRID, state, (*INPUTS[:3], "lem-sphere", "azimuth_bin", VISIBILITY), frame)
    without = features(GRID, state, (*INPUTS[:3], "lem-sphere", "azimuth_bin"), frame)
    np.testing.assert_array_equal(whole[:, :-40], without)
    alone = features(GRID, state, (VISIBILITY,), "camera")[0]
    assert alone[8] == state.visibility[0, 11]  # straight ahead on its own ring
    assert alone[9] == state.visibility[0, 12]
    np.testing.assert_array_equal(np.sort(alone), np.sort(state.visibility[0]))
    np.testing.assert_array_equal(mirrored_features(GRID, 10, (VISIBILITY,)), mirrored(GRID))
    policy = Gain(GRID, 10, lambda seen: seen, (VISIBILITY,))
    assert policy.needs == (VISIBILITY,)
    np.testing.assert_allclose(policy.gains(state), state.visibility, atol=1e-6)


# In worlds


OWN = "test_world_policies:FirstFree"


class FirstFree:
    """A policy that wants to see scenes, and makes nothing of them."""

    needs = ("observations",)

    def __init__(self, sphere):
        pass

    def next_views(self, state, rng):
        assert all(seen.scene is not None for views in state.observations for seen in views)
        return state.free.argmax(1)


@pytest.fixture(scope="module")
def predictions(store) -> Predictions:  # noqa: F811
    """Random ones of a store of worlds; where nothing of a target shows, all classes are alike."""
    opened = ViewStore.open(store)
    made = some_predictions(len(opened))
    entropy = opened.measure()
    logits = np.where((opened.measure("visible_share") > 0.05)[..., None], made.logits, 0).astype(np.float32)
    return replace(
        made, names=tuple(opened.names), depth_entropy=entropy, logits=logits, store=str(store),
        splits=np.array(["test"] * len(opened)),
    )  # fmt: skip


def test_what_is_expected_in_a_store_is_what_its_frames_say(store):  # noqa: F811
    opened = ViewStore.open(store)
    sight = WorldSight.of(opened, opened.names[1:])
    visited = np.zeros((3, 40), bool)
    visited[0, [3, 17]] = visited[1, [3]] = visited[2, [17, 3]] = True
    found = sight.visibility(np.array([2, 2, 2]), visited)
    world = world_views(opened, 3)
    expected = expected_visibility(SeenScene.of([world.scene_view(3), world.scene_view(17)]), POSITIONS).expected
    np.testing.assert_allclose(found[0], expected, atol=1e-6)
    np.testing.assert_array_equal(found[0], found[2])
    assert not np.allclose(found[0], found[1])
    np.testing.assert_array_equal(sight.of_worlds(np.array([2, 0])).visibility(np.array([0]), visited[:1]), found[:1])
    with pytest.raises(DatasetError, match="holds no world"):
        WorldSight.of(opened, ["nothing@light-0"])


def test_no_policy_goes_where_no_camera_can(predictions, store):  # noqa: F811
    list(plan(store, [OWN], workers=0))
    specs = make_specs(predictions, 2, 0)
    reachable = specs.worlds.reachable
    assert not reachable.all()
    entries = "random-all", "random", "visibility", "visibility@0.05"
    for name in (*entries, OWN, "true-visible_share-all", "oracle-gain-all"):
        views = replay(name, specs, 4, 0).views
        assert reachable[specs.objects[:, None], views].all(), name
    entries = default_entries(specs)
    assert {"visibility", "true-visible_share-all", "random-all"} <= set(entries)
    assert not any(name.startswith(("best-", "orbit-")) for name in entries)
    with pytest.raises(EntryError, match="cannot be reached"):
        replay("orbit-40", specs, 4, 0)


def test_visibility_sees_more_than_random_in_worlds(predictions):
    specs = make_specs(predictions, 4, 0)
    share = ViewStore.open(predictions.store).measure("visible_share")
    seen = {
        name: share[specs.objects, replay(name, specs, 2, 0).views[:, 1]].mean()
        for name in ("random-all", "visibility", "true-visible_share-all")
    }
    assert seen["random-all"] + 0.1 < seen["visibility"] <= seen["true-visible_share-all"]


def test_single_objects_hide_nothing_from_policies():
    specs = make_specs(some_predictions(), 2, 0)
    assert specs.worlds is None
    assert not {"visibility", "visible-gain"} & set(default_entries(specs))
    assert (replay("visibility", specs, 3, 0).views >= 0).all()


def test_views_without_the_target_are_no_evidence(predictions):
    hidden = ~predictions.seen
    assert hidden.any()
    world, view = np.argwhere(hidden)[0]
    evidence = predictions.evidence(np.array([world]), np.array([view]))
    assert not evidence.seen[0]
    sized = replace(
        predictions, logits=predictions.logits + 0.3, of_size=np.full((len(predictions), 3), np.float32(0.3))
    )
    np.testing.assert_array_equal(sized.seen, predictions.seen)


def test_levels_are_compared_after_a_number_of_views(predictions):
    assert levels_of(("chair_1@heavy-0", "chair_1", "a@b")).tolist() == ["heavy", "", ""]
    specs = make_specs(predictions, 3, 0)
    grid = Grid(specs, 3, (0.9,), 3, 0)
    assert list(run_grid(grid, ["random", "visibility"])) == [1, 2]
    table = by_level(grid, "random", 50, np.random.default_rng(0))
    assert table["level"].unique().tolist() == ["light", "medium", "heavy"]
    assert table["worlds"].unique().tolist() == [2]
    assert sorted(table["n_views"].unique()) == [1, 2, 3]
    paths = grid.paths["visibility"]
    mine = np.isin(specs.objects, np.flatnonzero(levels_of(predictions.names) == "heavy"))
    row = table.query("level == 'heavy' and policy == 'visibility' and n_views == 2").iloc[0]
    assert row["accuracy"] == pytest.approx((paths.answers[mine, 1] == specs.labels[mine]).mean())
    assert row["travel"] == pytest.approx(paths.travel[mine, 1].mean())
    assert (table["p"].isna() == ((table["policy"] == "random") | (table["n_views"] == 1))).all()
    both = table.dropna(subset="p")
    assert (both["p_holm"] >= both["p"]).all()


def test_gain_learns_in_worlds_what_to_make_of_what_shows(predictions, tmp_path):
    from nextview.training.gain.gain_training import train_gain
    from nextview.training.recipes import GainRecipe

    train = np.array(["train"] * len(predictions))
    replace(predictions, splits=train).save(tmp_path / "p.npz")
    recipe = GainRecipe(("belief", "place", "visibility"), "camera", epochs=1, walks=1, networks=1)
    made = train_gain(tmp_path / "p.npz", tmp_path / "in-worlds.json", recipe, folds=2, travel_weight=0.01)
    assert made.objects == len(predictions)
    policy = make_policy(str(made.card), GRID, classes=predictions.classes)
    assert policy.needs == ("visibility",)
    specs = make_specs(predictions, 1, 0)
    views = replay(str(made.card), specs, 4, 0).views
    assert specs.worlds.reachable[specs.objects[:, None], views].all()
    replace(some_predictions(), splits=train).save(tmp_path / "alone.npz")
    with pytest.raises(PredictionsError, match="of no worlds"):
        train_gain(tmp_path / "alone.npz", tmp_path / "alone.json", recipe, folds=2)


def test_folds_look_at_a_frame_once(predictions, tmp_path, monkeypatch):
    from nextview.training.gain.gain_training import train_gain
    from nextview.training.recipes import GainRecipe

    taken, seen = [], SeenScene.seen

    def counted(scene, view):
        taken.append((view.depth.tobytes(), view.pose.tobytes()))
        return seen(scene, view)

    monkeypatch.setattr(SeenScene, "seen", counted)
    replace(predictions, splits=np.array(["train"] * len(predictions))).save(tmp_path / "p.npz")
    recipe = GainRecipe(("belief", "visibility"), "camera", epochs=2, walks=2, networks=1)
    train_gain(tmp_path / "p.npz", tmp_path / "in-worlds.json", recipe, folds=2, travel_weight=0.01)
    assert len(taken) > 40
    assert len(taken) == len(set(taken))


def test_worlds_for_learning_are_drawn_around_what_was_held_out(meshes, tmp_path):  # noqa: F811
    card = make_recogniser(tmp_path, ["crate", "jar"])
    card.write_text(json.dumps(json.loads(card.read_text()) | {"held_out": ["jar_0", "crate_3"]}))
    found = tasks(meshes, tmp_path / "w", ["light"], None, 0, None, card)
    assert sorted(task.name for task in found) == ["crate_3@light-0", "jar_0@light-0"]


# What a view counts


def test_a_frame_tells_how_much_of_the_object_it_shows():
    half = Block(1.6, 1.5, 0.0, 0.1, 3.0, 3.0)
    for scene, share in ((scene_of(), 1.0), (scene_of(half), 0.5), (scene_of(BEFORE), 0.0)):
        assert shown_share(looks(scene, 0)[0]) == pytest.approx(share, abs=0.13)


def test_a_view_counts_as_much_as_it_shows():
    """Two views of the same logits, of which one shows a quarter: as much as one and a half of them."""
    calibration, logits = Calibration(0.8, 0.5, visibility=0.5), np.array([[1.0, 0.2, -0.5]])
    spread, rule = make_policy("spread", GRID), FixedLength(max_views=2)
    episodes = Episodes(GRID, spread, np.array([0]), rule, np.random.default_rng(0), calibration)
    episodes.update(Evidence(logits, shown=np.array([1.0])))
    step = episodes.update(Evidence(logits, shown=np.array([0.25])))
    np.testing.assert_allclose(step.seen, 1.5)
    expected = calibration.log_belief(1.5 * logits, 1.5, 3)
    np.testing.assert_allclose(np.log(step.belief), expected - np.log(np.exp(expected).sum()))
    plain = replace(calibration, visibility=None)
    assert (plain.weights(np.array([0.2])), calibration.weights(None)) == (1.0, 1.0)
    assert Calibration.from_dict(calibration.to_dict()) == calibration
    with pytest.raises(ModelError, match="no calibration"):
        Calibration(visibility=-1.0)


def test_the_power_is_fitted_to_what_hidden_views_are_worth(predictions, tmp_path):
    """Logits as clear as the share that shows to the power of one, and noise: full trust in all views is worse."""
    share = ViewStore.open(predictions.store).measure("visible_share")
    rng = np.random.default_rng(0)
    truth = np.eye(3)[predictions.labels][:, None]
    logits = (4 * share[..., None] * truth + rng.normal(size=predictions.logits.shape) * 2).astype(np.float32)
    names = [name.partition("@")[0] for name in predictions.names]
    card = make_recogniser(tmp_path, list(predictions.classes))
    card.write_text(json.dumps(json.loads(card.read_text()) | {"held_out": sorted(set(names))}))
    models = {"recogniser": ("tiny", read_card(card).sha256)}
    table = replace(predictions, logits=logits, splits=np.array(["train"] * len(names)), models=models)
    table.save(tmp_path / "p.npz")
    found = fit_visibility(tmp_path / "p.npz", card)
    assert found.worlds == len(names)
    assert found.power > 0
    assert found.losses[found.power] < found.losses[0.0]
    assert read_card(card).calibration.visibility == found.power
    counted = replace(table, calibration=Calibration(visibility=1.0), splits=predictions.splits)
    assert replay("random-all", make_specs(counted, 1, 0), 3, 0).confidences.max() <= 1
    replace(table, splits=predictions.splits).save(tmp_path / "p.npz")
    with pytest.raises(PredictionsError, match="test split"):
        fit_visibility(tmp_path / "p.npz", card)


# Live


@pytest.mark.parametrize("named", ["box", "mask"])
def test_a_robot_sees_around_a_box(named):
    crate = make_mesh(*(lambda m: (m.vertices, m.faces))(trimesh.creation.box([1, 1.2, 0.9])))
    scene = scene_of(Block(1.9, 0.0, 0.0, 0.3, 1.1, 1.6), target=crate)
    truth = np.array([OccludedCamera(scene, 64).visible_share(pose) for pose in GRID.poses])
    assert truth[0] < 0.6 < truth[3]
    camera = WorldCamera(scene, named=named)
    system = nextview.load(policy="visibility")
    session = Session(system.models, system.policy, system.sphere, 0, FixedLength(max_views=3), object=camera.object)
    session.reachable = camera.reachable
    while not session.done:
        session.update(camera.observe(session.pose))
    first = session.views[0]
    assert first.observation.scene is not None
    assert truth[[view.index for view in session.views[1:]]].min() > 0.9


def test_where_no_scene_is_known_everything_shows():
    episodes = Episodes(
        Directions(GRID.directions), make_policy("visibility", GRID), np.array([0]), Stopping(1.0, 3),
        np.random.default_rng(0),
    )  # fmt: skip
    episodes.update(Evidence(np.zeros((1, 2))))
    np.testing.assert_array_equal(episodes.steps[-1].state.visibility, 1)
    camera = SimulatedCamera(BALL, 64)
    views = [camera.observe(GRID.poses[0])]
    episodes.update(Evidence(np.zeros((1, 2)), observations=views))
    np.testing.assert_array_equal(episodes.steps[-1].state.visibility, 1)


def test_a_finer_sensor_says_the_same_of_a_scene():
    """Depth of a sensor is thinned out: its pixels keep their places."""
    scene = scene_of(BEFORE)
    k = np.array([[900.0, 0, 360], [0, 900, 360], [0, 0, 1]])
    depth, owner = SceneCamera(scene, k, (720, 720)).look(GRID.poses[3])
    frame = Frame(0.2 * depth, k, _metres(GRID.poses[3]), owner == TARGET, pixel_centre=0.5)
    seen = ObservedObject(denoise=False).add(frame)
    there = seen.scene
    assert there.depth.shape[0] < 240
    rows, columns = np.nonzero(there.target)
    z = there.depth[rows, columns]
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))]).T @ np.linalg.inv(there.intrinsics).T
    points = (rays * z[:, None]) @ there.pose[:3, :3].T + there.pose[:3, 3]
    # On a sphere, whatever its estimated centre and radius are.
    centre = np.linalg.lstsq(np.column_stack([2 * points, np.ones(len(points))]), (points**2).sum(1), rcond=None)[0]
    np.testing.assert_allclose(np.linalg.norm(points - centre[:3], axis=1).std(), 0, atol=0.01)


def _metres(pose):
    moved = pose.copy()
    moved[:3, 3] *= 0.2
    return moved
