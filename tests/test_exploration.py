"""What the explorer shows, without a page: objects, walks and what follows from each view."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError
from nextview.geometry.viewsphere import ViewSphere
from nextview.viewers.exploration import Exploration, shown_objects

SAMPLES, SPHERE = Path(__file__).parents[1] / "samples", ViewSphere.named("40")


@pytest.fixture
def chair():
    return Exploration(shown_objects(), ("gain", "furthest"), start=3, threads=1)


@pytest.mark.parametrize("policy", ["gain", "lem", "spread"])
@pytest.mark.parametrize("start", [3, 22])
def test_a_policy_walks_as_it_does_in_an_episode(policy, start):
    options = {"threshold": 0.9995, "max_views": 4, "threads": 1}
    episode = nextview.load(policy=policy, **options).recognise(
        sample_mesh("monitor"), start=start
    )
    monitor = [shown for shown in shown_objects() if shown.name == "monitor"]
    exploration = Exploration(monitor, (policy,), start=start, **options)
    walk = exploration.walks[0]
    while exploration.walk_on():
        assert len(walk.views) < 5
    assert walk.stopped
    assert walk.visited == [view.index for view in episode.views]
    for seen, expected in zip(walk.views, episode.views, strict=True):
        np.testing.assert_array_equal(seen.belief, expected.belief)
        np.testing.assert_array_equal(
            seen.observation.depth, expected.observation.depth
        )


def test_a_view_by_hand_counts_from_where_it_was_taken(chair):
    walk = chair.walks[0]
    walk.look(5)
    view = walk.look(chair.pose_towards(np.array([2.0, -1.0, 1.5])))
    assert walk.visited[0] == 5
    np.testing.assert_allclose(
        view.direction, np.array([2.0, -1.0, 1.5]) / np.sqrt(7.25)
    )
    assert view.travel == pytest.approx(
        float(walk.sphere.travel_between(walk.sphere.directions[5], view.direction))
    )
    assert len(chair.walks[1].views) == 0  # the other one is where it was


def test_objects_of_files_and_folders(tmp_path):
    assert [shown.name for shown in shown_objects()] == ["chair", "table", "monitor"]
    flat = [(shown.name, shown.label) for shown in shown_objects(SAMPLES)]
    assert flat == [("chair", None), ("monitor", None), ("table", None)]
    (one,) = shown_objects(SAMPLES / "chair.off")
    assert one.open().faces.shape == sample_mesh("chair").faces.shape
    for label, split in (("chair", "train"), ("table", "test")):
        (tmp_path / label / split).mkdir(parents=True)
        shutil.copy(
            SAMPLES / f"{label}.off", tmp_path / label / split / f"{label}_1.off"
        )
    shown = [(shown.name, shown.label) for shown in shown_objects(tmp_path)]
    assert shown == [("chair_1", "chair"), ("table_1", "table")]
    shutil.copy(SAMPLES / "chair.off", tmp_path / "loose.off")
    shown = [(shown.name, shown.label) for shown in shown_objects(tmp_path)]
    assert shown == [("chair_1", "chair"), ("loose", None), ("table_1", "table")]
    # another format of the same model
    shutil.copy(SAMPLES / "chair.off", tmp_path / "loose.ply")
    assert len(shown_objects(tmp_path)) == 3
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError):
        shown_objects(tmp_path / "empty")
