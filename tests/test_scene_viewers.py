"""Pages and recordings of a scene hold what the scene holds: things where they truly are."""

import numpy as np
import pytest
from factories import camera_over, view, without
from scipy.spatial import cKDTree

pytest.importorskip("rerun", reason="the extra 'record' is not installed")
pytest.importorskip("viser", reason="the extra 'explore' is not installed")

from rerun.chunk import RrdReader

import nextview
from nextview.errors import ResultsError
from nextview.viewers.page import serve
from nextview.viewers.scene_page import draw_scene_in_3d
from nextview.viewers.scene_recording import SceneRecorder, record_scene

NAMES = ("cracker_box", "mug", "banana")


@pytest.fixture(scope="module")
def camera(ycb_meshes):
    """Over three known things."""
    return camera_over([ycb_meshes[name] for name in NAMES])


@pytest.fixture(scope="module")
def made(ycb, camera, tmp_path_factory):
    """A scene of three frames, the banana gone from the last; and its recording, made meanwhile."""
    path = tmp_path_factory.mktemp("recorded") / "scene.rrd"
    scene = nextview.Scene(ycb)
    recorder = SceneRecorder(path)
    for degrees in (20, 60):
        scene.update(camera.frame(view(degrees)))
        recorder(scene)
    before = {thing.name: thing.number for thing in scene.objects}
    assert set(before) == set(NAMES)
    whole = camera.table
    camera.change(without(whole, "banana"))
    assert before["banana"] in scene.update(camera.frame(view(100))).gone
    camera.change(whole)
    recorder(scene)
    recorder.close()
    return scene, before, path


def rows_of(path) -> dict:
    """What a recording holds, by entity, component and frame."""
    rows = {}
    for chunk in sorted(
        RrdReader(path).stream().to_chunks(), key=lambda chunk: str(chunk.id)
    ):
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch().to_pydict()
        for row, frame in enumerate(batch["frame"]):
            for component, values in batch.items():
                if ":" in component:
                    key = (chunk.entity_path.strip("/"), component, frame)
                    rows[key] = values[row]
    return rows


def off(vertices, camera, name) -> float:
    """Mean distance of true points of a thing from some vertices, metres."""
    (thing,) = (one for one in camera.table.things if one.name == name)
    true = thing.placed @ camera.lean[:3, :3].T
    return float(cKDTree(np.asarray(vertices)).query(true)[0].mean())


def test_a_recording_has_things_and_cameras_where_they_are(made, camera):
    scene, before, path = made
    rows = rows_of(path)
    for name in ("cracker_box", "mug"):
        for frame in (1, 2, 3):
            key = (f"world/objects/{before[name]}", "Mesh3D:vertex_positions", frame)
            assert off(rows[key], camera, name) < 0.004
        beliefs = [
            rows[f"belief/{before[name]}\\ {name}", "Scalars:scalars", k]
            for k in (1, 2, 3)
        ]
        (thing,) = (one for one in scene.objects if one.name == name)
        assert beliefs[-1] == pytest.approx([thing.confidence])
    for number, frame in enumerate(scene.frames, 1):
        where = rows[f"world/cameras/{number}", "Transform3D:translation", number]
        np.testing.assert_allclose(
            np.ravel(where), frame.camera_to_world[:3, 3], atol=1e-6
        )
    assert (f"world/objects/{before['banana']}", "Clear:is_recursive", 3) in rows


def test_a_finished_scene_can_be_recorded(made, tmp_path, camera):
    scene, before, _ = made
    record_scene(scene, tmp_path / "end.rrd")
    with pytest.raises(ResultsError):
        record_scene(scene, tmp_path / "end.rrd")
    rows = rows_of(tmp_path / "end.rrd")
    key = (f"world/objects/{before['mug']}", "Mesh3D:vertex_positions", 3)
    assert off(rows[key], camera, "mug") < 0.004
    assert {
        frame for entity, _, frame in rows if entity.startswith("world/cameras/")
    } == {1, 2, 3}


def test_a_page_has_things_and_cameras_where_they_are(made, camera):
    scene, before, _ = made
    server = serve("127.0.0.1", 0)
    try:
        draw_scene_in_3d(server, scene)
        for name in ("cracker_box", "mug"):
            handle = server.scene.get_handle_by_name(f"/objects/{before[name]}")
            assert off(handle.vertices, camera, name) < 0.004
        for number, frame in enumerate(scene.frames, 1):
            handle = server.scene.get_handle_by_name(f"/cameras/{number}")
            np.testing.assert_allclose(
                handle.position, frame.camera_to_world[:3, 3], atol=1e-6
            )
        assert server.scene.get_handle_by_name(f"/objects/{before['banana']}") is None
    finally:
        server.stop()
