"""Frames from a turntable: the axis against the true one, what does not fit is noticed, and a
thing is taught.
"""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from factories import write_off
from PIL import Image

import nextview
from nextview.captured.turntable import read_turntable
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import look_at_origin
from nextview.teaching.learn import learn

RADIUS, N, SHAPE = 0.3, 12, (240, 320)
# first pixel's corner at 0
K = np.array([[262.5, 0, 160], [0, 262.5, 120], [0, 0, 1]])
FLAT = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
GROUND = (3 * RADIUS * FLAT, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
POSE = look_at_origin(np.radians(35), np.radians(20), 4.2 * RADIUS)
POSE[2, 3] += 0.4 * RADIUS


def write_frames(folder, angles, coarser=1):
    """Frames of the sample chair, which stands beside the axis, the world's z, and turns by some
    angles; of fewer pixels where that is enough.
    """
    folder.mkdir(parents=True)
    shape = SHAPE[0] // coarser, SHAPE[1] // coarser
    k = K / [[coarser], [coarser], [1]]
    half_a_pixel = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    np.savetxt(folder / "camera-intrinsics.txt", k - half_a_pixel)
    mesh = sample_mesh("chair")
    vertices = RADIUS * (
        mesh.vertices + np.array([0.2, -0.1, -mesh.vertices[:, 2].min()])
    )
    rays = PinholeCamera.of(k, shape).rays.reshape(-1, 3) @ POSE[:3, :3].T
    for i, angle in enumerate(angles):
        c, s = np.cos(angle), np.sin(angle)
        turned = vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
        depth, which = RayCaster([(turned, mesh.faces), GROUND]).cast(POSE[:3, 3], rays)
        millimetres = (
            np.rint(1000 * np.where(which < 0, 0, depth))
            .astype(np.uint16)
            .reshape(shape)
        )
        Image.fromarray(millimetres).save(folder / f"{i:02d}.png")
    return folder


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return write_frames(
        tmp_path_factory.mktemp("turntable") / "chair", 2 * np.pi * np.arange(N) / N
    )


def test_the_poses_are_those_of_the_camera_around_the_axis(frames):
    capture = read_turntable(frames, "ccw")
    assert len(capture.frames) == N
    first = capture.frames[0].pose
    for i, frame in enumerate(capture.frames):
        # In the camera's frame the axis is where it is, whatever the world's x is.
        foot, true = (-pose[:3, :3].T @ pose[:3, 3] for pose in (frame.pose, POSE))
        assert np.linalg.norm(foot - true) < 0.03 * RADIUS
        np.testing.assert_allclose(frame.pose[2, :3], POSE[2, :3], atol=0.01)
        c, s = np.cos(2 * np.pi * i / N), np.sin(2 * np.pi * i / N)
        np.testing.assert_allclose(
            first[:3, :3],
            [[c, -s, 0], [s, c, 0], [0, 0, 1]] @ frame.pose[:3, :3],
            atol=1e-9,
        )


def test_a_wrong_or_uneven_rotation_is_reported(tmp_path):
    right = write_frames(tmp_path / "right", 2 * np.pi * np.arange(N) / N, 2)
    with pytest.raises(DatasetError):
        read_turntable(right, "cw")
    half = write_frames(tmp_path / "half", np.pi * np.arange(N) / N, 2)
    with pytest.raises(DatasetError):
        read_turntable(half, "ccw")
    steps = np.random.default_rng(0).uniform(0.3, 1.7, N)
    with pytest.raises(DatasetError):
        read_turntable(
            write_frames(
                tmp_path / "uneven", 2 * np.pi * np.cumsum(steps) / steps.sum(), 2
            ),
            "ccw",
        )


def test_a_thing_from_a_turntable_is_recognised_by_its_mesh(frames, tmp_path):
    shutil.copytree(frames, tmp_path / "things/chair")
    with pytest.raises(DatasetError):
        learn(tmp_path / "things", tmp_path / "mine", workers=0)
    for name in ("chair", "table"):
        mesh = sample_mesh(name)
        metric = replace(mesh, vertices=RADIUS * mesh.vertices)
        write_off(tmp_path / f"{name}.off", metric)
    shutil.copy(tmp_path / "table.off", tmp_path / "things")
    found = learn(
        tmp_path / "things",
        tmp_path / "mine",
        unit="m",
        upright=True,
        turntable="ccw",
        workers=0,
    )
    assert (found.things, found.left_out) == (2, ())
    system = nextview.load(models=tmp_path / "mine", unknown=0)
    for name in ("chair", "table"):
        assert (
            system.recognise(
                tmp_path / f"{name}.off", unit="m", start=30, sensor="wrist", seed=1
            ).answer
            == name
        )
