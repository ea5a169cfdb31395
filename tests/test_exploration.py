"""What the explorer shows, without a page: objects, walks and what follows from each view."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

import nextview
from nextview.cameras.simulated import SimulatedCamera
from nextview.data.rendering import render
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError, MeshError, PolicyError, UsageError
from nextview.explorer.card import gallery, preview_card, walk_card
from nextview.explorer.exploration import Exploration
from nextview.explorer.shown_object import ShownObject, StoredViews, shown_objects
from nextview.report.style import heat
from nextview.viewsphere import ViewSphere, angle_between

SAMPLES = Path(__file__).parent.parent / "samples"


@pytest.fixture
def chair():
    return Exploration(shown_objects(), ("gain", "furthest"), start=3, threads=1)


@pytest.mark.parametrize("policy", ["gain", "lem", "spread"])
@pytest.mark.parametrize("start", [3, 22])
def test_a_policy_walks_as_it_does_in_an_episode(policy, start):
    options = {"threshold": 0.9995, "max_views": 4, "threads": 1}
    episode = nextview.load(policy=policy, **options).recognise(sample_mesh("monitor"), start=start)
    monitor = [shown for shown in shown_objects() if shown.name == "monitor"]
    exploration = Exploration(monitor, (policy,), start=start, **options)
    walk = exploration.walks[0]
    while exploration.walk_on():
        assert len(walk.views) < 5
    assert walk.stopped
    assert walk.visited == [view.index for view in episode.views]
    for seen, expected in zip(walk.views, episode.views, strict=True):
        np.testing.assert_array_equal(seen.belief, expected.belief)
        np.testing.assert_array_equal(seen.observation.depth, expected.observation.depth)


def test_exploring_goes_on_where_the_rule_would_stop(chair):
    walk = chair.walks[0]
    for views in range(1, 41):
        assert walk.next_view not in walk.visited
        chair.step()
        assert len(walk.views) == views
        assert walk.stopped or views < 5
    assert sorted(walk.visited) == list(range(40))
    assert walk.next_view is None
    chair.step()  # nothing is left to take
    assert not chair.walk_on()
    with pytest.raises(UsageError, match="every candidate view was taken"):
        walk.look(3)


def test_a_view_by_hand_counts_from_where_it_was_taken(chair):
    walk = chair.walks[0]
    walk.look(5)
    pose = chair.pose_towards(np.array([2.0, -1.0, 1.5]))
    view = walk.look(pose)
    assert walk.visited[0] == 5
    np.testing.assert_allclose(view.direction, np.array([2.0, -1.0, 1.5]) / np.sqrt(7.25))
    assert view.travel == pytest.approx(float(walk.sphere.travel_between(walk.sphere.directions[5], view.direction)))
    assert len(chair.walks[1].views) == 0  # the other one is where it was


@pytest.mark.parametrize("place", [(0.3, 0.2, 4), (-5, 1, -2), (0, 0, 0), (0, 0, 1)])
def test_a_camera_that_is_dragged_looks_at_the_object_level_and_from_the_usual_distance(chair, place):
    pose = chair.pose_towards(np.array(place, float))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3] + 3 * pose[:3, 2], 0, atol=1e-12)
    assert pose[2, 0] == pytest.approx(0)  # x, right, is level
    if any(place):
        assert angle_between(pose[:3, 3] / 3, np.array(place) / np.linalg.norm(place)) < 1e-7


def test_a_preview_is_what_would_be_seen_and_takes_nothing(chair):
    place = np.array([1.0, 2.0, 0.5])
    seen = chair.preview(place)
    expected = SimulatedCamera(sample_mesh("chair")).observe(chair.pose_towards(place))
    np.testing.assert_array_equal(seen.depth, expected.depth)
    assert not chair.walks[0].views


def test_pictures_are_of_the_objects_that_can_be_opened(tmp_path):
    shutil.copy(SAMPLES / "chair.off", tmp_path / "a.off")
    (tmp_path / "b.off").write_text("OFF\n")
    exploration = Exploration(shown_objects(tmp_path), threads=1)
    pictures = exploration.pictures()
    assert list(pictures) == ["a.off"]
    assert (pictures["a.off"] > 0).mean() > 0.05
    assert ">a.off<" in gallery(pictures)
    with pytest.raises(MeshError):
        exploration.show("b.off")
    assert (exploration.shown.name, exploration.mesh.name) == ("a.off", str(tmp_path / "a.off"))


def test_another_policy_takes_over_the_views(chair):
    chair.step()
    chair.step()
    before = chair.walks[0]
    chair.compare(["lem", "gain"])
    after = chair.walks[0]
    assert chair.policies == ["lem", "gain"]
    assert after.visited == before.visited
    np.testing.assert_array_equal(after.views[-1].belief, before.views[-1].belief)
    assert np.isnan(after.values).any()  # lem considers its window alone
    assert np.isfinite(before.values).all()
    chair.compare(["gain"])
    assert chair.walks[0].visited == before.visited
    np.testing.assert_array_equal(chair.walks[0].values, before.values)
    with pytest.raises(PolicyError):
        chair.compare(["no such policy"])
    assert chair.policies == ["gain"]


def test_a_sensor_errs_alike_for_both_policies_and_again(chair):
    chair.step()
    clean = chair.walks[0].views[0].observation.depth
    chair.use_sensor("stereo")
    chair.step()
    first, second = (walk.views[0].observation.depth for walk in chair.walks)
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, clean)
    chair.restart()
    assert not chair.walks[0].views
    chair.step()
    np.testing.assert_array_equal(chair.walks[0].views[0].observation.depth, first)
    with pytest.raises(UsageError, match="no sensor is called"):
        chair.use_sensor("eye")
    assert (chair.sensor, len(chair.walks[0].views)) == ("stereo", 1)
    chair.show("table")
    assert (chair.sensor, chair.mesh.name, len(chair.walks[0].views)) == ("stereo", "table", 0)


def test_the_points_seen_lie_on_the_object(chair):
    assert chair.walks[0].points.shape == (0, 3)
    for _ in range(3):
        chair.walks[0].step()
    points = chair.walks[0].points
    assert points.shape == (3 * 1024, 3)
    surface = trimesh.Trimesh(chair.mesh.vertices, chair.mesh.faces)
    sampled = surface.sample(200_000)
    nearest = [np.linalg.norm(sampled - point, axis=1).min() for point in points[::64]]
    assert max(nearest) < 0.03


def test_objects_of_files_and_folders(tmp_path):
    assert [shown.name for shown in shown_objects()] == ["chair", "table", "monitor"]
    assert [shown.name for shown in shown_objects(SAMPLES)] == ["chair.off", "monitor.off", "table.off"]
    (one,) = shown_objects(SAMPLES / "chair.off")
    np.testing.assert_allclose(one.open().vertices, sample_mesh("chair").vertices, atol=1e-6)
    for label, split in (("chair", "train"), ("table", "test")):
        (tmp_path / label / split).mkdir(parents=True)
        shutil.copy(SAMPLES / f"{label}.off", tmp_path / label / split / f"{label}_1.off")
    assert [(shown.name, shown.label) for shown in shown_objects(tmp_path)] == [
        ("chair_1", "chair"),
        ("table_1", "table"),
    ]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="no meshes"):
        shown_objects(tmp_path / "empty")


def test_the_objects_of_a_store_are_seen_as_they_were_rendered(tmp_path):
    (tmp_path / "meshes" / "chair").mkdir(parents=True)
    (tmp_path / "meshes" / "chair" / "broken.off").write_text("OFF\n")
    shutil.copy(SAMPLES / "chair.off", tmp_path / "meshes" / "chair" / "seat.off")
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", ViewSphere.named("40"), 112, workers=0))
    (shown,) = shown_objects(tmp_path / "views.zarr")
    assert (shown.name, shown.label) == ("seat", "chair")
    exploration = Exploration([shown], start=3, threads=1)
    assert exploration.mesh is None
    exploration.step()
    view = exploration.walks[0].views[0]
    expected = SimulatedCamera(sample_mesh("chair"), 112).observe(ViewSphere.named("40").poses[3])
    np.testing.assert_allclose(view.observation.depth, expected.depth, atol=1e-3)
    np.testing.assert_array_equal(view.observation.pose, expected.pose)
    nearby = exploration.walks[0].look(exploration.pose_towards(ViewSphere.named("40").directions[12] + (0, 0, 0.02)))
    np.testing.assert_array_equal(nearby.observation.pose, ViewSphere.named("40").poses[12])  # its own pose counts
    with pytest.raises(UsageError, match="seat has only stored views"):
        exploration.use_sensor("kinect")
    assert isinstance(shown.open(), StoredViews)
    (tmp_path / "none" / "chair").mkdir(parents=True)
    (tmp_path / "none" / "chair" / "broken.off").write_text("OFF\n")
    list(render(tmp_path / "none", tmp_path / "none.zarr", ViewSphere.named("40"), 32, workers=0))
    with pytest.raises(DatasetError, match="no object in it is rendered"):
        shown_objects(tmp_path / "none.zarr")


def test_a_first_view_that_is_none_is_refused():
    with pytest.raises(UsageError, match="the first view is a whole number from 0 to 39, not 40"):
        Exploration(shown_objects(), start=40, threads=1)
    with pytest.raises(UsageError, match="the seed is a whole number"):
        Exploration(shown_objects(), seed=-1, threads=1)


def test_colours_say_which_values_are_higher():
    colours = heat(np.array([np.nan, -1.0, 0.0, 2.0])).astype(int)
    brightness = colours[1:] @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(brightness) > 0).all()
    assert colours[0].tolist() == [201, 210, 218]
    assert (heat(np.full(3, np.nan)) == colours[0]).all()
    assert (heat(np.full(3, 7.0)) == colours[1]).all()  # all the same: nothing divides by zero


def test_a_card_says_what_is_believed(chair):
    walk = chair.walks[0]
    assert "The policy begins at view 3" in walk_card(walk)
    for _ in range(2):
        walk.step()
    card = walk_card(walk, 41.4)
    first, second = (view.belief for view in walk.views)
    best = int(second.argmax())
    assert f"<h3>{walk.session.models.classes[best]} {second[best]:.3f}</h3>" in card
    assert f"{second[best] - first[best]:+.3f}</td>" in card
    assert "41 ms" in card
    assert card.count("<img") == 2 + len(walk.views[-1].maps)
    assert re.findall(r">view (\d+)<", card) == [str(view) for view in walk.visited]
    assert preview_card(walk.views[0].observation).count("<img") == 1


def test_an_azimuth_a_hair_below_a_full_turn_is_none(chair):
    walk = chair.walks[0]
    walk.look(chair.pose_towards(np.array([3.0, -1e-3, 0.0])))
    assert walk.views[0].angles[1] > 359.9
    assert "0° up, 0° round" in walk_card(walk)


def test_a_card_shows_names_as_they_are(chair, monkeypatch):
    walk = chair.walks[0]
    walk.step()
    monkeypatch.setattr(type(walk.session.models), "classes", tuple(f"<script>{k}" for k in range(10)))
    assert "<script>" not in walk_card(walk)
    assert "&lt;script&gt;" in walk_card(walk)


def test_objects_need_not_be_files():
    own = ShownObject("mine", lambda: sample_mesh("table"), "table")
    assert Exploration([own], threads=1).mesh.name == "table"
