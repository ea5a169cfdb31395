"""How much new volume and surface a view would show, against closed forms: of a ball, a wall and
empty space.
"""

import sys

import numpy as np
import pytest

from nextview.geometry.observation import pinhole
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.sensing.expected_visibility import (
    FREE,
    OBJECT,
    OCCLUDER,
    UNSEEN,
    Occupancy,
    VoxelGrid,
)
from research.new_volume import new_surface, new_volume

GRID = VoxelGrid(64)
SMALL = VoxelGrid(24)
K = pinhole(224, 3.0)
EYE = np.array([3.0, 0, 0])
SPHERE = ViewSphere.named("40")


def rays(pose, size=224, intrinsics=K):
    """Directions in the world of which the depth is 1, (size, size, 3)."""
    row, column = np.mgrid[:size, :size] + 0.5
    return (
        np.stack([column, row, np.ones_like(row)], -1)
        @ np.linalg.inv(intrinsics).T
        @ pose[:3, :3].T
    )


def ball_depth(pose, radius, centre=(0, 0, 0), size=224, intrinsics=K):
    """Depth image of a ball: the smaller root of a quadratic equation."""
    d = rays(pose, size, intrinsics)
    o = pose[:3, 3] - np.array(centre)
    a = (d * d).sum(-1)
    b = d @ o
    c = o @ o - radius**2
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0)


def wall_depth(pose, x, half):
    """Depth image of a square wall in the plane of a given x, -half to half in y and z."""
    d = rays(pose)
    o = pose[:3, 3]
    t = (x - o[0]) / d[..., 0]
    at = o + t[..., None] * d
    return np.where((t > 0) & (np.abs(at[..., 1:]) < half).all(-1), t, 0)


def crossings(points, eye, radius):
    """How far along the way from points (P, 3) to an eye the sphere is crossed, (P, 2); NaN for
    never.
    """
    d = eye - points
    a = (d * d).sum(1)
    b = (points * d).sum(1)
    c = (points * points).sum(1) - radius**2
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - a * c)
    return np.stack([(-b - root) / a, (-b + root) / a], 1)


def hidden_by_ball(points, eye, radius):
    t = crossings(points, eye, radius)
    return ((t > 0) & (t < 1)).any(1)


def after(*poses, radius=0.6, grid=GRID):
    found = Occupancy.unseen(grid)
    for pose in poses:
        found = found.seen(ball_depth(pose, radius), pose, K)
    return found


@pytest.mark.parametrize(
    ("elevation", "azimuth"),
    [(0, 0), (0, 45), (0, 90), (0, 135), (0, 180), (54, 90), (72, 225)],
)
def test_new_volume_is_the_shadow_that_the_seen_cap_does_not_hide(elevation, azimuth):
    radius = 0.6
    occupancy = after(look_at_origin(0, 0))
    eye = look_at_origin(np.radians(elevation), np.radians(azimuth))[:3, 3]
    middles = GRID.middles[:, GRID.within(1.0).ravel()].T.astype(float)
    asked = middles[hidden_by_ball(middles, EYE, radius)]
    t = crossings(asked, eye, radius)
    at = asked[:, None] + t[..., None] * (eye - asked)[:, None]
    # the cap that was seen: p . eye > radius^2
    blocked = ((t > 0) & (t < 1) & (at @ EYE > radius**2)).any(1)
    exact = (~blocked).sum() * GRID.pitch**3
    found = new_volume(occupancy, eye[None])[0]
    assert found == pytest.approx(exact, rel=0.05, abs=0.02)


@pytest.mark.parametrize("distance", [2.0, 3.0, 6.0])
def test_an_unseen_ball_appears_as_large_as_the_disc_within_its_tangents(distance):
    """From d radii the tangents touch the plane through the middle at d / sqrt(d^2 - 1)."""
    eyes = SPHERE.directions[::5] * distance
    found = new_surface(Occupancy.unseen(GRID), eyes)
    half = distance / np.sqrt(distance**2 - 1)
    assert (found > np.pi * half**2).all()  # voxels stand out by up to a half
    # and are drawn a pixel wide to each side
    assert (found < np.pi * (half + 2 * GRID.pitch) ** 2).all()


def test_what_a_wall_hides_is_new_from_behind_it():
    pose = look_at_origin(0, 0)
    occupancy = Occupancy.unseen(GRID).seen(wall_depth(pose, 0.5, 0.5), pose, K)
    eyes = SPHERE.poses[[0, 4], :3, 3]  # before the wall and behind it
    volume = new_volume(occupancy, eyes)
    surface = new_surface(occupancy, eyes)
    middles = GRID.middles.T.astype(float)
    # where the way from the eye to a voxel crosses the wall's plane
    along = (0.5 - 3) / (middles[:, 0] - 3)
    behind = (
        (middles[:, 0] < 0.5)
        & (np.abs(along[:, None] * middles[:, 1:]) < 0.5).all(1)
        & GRID.within(1.0).ravel()
    )
    assert volume[1] == pytest.approx(behind.sum() * GRID.pitch**3, rel=0.08)
    assert volume[0] < 0.05 * volume[1]
    # a voxel on the edge of the shadow stands out beside the wall
    assert surface[0] < 0.15 * surface[1]


@pytest.mark.parametrize("together", [1, 3000, 10**9])
@pytest.mark.parametrize("gain", [new_volume, new_surface])
def test_cameras_that_are_asked_together_see_what_each_sees_alone(
    gain,
    together,
    monkeypatch,
):
    """Also those that stand so near that what they see is drawn in wide pixels."""
    cells = np.random.default_rng(0).choice(
        np.array([UNSEEN] * 6 + [FREE] * 3 + [OBJECT], np.uint8),
        (12, 12, 12),
    )
    occupancy = Occupancy(VoxelGrid(12), cells)
    eyes = np.concatenate([scale * SPHERE.directions[::5] for scale in (1.3, 2, 3)])
    alone = [gain(occupancy, eye[None])[0] for eye in eyes]
    monkeypatch.setattr(sys.modules[gain.__module__], "TOGETHER", together)
    np.testing.assert_array_equal(gain(occupancy, eyes), alone)


def test_a_blocker_near_the_camera_has_no_holes():
    """A wall of voxels at a quarter of the distance: its voxels lie four pixels apart in the
    picture.
    """
    grid = VoxelGrid(64, half=2.0)
    cells = np.full((64,) * 3, FREE)
    x, y, z = (m.reshape(cells.shape) for m in grid.middles)
    cells[(np.abs(x - 1.6) < grid.pitch / 2) & (np.abs(y) < 1) & (np.abs(z) < 1)] = (
        OCCLUDER
    )
    cells[(x * x + y * y + z * z < 0.5**2)] = UNSEEN
    eyes = np.array([[2.1, 0, 0], [0, 2.5, 0]])
    found = new_volume(Occupancy(grid, cells), eyes) / grid.pitch**3
    assert found[0] == 0
    assert found[1] == (cells == UNSEEN).sum()
