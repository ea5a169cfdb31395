"""The occupancy grid against closed forms: what a ball, a wall and empty space hide from where."""

import ast
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import nextview.occupancy
from nextview.errors import ObservationError, UsageError
from nextview.observation import pinhole
from nextview.occupancy import FREE, OBJECT, OCCLUDER, UNSEEN, Occupancy, VoxelGrid, new_surface, new_volume
from nextview.occupancy import visible_share as share_of
from nextview.viewsphere import ViewSphere, look_at_origin

GRID = VoxelGrid(64)
SMALL = VoxelGrid(24)
K = pinhole(224, 3.0)
EYE = np.array([3.0, 0, 0])
SPHERE = ViewSphere.named("40")


def rays(pose, size=224, intrinsics=K):
    """Directions in the world of which the depth is 1, (size, size, 3)."""
    row, column = np.mgrid[:size, :size] + 0.5
    return np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(intrinsics).T @ pose[:3, :3].T


def ball_depth(pose, radius, centre=(0, 0, 0), size=224, intrinsics=K):
    """Depth image of a ball: the smaller root of a quadratic equation."""
    d, o = rays(pose, size, intrinsics), pose[:3, 3] - np.array(centre)
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0)


def wall_depth(pose, x, half):
    """Depth image of a square wall in the plane of a given x, -half to half in y and z."""
    d, o = rays(pose), pose[:3, 3]
    t = (x - o[0]) / d[..., 0]
    at = o + t[..., None] * d
    return np.where((t > 0) & (np.abs(at[..., 1:]) < half).all(-1), t, 0)


def crossings(points, eye, radius):
    """How far along the way from points (P, 3) to an eye the sphere is crossed, (P, 2); NaN for never."""
    d = eye - points
    a, b, c = (d * d).sum(1), (points * d).sum(1), (points * points).sum(1) - radius**2
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


# One view


def test_a_ball_leaves_unseen_what_lies_behind_its_face():
    radius, pose = 0.6, look_at_origin(0, 0)
    cells = after(pose, radius=radius).cells[GRID.ball]
    middles = GRID.middles[:, GRID.ball.ravel()].T.astype(float)
    hidden, slack = hidden_by_ball(middles, EYE, radius), GRID.pitch * np.sqrt(3) / 2
    # Exact but for voxels that the surface, or the border of the shadow, passes through.
    near = hidden_by_ball(middles, EYE, radius + slack) & ~hidden_by_ball(middles, EYE, radius - slack)
    near |= np.abs(np.linalg.norm(middles, axis=1) - radius) < slack
    assert near.mean() < 0.15
    np.testing.assert_array_equal(cells[~near] == UNSEEN, hidden[~near])
    np.testing.assert_array_equal(cells[~near] == FREE, ~hidden[~near])


def test_occupied_are_the_voxels_that_the_visible_cap_passes_through():
    radius = 0.6
    occupied = after(look_at_origin(0, 0), radius=radius).cells == OBJECT
    x, y, z = (m.reshape(occupied.shape) for m in GRID.middles)
    distance = np.sqrt(x * x + y * y + z * z)
    assert np.abs(distance - radius)[occupied].max() <= GRID.pitch * np.sqrt(3) / 2 + 1e-6
    rim = radius**2 / 3  # the tangents from the eye touch the ball there
    assert x[occupied].min() > rim - GRID.pitch
    # Where the surface passes the very middle of a voxel and is not seen at too low an angle, that voxel is found.
    through = (np.abs(distance - radius) < 0.2 * GRID.pitch) & (x > rim + 0.2)
    assert through.sum() > 100
    assert occupied[through].all()


def test_where_nothing_is_measured_may_be_free_or_not():
    pose, nothing = look_at_origin(0.3, 1), np.zeros((224, 224))
    assert (Occupancy.unseen(GRID).seen(nothing, pose, K).cells[GRID.within(0.97)] == FREE).all()
    assert (Occupancy.unseen(GRID).seen(nothing, pose, K, background_free=False).cells == UNSEEN).all()


def test_what_is_beside_the_picture_or_behind_the_camera_stays_unseen():
    wide = VoxelGrid(32, half=8.0)
    cells = Occupancy.unseen(wide).seen(np.zeros((224, 224)), look_at_origin(0, 0), K).cells
    x, y, z = (m.reshape(cells.shape) for m in wide.middles)
    reach = (3 - x) / np.sqrt(8)  # the picture's half width at the depth 3 - x
    inside = (x < 3) & (np.abs(y) < reach) & (np.abs(z) < reach)
    np.testing.assert_array_equal(cells == FREE, inside)


def test_object_and_occluder_are_kept_apart():
    pose = look_at_origin(0, 0)
    ball, wall = ball_depth(pose, 0.4), wall_depth(pose, 0.8, 0.2)
    depth = np.where(wall > 0, wall, ball)
    cells = Occupancy.unseen(GRID).seen(depth, pose, K, object_mask=(wall == 0) & (ball > 0)).cells
    x = GRID.middles[0].reshape(cells.shape)
    assert (cells == OCCLUDER).any()
    assert (cells == OBJECT).any()
    assert np.abs(x[cells == OCCLUDER] - 0.8).max() < GRID.pitch
    assert x[cells == OBJECT].max() < 0.4 + GRID.pitch


# New volume and new surface


@pytest.mark.parametrize(("elevation", "azimuth"), [(0, 0), (0, 45), (0, 90), (0, 135), (0, 180), (54, 90), (72, 225)])
def test_new_volume_is_the_shadow_that_the_seen_cap_does_not_hide(elevation, azimuth):
    radius, occupancy = 0.6, after(look_at_origin(0, 0))
    eye = look_at_origin(np.radians(elevation), np.radians(azimuth))[:3, 3]
    middles = GRID.middles[:, GRID.ball.ravel()].T.astype(float)
    asked = middles[hidden_by_ball(middles, EYE, radius)]
    t = crossings(asked, eye, radius)
    at = asked[:, None] + t[..., None] * (eye - asked)[:, None]
    blocked = ((t > 0) & (t < 1) & (at @ EYE > radius**2)).any(1)  # the cap that was seen: p . eye > radius^2
    exact = (~blocked).sum() * GRID.pitch**3
    found = new_volume(occupancy, eye[None])[0]
    assert found == pytest.approx(exact, rel=0.05, abs=0.02)


def test_a_ball_seen_from_all_sides_has_nothing_new():
    occupancy = after(*SPHERE.poses[[0, 2, 4, 6, 32, 36]], look_at_origin(-np.pi / 2 + 1e-3, 0), radius=0.6)
    before = new_volume(after(SPHERE.poses[0]), SPHERE.poses[:, :3, 3]).max()
    assert new_volume(occupancy, SPHERE.poses[:, :3, 3]).max() < 0.02 * before


def test_before_the_first_view_all_is_new_from_everywhere():
    occupancy = Occupancy.unseen(GRID)
    np.testing.assert_allclose(new_volume(occupancy, SPHERE.poses[:, :3, 3]), GRID.ball.sum() * GRID.pitch**3)
    assert GRID.ball.sum() * GRID.pitch**3 == pytest.approx(4 / 3 * np.pi, rel=0.01)


@pytest.mark.parametrize("distance", [2.0, 3.0, 6.0])
def test_an_unseen_ball_appears_as_large_as_the_disc_within_its_tangents(distance):
    """From d radii the tangents touch the plane through the middle at d / sqrt(d^2 - 1)."""
    eyes = SPHERE.directions[::5] * distance
    found = new_surface(Occupancy.unseen(GRID), eyes)
    half = distance / np.sqrt(distance**2 - 1)
    assert (found > np.pi * half**2).all()  # voxels stand out by up to a half
    assert (found < np.pi * (half + 2 * GRID.pitch) ** 2).all()  # and are drawn a pixel wide to each side


def test_what_a_wall_hides_is_new_from_behind_it():
    pose = look_at_origin(0, 0)
    occupancy = Occupancy.unseen(GRID).seen(wall_depth(pose, 0.5, 0.5), pose, K)
    eyes = SPHERE.poses[[0, 4], :3, 3]  # before the wall and behind it
    volume, surface = new_volume(occupancy, eyes), new_surface(occupancy, eyes)
    middles = GRID.middles.T.astype(float)
    along = (0.5 - 3) / (middles[:, 0] - 3)  # where the way from the eye to a voxel crosses the wall's plane
    behind = (middles[:, 0] < 0.5) & (np.abs(along[:, None] * middles[:, 1:]) < 0.5).all(1) & GRID.ball.ravel()
    assert volume[1] == pytest.approx(behind.sum() * GRID.pitch**3, rel=0.08)
    assert volume[0] < 0.05 * volume[1]
    assert surface[0] < 0.15 * surface[1]  # a voxel on the edge of the shadow stands out beside the wall


@pytest.mark.parametrize("together", [1, 3000, 10**9])
@pytest.mark.parametrize("gain", [new_volume, new_surface])
def test_cameras_that_are_asked_together_see_what_each_sees_alone(gain, together, monkeypatch):
    """Also those that stand so near that what they see is drawn in wide pixels."""
    cells = np.random.default_rng(0).choice(np.array([UNSEEN] * 6 + [FREE] * 3 + [OBJECT], np.uint8), (12, 12, 12))
    occupancy = Occupancy(VoxelGrid(12), cells)
    eyes = np.concatenate([scale * SPHERE.directions[::5] for scale in (1.3, 2, 3)])
    alone = [gain(occupancy, eye[None])[0] for eye in eyes]
    monkeypatch.setattr(sys.modules[gain.__module__], "TOGETHER", together)
    np.testing.assert_array_equal(gain(occupancy, eyes), alone)


def test_a_blocker_near_the_camera_has_no_holes():
    """A wall of voxels at a quarter of the distance: its voxels lie four pixels apart in the picture."""
    grid = VoxelGrid(64, half=2.0)
    cells = np.full((64,) * 3, FREE)
    x, y, z = (m.reshape(cells.shape) for m in grid.middles)
    cells[(np.abs(x - 1.6) < grid.pitch / 2) & (np.abs(y) < 1) & (np.abs(z) < 1)] = OCCLUDER
    cells[(x * x + y * y + z * z < 0.5**2)] = UNSEEN
    eyes = np.array([[2.1, 0, 0], [0, 2.5, 0]])
    found = new_volume(Occupancy(grid, cells), eyes) / grid.pitch**3
    assert found[0] == 0
    assert found[1] == (cells == UNSEEN).sum()


# Line of sight


@pytest.mark.parametrize("distance", [1.5, 3.0])
def test_the_visible_share_behind_a_wall_is_that_of_the_shadow(distance):
    """Points of a square board; a smaller wall before it hides a square of them, by similar triangles."""
    grid = VoxelGrid(64, half=1.0)
    cells = np.full((64,) * 3, FREE)
    x, y, z = (m.reshape(cells.shape) for m in grid.middles)
    half = 8 * grid.pitch
    cells[(np.abs(x - 0.5 - grid.pitch / 2) < 1e-3) & (np.abs(y) < half) & (np.abs(z) < half)] = OCCLUDER
    side = np.linspace(-0.6, 0.6, 31)
    board = np.array([[0.0, b, c] for b in side for c in side])
    shadow = half * distance / (distance - 0.5 - grid.pitch / 2)
    exact = 1 - (np.abs(board[:, 1:]) < shadow).all(1).mean()
    eyes = np.array([[distance, 0, 0], [-distance, 0, 0]])
    found = share_of(Occupancy(grid, cells), board, eyes)
    assert found[0] == pytest.approx(exact, abs=0.05)
    assert found[1] == 1


@pytest.mark.parametrize("density", [0.0, 0.5, 2.0, np.inf])
def test_unseen_space_lets_through_what_its_density_says(density):
    found = share_of(Occupancy.unseen(GRID), np.zeros((1, 3)), SPHERE.poses[:, :3, 3], density)
    # On the way to the cube's border: 1 over the largest coordinate of the direction.
    length = 1 / np.abs(SPHERE.directions).max(1)
    np.testing.assert_allclose(found, np.exp(-density * length), atol=2 * min(density, 1) * GRID.pitch)
    own = np.ones((64,) * 3, bool)
    np.testing.assert_array_equal(share_of(Occupancy.unseen(GRID), np.zeros((1, 3)), EYE[None], density, own), 1)


def test_what_is_behind_the_camera_hides_nothing():
    cells = np.full((64,) * 3, FREE)
    cells[40:] = OCCLUDER
    assert share_of(Occupancy(GRID, cells), np.array([[-0.5, 0, 0]]), np.array([[0.2, 0, 0]]))[0] == 1
    assert share_of(Occupancy(GRID, cells), np.array([[-0.5, 0, 0]]), np.array([[3.0, 0, 0]]))[0] == 0
    assert np.isnan(share_of(Occupancy(GRID, cells), np.zeros((0, 3)), EYE[None])).all()


# What always holds


@settings(deadline=None, max_examples=25)
@given(st.lists(st.integers(0, 39), min_size=2, max_size=4), st.permutations(range(4)))
def test_more_views_never_make_seen_space_unseen_and_their_order_counts_for_nothing(views, order):
    frames = [(ball_depth(SPHERE.poses[v], 0.5, (0.2, 0, 0.1), 32, pinhole(32, 3.0)), SPHERE.poses[v]) for v in views]

    def seen(frames):
        found = [Occupancy.unseen(SMALL)]
        for depth, pose in frames:
            found.append(found[-1].seen(depth, pose, pinhole(32, 3.0)))
        return found

    steps = seen(frames)
    for before, now in pairwise(steps):
        assert not ((before.cells != UNSEEN) & (now.cells == UNSEEN)).any()
        assert (now.cells >= before.cells).all()
    shuffled = seen([frames[i] for i in order if i < len(frames)] + frames[:1])
    np.testing.assert_array_equal(shuffled[-1].cells, steps[-1].cells)
    together = seen(frames[:1])[-1].and_also(seen(frames[1:])[-1])
    np.testing.assert_array_equal(together.cells, steps[-1].cells)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 39), st.integers(0, 3), st.tuples(*[st.floats(-5, 5)] * 3), st.sampled_from([0.25, 1.0, 10.0]))
def test_nothing_changes_if_all_moves_or_is_measured_in_another_unit(view, quarters, shift, unit):
    """The scene, the cameras and the grid turned by quarters about z, moved, and in another unit."""
    pose, centre = SPHERE.poses[view], np.array([0.15, -0.2, 0.1])
    depth = ball_depth(pose, 0.5, centre)
    here = Occupancy.unseen(SMALL).seen(depth, pose, K)
    turn = Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix()

    def moved(poses):
        found = np.array(poses)
        found[..., :3, :3] = turn @ found[..., :3, :3]
        found[..., :3, 3] = (found[..., :3, 3] @ turn.T) * unit + shift
        return found

    grid = VoxelGrid(SMALL.n, unit, tuple(shift))
    there = Occupancy.unseen(grid).seen(depth * unit, moved(pose), K)
    same = np.rot90(here.cells, quarters, (0, 1)) == there.cells
    assert same.mean() > 0.999  # a voxel whose middle lies on the edge of a pixel may fall to either side
    eyes, far = SPHERE.poses[:, :3, 3], moved(SPHERE.poses)[:, :3, 3]
    for gain, power in ((new_volume, 3), (new_surface, 2)):
        ours, theirs = gain(here, eyes), gain(there, far) / unit**power
        assert np.abs(ours - theirs).max() <= 0.1 * ours.max()  # the pixels of the z-buffer do not turn with the scene
    points = centre + 0.5 * SPHERE.directions
    elsewhere = points @ turn.T * unit + shift
    np.testing.assert_allclose(share_of(here, points, eyes), share_of(there, elsewhere, far), atol=0.05)


# What cannot be


def test_grids_and_frames_that_cannot_be():
    for bad in ({"n": 1}, {"half": 0.0}, {"half": np.inf}, {"centre": (np.nan, 0, 0)}):
        with pytest.raises(UsageError, match="voxel grid"):
            VoxelGrid(**bad)
    with pytest.raises(ObservationError, match="one shape"):
        Occupancy.unseen(SMALL).seen(np.ones((4, 4)), np.eye(4), K, np.ones((3, 4), bool))
    with pytest.raises(UsageError, match="among the voxels"):
        new_volume(Occupancy.unseen(SMALL), np.array([[0.1, 0, 0]]))


def test_the_room_imports_only_from_rooms_above_it():
    above = {"arguments", "errors", "viewsphere", "mesh", "observation", "depth", "cloud", "sensing", "occupancy"}
    for file in Path(nextview.occupancy.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("nextview"):
                assert node.module.split(".")[1] in above, (file.name, node.module)
