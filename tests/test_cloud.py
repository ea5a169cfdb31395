"""Points of a view, against the depth image they come from, and what the map networks are given
of them.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nextview.geometry.depth import CLOUD_POINTS, visible_points
from nextview.geometry.observation import pinhole
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.recognition.network_input import cloud_input

POSES = ViewSphere.named("40").poses


def unprojected(
    depth: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """The point under every pixel, one after the other, object frame, (H, W, 3)."""
    points = np.zeros((*depth.shape, 3))
    for row, column in np.ndindex(depth.shape):
        ray = np.linalg.solve(intrinsics, [column + 0.5, row + 0.5, 1])
        points[row, column] = (pose @ [*(depth[row, column] * ray), 1])[:3]
    return points


def pixels_of(
    points: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """(row, column) in which each point appears."""
    seen = (points - pose[:3, 3]) @ pose[:3, :3] @ intrinsics.T
    return np.floor(seen[:, 1::-1] / seen[:, 2:]).astype(int)


def random_depth(height: int, width: int, share: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    depth = rng.uniform(2, 4, (height, width)).astype(np.float32)
    return np.where(rng.random(depth.shape) < share, depth, 0).astype(np.float32)


@pytest.mark.parametrize("share", [0.001, 0.01, 0.2, 1.0])
@pytest.mark.parametrize("view", [0, 21, 39])
def test_every_point_is_under_a_visible_pixel(share, view):
    depth, intrinsics = random_depth(48, 64, share), pinhole(64, 3.0)
    intrinsics[1] = [0, 70.0, 20.0]  # neither square pixels nor a central axis
    depth[7, 9] = 2.25
    points = visible_points(depth, POSES[view], intrinsics)
    assert (points.shape, points.dtype) == ((1024, 3), np.float32)
    row, column = pixels_of(points, POSES[view], intrinsics).T
    assert (depth[row, column] > 0).all()
    np.testing.assert_allclose(
        points, unprojected(depth, POSES[view], intrinsics)[row, column], atol=1e-6
    )


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 3000), st.integers(0, 5))
def test_pixels_are_drawn_without_replacement_and_repeat_evenly_when_few(visible, seed):
    depth = np.zeros(64 * 64, np.float32)
    depth[np.random.default_rng(visible).permutation(depth.size)[:visible]] = 3
    intrinsics = pinhole(64, 3.0)
    points = visible_points(depth.reshape(64, 64), POSES[10], intrinsics, seed)
    if not visible:
        assert (points == 0).all()
        return
    drawn, times = np.unique(
        pixels_of(points, POSES[10], intrinsics), axis=0, return_counts=True
    )
    assert len(drawn) == min(visible, CLOUD_POINTS)
    assert np.ptp(times) <= 1


# What the map networks are given


def test_clouds_are_scaled_by_their_own_global_extent():
    points = np.random.default_rng(0).uniform(-1, 1, (5, 100, 3)).astype(np.float32)
    # at azimuth 0 nothing is turned
    poses = look_at_origin(np.linspace(0, 1, 5), np.zeros(5))
    clouds = cloud_input(points, poses)
    assert (clouds.shape, clouds.dtype) == ((5, 100, 3), np.float32)
    for cloud, raw in zip(clouds, points, strict=True):
        assert (cloud.min(), cloud.max()) == (0, 1)
        np.testing.assert_allclose(
            cloud, np.interp(raw, [raw.min(), raw.max()], [0, 1]), atol=1e-5
        )


@settings(deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-1.4, 1.4))
def test_turning_object_and_camera_together_changes_nothing(azimuth, elevation):
    points = np.random.default_rng(0).uniform(-1, 1, (1, 200, 3))
    c, s = np.cos(azimuth), np.sin(azimuth)
    turned = points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    ahead = cloud_input(points.astype(np.float32), look_at_origin([elevation], [0.0]))
    found = cloud_input(
        turned.astype(np.float32), look_at_origin([elevation], [azimuth])
    )
    np.testing.assert_allclose(found, ahead, atol=1e-5)
