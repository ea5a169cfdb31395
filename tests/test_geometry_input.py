"""The recogniser's channels against planes and a sphere in closed form."""

import numpy as np
import pytest
from factories import ball_depth, rays
from hypothesis import given, settings
from hypothesis import strategies as st

from nextview.data.samples import sample_mesh
from nextview.geometry.observation import pinhole
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.recognition.network_input import CHANNELS, geometry_input
from nextview.simulation.simulated import SimulatedCamera

SIZE = 224
DISTANCE = 3.0
INTRINSICS = pinhole(SIZE, DISTANCE)
POSES = ViewSphere.named("40").poses
RAYS = rays(INTRINSICS, (SIZE, SIZE))
STEP = 1 / 127
"""One grey level, in the channels' own scale."""


def channels_of(depth: np.ndarray, pose: np.ndarray) -> dict[str, np.ndarray]:
    """The channels in their own scale; NaN where there is background."""
    coded = geometry_input(
        depth[None].astype(np.float32), pose[None], INTRINSICS, SIZE
    )[0]
    values = np.where(coded > 0, (coded.astype(float) - 1) / 127 - 1, np.nan)
    named = dict(zip(CHANNELS, values, strict=True))
    named["facing"] = (named["facing"] + 1) / 2
    return named


def plane_depth(pose: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Depth of the plane through a point, world frame, wherever it lies in front of the camera."""
    directions = RAYS @ pose[:3, :3].T
    depth = (point - pose[:3, 3]) @ normal / (directions @ normal)
    return np.where((depth > 0) & (depth < 50), depth, 0)


def expected_channels(depth, pose, normal):
    """Closed forms where the surface and its unit normals, towards the camera, are known in the
    world frame.
    """
    directions = RAYS @ pose[:3, :3].T
    positions = pose[:3, 3] + depth[..., None] * directions
    towards = -directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return {
        "facing": (normal * towards).sum(-1),
        "up": np.broadcast_to(normal, positions.shape)[..., 2],
        "height": positions[..., 2],
        "nearness": DISTANCE - depth,
    }


def test_the_ball():
    for pose in POSES[[0, 11, 22, 39]]:
        depth = ball_depth(pose, INTRINSICS, SIZE)
        positions = pose[:3, 3] + depth[..., None] * (RAYS @ pose[:3, :3].T)
        found = channels_of(depth, pose)
        for name, expected in expected_channels(depth, pose, positions).items():
            np.testing.assert_array_equal(np.isnan(found[name]), depth == 0)
            # Towards the rim a pixel covers a steep slope.
            inner = DISTANCE**2 - (RAYS**2).sum(-1) * (DISTANCE**2 - 1) > 0.2
            # Positions are exact; a normal is taken over one pixel's width, on a curved surface.
            limit = STEP if name in ("height", "nearness") else 0.03
            np.testing.assert_allclose(
                found[name][inner], expected[inner], atol=limit, err_msg=name
            )


@settings(deadline=None, max_examples=40)
@given(
    st.floats(-1.2, 1.2),
    st.floats(-np.pi, np.pi),
    st.floats(-1, 1),
    st.floats(-1, 1),
    st.floats(-0.5, 0.5),
)
def test_a_plane_at_any_slant(elevation, azimuth, tilt, turn, offset):
    pose = look_at_origin(elevation, azimuth)
    normal = np.array(
        [np.sin(tilt), np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt)]
    )
    normal = pose[:3, :3] @ normal  # towards the camera in its frame
    depth = plane_depth(pose, -offset * normal, normal)
    expected, found = expected_channels(depth, pose, normal), channels_of(depth, pose)
    seen = depth > 0
    # The outermost pixels have one neighbour only, the others two: on a plane one is good enough.
    for name in CHANNELS:
        inside = seen & (np.abs(expected[name]) <= 1)
        if name in ("facing", "up"):
            # perspective bends depth between neighbours on steep planes
            inside &= expected["facing"] > 0.3
        limit = 0.5 * STEP + (1e-4 if name in ("height", "nearness") else 0.02)
        np.testing.assert_allclose(
            found[name][inside], expected[name][inside], atol=limit, err_msg=name
        )


def as_the_bundled_models_were_trained(depth, poses, focal, centre):
    """The formula of the bundled models' training, for square pixels: what they are given must
    not change by a bit.
    """
    rotation, origin = (
        poses[:, :3, :3].astype(np.float32),
        poses[:, :3, 3].astype(np.float32),
    )

    def slope(axis):
        back = np.where(
            np.roll(depth, 1, axis) > 0, depth - np.roll(depth, 1, axis), np.inf
        )
        forth = np.where(
            np.roll(depth, -1, axis) > 0, np.roll(depth, -1, axis) - depth, np.inf
        )
        least = np.where(np.abs(back) < np.abs(forth), back, forth)
        return np.where(np.isfinite(least), least, 0).astype(np.float32)

    focal = np.float32(focal)
    across, down = slope(2), slope(1)
    x = ((np.arange(depth.shape[2]) + 0.5 - centre) / focal).astype(np.float32)[
        None, None, :
    ]
    y = x.reshape(1, -1, 1)
    through = depth / focal + x * across + y * down
    length = np.sqrt(across**2 + down**2 + through**2) + 1e-12
    a, b, c = (rotation[:, 2, i, None, None] for i in range(3))
    facing = depth / focal / (length * np.sqrt(x**2 + y**2 + 1))
    up = (a * across + b * down + c * -through) / length
    height = a * (x * depth) + b * (y * depth) + c * depth + origin[:, 2, None, None]
    nearness = np.linalg.norm(origin, axis=1)[:, None, None] - depth
    channels = np.stack([2 * facing - 1, up, height, nearness], 1)
    return np.where(
        depth[:, None] > 0, 1 + 127 * (np.clip(channels, -1, 1) + 1) + 0.5, 0
    ).astype(np.uint8)


@pytest.mark.parametrize("name", ["chair", "monitor"])
def test_a_render_is_coded_as_the_bundled_models_know_it(name):
    poses = POSES[::3]
    camera = SimulatedCamera(sample_mesh(name), SIZE)
    depth = np.stack([camera.observe(pose).depth for pose in poses])
    depth[:, [0, -1]] = depth[:, :, [0, -1]] = (
        0  # the formula above wraps around the border
    )
    found = geometry_input(depth, poses, INTRINSICS, SIZE)
    assert (found > 0).mean() > 0.05
    np.testing.assert_array_equal(
        found,
        as_the_bundled_models_were_trained(depth, poses, INTRINSICS[0, 0], SIZE / 2),
    )
