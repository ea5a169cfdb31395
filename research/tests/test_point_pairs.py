"""Point-pair features as a recogniser, where OpenCV's contributed modules are installed."""

import numpy as np
import pytest

pytest.importorskip("cv2").ppf_match_3d  # noqa: B018

import nextview
from nextview.geometry.mesh import make_mesh
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.surface import Surface
from research.point_pairs import PointPairs, model_cloud, scene_cloud


def block(*boxes):
    """A mesh of boxes, (low corner, high corner) each, metres."""
    import trimesh

    parts = [trimesh.creation.box(bounds=np.array(box)) for box in boxes]
    joined = trimesh.util.concatenate([part.subdivide().subdivide() for part in parts])
    return make_mesh(joined.vertices, joined.faces, "block", "m")


MESHES = {
    "corner": block(
        ((0, 0, 0), (0.12, 0.03, 0.03)),
        ((0, 0, 0.03), (0.03, 0.03, 0.09)),
    ),
    "brick": block(((0, 0, 0), (0.1, 0.06, 0.04))),
}


@pytest.fixture(scope="module")
def pairs():
    return PointPairs([Surface.from_mesh(mesh, name) for name, mesh in MESHES.items()])


@pytest.fixture(scope="module")
def seen():
    poses = nextview.ViewSphere.named("40").poses
    return {
        name: SimulatedCamera(mesh).observe(poses[12]) for name, mesh in MESHES.items()
    }


def test_points_lie_on_the_surface_and_normals_are_of_it():
    cloud = model_cloud(Surface.from_mesh(MESHES["brick"], "brick"))
    points = cloud[:, :3] - np.array([0.05, 0.03, 0.02])
    face = (np.abs(points) / np.array([0.05, 0.03, 0.02])).argmax(1)
    rows = np.arange(len(points))
    assert np.allclose(
        np.abs(points[rows, face]),
        np.array([0.05, 0.03, 0.02])[face],
        atol=1e-6,
    )
    assert np.allclose(cloud[rows, 3 + face], np.sign(points[rows, face]), atol=1e-5)


def test_normals_of_what_is_seen_point_to_the_camera(seen):
    cloud = scene_cloud(seen["brick"])
    camera = seen["brick"].pose[:3, 3] * seen["brick"].radius
    assert (((camera - cloud[:, :3]) * cloud[:, 3:]).sum(1) > 0).all()
    assert np.allclose(np.linalg.norm(cloud[:, 3:], axis=1), 1, atol=1e-5)


def test_things_are_named_and_their_pose_is_found(pairs, seen):
    for name, observation in seen.items():
        found = pairs.belief([observation])
        assert pairs.classes[found.belief.argmax()] == name
        assert found.belief.sum() == pytest.approx(1)

    mesh = MESHES["corner"]
    centre = mesh.centre.astype(float)
    pose = pairs.belief([seen["corner"]]).poses[0].pose
    assert np.linalg.norm(pose[:3, :3] @ centre + pose[:3, 3]) < 0.004
    turned = np.degrees(np.arccos(np.clip((np.trace(pose[:3, :3]) - 1) / 2, -1, 1)))
    assert turned < 5


def test_it_takes_the_place_of_the_recogniser(pairs):
    system = nextview.load(recogniser=pairs, policy="spread")
    camera = SimulatedCamera(MESHES["corner"])
    assert system.recognise(camera, start=12).answer == "corner"
