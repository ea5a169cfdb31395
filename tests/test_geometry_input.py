"""The recogniser's channels against planes and a sphere in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nextview.cameras.simulated import SimulatedCamera
from nextview.data.samples import sample_mesh
from nextview.models.geometry_input import CHANNELS, geometry_input
from nextview.observation import Observation, pinhole
from nextview.viewsphere import ViewSphere, look_at_origin

SIZE = 224
DISTANCE = 3.0
INTRINSICS = pinhole(SIZE, DISTANCE)
POSES = ViewSphere.named("40").poses
STEP = 1 / 127
"""One grey level, in the channels' own scale."""


def rays(intrinsics: np.ndarray = INTRINSICS) -> np.ndarray:
    """Directions with z = 1 through the centres of the pixels, camera frame."""
    row, column = np.mgrid[:SIZE, :SIZE] + 0.5
    return np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(intrinsics).T


def channels_of(
    depth: np.ndarray, pose: np.ndarray, size: int = SIZE, intrinsics: np.ndarray = INTRINSICS
) -> dict[str, np.ndarray]:
    """The channels in their own scale; NaN where there is background."""
    coded = geometry_input(depth[None].astype(np.float32), pose[None], intrinsics, size)[0]
    values = np.where(coded > 0, (coded.astype(float) - 1) / 127 - 1, np.nan)
    named = dict(zip(CHANNELS, values, strict=True))
    named["facing"] = (named["facing"] + 1) / 2
    return named


def plane_depth(
    pose: np.ndarray, point: np.ndarray, normal: np.ndarray, intrinsics: np.ndarray = INTRINSICS
) -> np.ndarray:
    """Depth of the plane through a point, world frame, wherever it lies in front of the camera."""
    directions = rays(intrinsics) @ pose[:3, :3].T
    depth = (point - pose[:3, 3]) @ normal / (directions @ normal)
    return np.where((depth > 0) & (depth < 50), depth, 0)


def expected_channels(depth, pose, normal, intrinsics=INTRINSICS):
    """Closed forms where the surface and its unit normals, towards the camera, are known in the world frame."""
    directions = rays(intrinsics) @ pose[:3, :3].T
    positions = pose[:3, 3] + depth[..., None] * directions
    towards = -directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return {
        "facing": (normal * towards).sum(-1),
        "up": np.broadcast_to(normal, positions.shape)[..., 2],
        "height": positions[..., 2],
        "nearness": DISTANCE - depth,
    }


def test_the_ball():
    d = rays()
    a, c = (d**2).sum(-1), DISTANCE**2 - 1
    root = DISTANCE**2 - a * c
    depth = np.where(root > 0, (DISTANCE - np.sqrt(np.maximum(root, 0))) / a, 0)
    for pose in POSES[[0, 11, 22, 39]]:
        positions = pose[:3, 3] + depth[..., None] * (d @ pose[:3, :3].T)
        found = channels_of(depth, pose)
        for name, expected in expected_channels(depth, pose, positions).items():
            np.testing.assert_array_equal(np.isnan(found[name]), depth == 0)
            inner = root > 0.2  # towards the rim a pixel covers a steep slope
            # Positions are exact; a normal is taken over one pixel's width, on a curved surface.
            limit = STEP if name in ("height", "nearness") else 0.03
            np.testing.assert_allclose(found[name][inner], expected[inner], atol=limit, err_msg=name)


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
    normal = np.array([np.sin(tilt), np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt)])
    normal = pose[:3, :3] @ normal  # towards the camera in its frame
    depth = plane_depth(pose, -offset * normal, normal)
    expected, found = expected_channels(depth, pose, normal), channels_of(depth, pose)
    seen = depth > 0
    # The outermost pixels have one neighbour only, the others two: on a plane one is good enough.
    for name in CHANNELS:
        inside = seen & (np.abs(expected[name]) <= 1)
        if name in ("facing", "up"):
            inside &= expected["facing"] > 0.3  # perspective bends depth between neighbours on steep planes
        limit = 0.5 * STEP + (1e-4 if name in ("height", "nearness") else 0.02)
        np.testing.assert_allclose(found[name][inside], expected[name][inside], atol=limit, err_msg=name)


@pytest.mark.parametrize(("tilt", "turn"), [(0.0, 0.7), (0.7, 0.0), (-0.5, 0.6)])
@pytest.mark.parametrize("squeeze", [0.5, 0.8, 1.25, 2.0])
def test_a_camera_whose_pixels_are_not_square(tilt, turn, squeeze):
    intrinsics = INTRINSICS.copy()
    intrinsics[1] = [0, squeeze * INTRINSICS[0, 0], 100.0]
    pose = look_at_origin(0.4, 1.0)
    slant = np.array([np.sin(tilt), np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt)])
    normal = pose[:3, :3] @ slant
    depth = plane_depth(pose, np.zeros(3), normal, intrinsics)
    expected = expected_channels(depth, pose, normal, intrinsics)
    found = channels_of(depth, pose, intrinsics=intrinsics)
    for name in CHANNELS:
        inside = (depth > 0) & (np.abs(expected[name]) <= 1)
        if name in ("facing", "up"):
            inside &= expected["facing"] > 0.3
        assert inside.mean() > 0.3
        limit = 0.5 * STEP + (1e-4 if name in ("height", "nearness") else 0.02)
        np.testing.assert_allclose(found[name][inside], expected[name][inside], atol=limit, err_msg=name)


def as_the_bundled_models_were_trained(depth, poses, focal, centre):
    """The formula of the bundled models' training, for square pixels: what they are given must not change by a bit."""
    rotation, origin = poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)

    def slope(axis):
        back = np.where(np.roll(depth, 1, axis) > 0, depth - np.roll(depth, 1, axis), np.inf)
        forth = np.where(np.roll(depth, -1, axis) > 0, np.roll(depth, -1, axis) - depth, np.inf)
        least = np.where(np.abs(back) < np.abs(forth), back, forth)
        return np.where(np.isfinite(least), least, 0).astype(np.float32)

    focal = np.float32(focal)
    across, down = slope(2), slope(1)
    x = ((np.arange(depth.shape[2]) + 0.5 - centre) / focal).astype(np.float32)[None, None, :]
    y = x.reshape(1, -1, 1)
    through = depth / focal + x * across + y * down
    length = np.sqrt(across**2 + down**2 + through**2) + 1e-12
    a, b, c = (rotation[:, 2, i, None, None] for i in range(3))
    facing = depth / focal / (length * np.sqrt(x**2 + y**2 + 1))
    up = (a * across + b * down + c * -through) / length
    height = a * (x * depth) + b * (y * depth) + c * depth + origin[:, 2, None, None]
    nearness = np.linalg.norm(origin, axis=1)[:, None, None] - depth
    channels = np.stack([2 * facing - 1, up, height, nearness], 1)
    return np.where(depth[:, None] > 0, 1 + 127 * (np.clip(channels, -1, 1) + 1) + 0.5, 0).astype(np.uint8)


@pytest.mark.parametrize("name", ["chair", "monitor"])
def test_a_render_is_coded_as_the_bundled_models_know_it(name):
    poses = POSES[::3]
    camera = SimulatedCamera(sample_mesh(name), SIZE)
    depth = np.stack([camera.observe(pose).depth for pose in poses])
    depth[:, [0, -1]] = depth[:, :, [0, -1]] = 0  # the formula above wraps around the border
    found = geometry_input(depth, poses, INTRINSICS, SIZE)
    assert (found > 0).mean() > 0.05
    np.testing.assert_array_equal(found, as_the_bundled_models_were_trained(depth, poses, INTRINSICS[0, 0], SIZE / 2))


NOTHING = [np.nan, np.inf, -np.inf, -0.001, -3.0, 65535.0, 3e38]
"""What depth cameras give where they measured nothing."""


@pytest.mark.parametrize("nothing", NOTHING)
def test_what_a_sensor_gives_for_nothing_is_background(nothing):
    clean = plane_depth(POSES[13], np.zeros(3), -POSES[13][:3, 2]).astype(np.float32)
    clean[np.random.default_rng(0).random(clean.shape) < 0.2] = 0
    sensed = np.where(clean > 0, clean, np.float32(nothing))
    expected = geometry_input(clean[None], POSES[[13]], INTRINSICS, 112)
    np.testing.assert_array_equal(geometry_input(sensed[None], POSES[[13]], INTRINSICS, 112), expected)
    observation = Observation(sensed, POSES[13], INTRINSICS)
    np.testing.assert_array_equal(observation.depth, clean)
    assert observation.depth.dtype == np.float32
    assert Observation(clean, POSES[13], INTRINSICS).depth is clean  # nothing is copied


def test_a_floor_a_wall_and_a_ceiling():
    level = ViewSphere.named("40").poses[0]
    wall = channels_of(plane_depth(level, np.zeros(3), np.array([1.0, 0, 0])), level)
    middle = SIZE // 2
    assert wall["facing"][middle, middle] == pytest.approx(1, abs=STEP)
    assert wall["up"][middle, middle] == pytest.approx(0, abs=STEP)
    np.testing.assert_allclose(wall["nearness"], 0, atol=STEP)
    assert wall["height"][0, middle] > 0 > wall["height"][-1, middle]  # row 0 is the top
    above = look_at_origin(np.pi / 3, 0.0)
    floor = channels_of(plane_depth(above, np.zeros(3), np.array([0, 0, 1.0])), above)
    np.testing.assert_allclose(floor["up"], 1, atol=2 * STEP)
    np.testing.assert_allclose(floor["height"], 0, atol=STEP)
    below = look_at_origin(-np.pi / 3, 0.0)
    np.testing.assert_allclose(
        channels_of(plane_depth(below, np.zeros(3), np.array([0, 0, 1.0])), below)["up"], -1, atol=2 * STEP
    )


def test_background_is_zero_and_the_object_never_is():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.1, 8, (3, SIZE, SIZE)).astype(np.float32)  # far beyond what the channels hold
    depth[rng.random(depth.shape) < 0.5] = 0
    coded = geometry_input(depth, POSES[:3], INTRINSICS, SIZE)
    assert coded.dtype == np.uint8
    for channel in range(4):
        np.testing.assert_array_equal(coded[:, channel] > 0, depth > 0)


def test_a_lone_pixel_faces_along_the_axis():
    depth = np.zeros((SIZE, SIZE))
    depth[100, 120] = 3.0
    ray = rays()[100, 120]
    found = channels_of(depth, POSES[0])
    assert found["facing"][100, 120] == pytest.approx(1 / np.linalg.norm(ray), abs=STEP)


def test_a_step_does_not_bend_the_normals_beside_it():
    depth = np.full((SIZE, SIZE), 2.5)
    depth[:, SIZE // 2 :] = 3.5
    expected = 1 / np.linalg.norm(rays(), axis=-1)  # both halves face the camera squarely
    np.testing.assert_allclose(channels_of(depth, POSES[0])["facing"], expected, atol=STEP)


@pytest.mark.parametrize("size", [112, 56, 32])
def test_thinning_takes_every_kth_pixel(size):
    depth = plane_depth(POSES[13], np.zeros(3), POSES[13][:3, 2] * -1)
    depth[:, :40] = 0
    whole = geometry_input(depth[None].astype(np.float32), POSES[[13]], INTRINSICS, SIZE)
    thin = geometry_input(depth[None].astype(np.float32), POSES[[13]], INTRINSICS, size)
    np.testing.assert_array_equal(thin, whole[:, :, :: SIZE // size, :: SIZE // size])


def test_images_in_a_batch_do_not_mix():
    rng = np.random.default_rng(0)
    depth = rng.uniform(2, 4, (3, SIZE, SIZE)).astype(np.float32)
    together = geometry_input(depth, POSES[[3, 17, 38]], INTRINSICS, 112)
    for row, view in enumerate((3, 17, 38)):
        np.testing.assert_array_equal(together[[row]], geometry_input(depth[[row]], POSES[[view]], INTRINSICS, 112))


@pytest.mark.parametrize(("shape", "size"), [((224, 224), 100), ((224, 112), 112), ((64, 64), 224)])
def test_an_image_that_cannot_be_thinned(shape, size):
    with pytest.raises(ValueError, match="cannot be thinned"):
        geometry_input(np.zeros((1, *shape), np.float32), POSES[:1], INTRINSICS, size)
