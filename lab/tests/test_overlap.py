"""Overlap of views against the geometry of a ball and against rays cast to every point."""

import numpy as np
import pytest
import trimesh
from factories import box

from nextview.errors import DatasetError
from nextview.geometry.mesh import make_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.data.store import ViewStore
from nextview_lab.thesis.overlap import overlap, overlap_maps, shared_points

SPHERE = ViewSphere.named("40")


def observation(mesh: trimesh.Trimesh):
    camera = SimulatedCamera(make_mesh(mesh.vertices, mesh.faces), 224)
    n_views = [camera.observe(pose) for pose in SPHERE.poses]
    return (
        np.stack([o.points for o in n_views]),
        np.stack([o.depth for o in n_views]),
        camera.intrinsics,
    )


def first_hit(triangles, origin, targets):
    """How far along the way to each target the first triangle stands (Moeller and Trumbore), or
    infinity.
    """
    a = triangles[:, 0]
    ab = triangles[:, 1] - triangles[:, 0]
    ac = triangles[:, 2] - triangles[:, 0]
    way = (targets - origin)[:, None]
    p = np.cross(way, ac)
    det = (p * ab).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (p * (origin - a)).sum(-1) / det
        q = np.cross(origin - a, ab)
        v = (q * way).sum(-1) / det
        t = (q * ac).sum(-1) / det
        inside = (np.minimum(u, v) >= 0) & (u + v <= 1)
    return np.where(inside, t, np.inf).min(1)


def test_a_ball_shows_what_lies_before_the_tangent_plane():
    """A point p of the unit sphere is seen from c exactly if p . c > 1."""
    points, depth, intrinsics = observation(trimesh.creation.icosphere(5))
    share = shared_points(points, depth, SPHERE.poses, intrinsics)
    true = np.stack(
        [(points @ centre > 1).mean(-1) for centre in SPHERE.poses[:, :3, 3]],
        1,
    )
    np.testing.assert_array_equal(share.diagonal(), 1)
    # the points at the rim, where it is decided by less than a pixel
    assert np.abs(share - true).max() < 0.08
    assert np.abs(share - true).mean() < 0.04
    assert true[0, 4] == share[0, 4] == 0  # from the other side


def test_a_hollow_shape_hides_its_own_parts():
    """Against the rays from the camera to each point."""
    parts = [
        box([2, 2, 0.1]),
        box([0.3, 0.3, 1], [0.6, 0.5, -0.5]),
        box([0.1, 1.5, 0.8], [-0.8, 0, 0.4]),
    ]
    shape = trimesh.util.concatenate(parts)
    points, depth, intrinsics = observation(shape)
    share = shared_points(points, depth, SPHERE.poses, intrinsics)
    mesh = make_mesh(shape.vertices, shape.faces)
    for view, other in [(0, 4), (0, 34), (9, 11), (38, 2), (20, 20)]:
        seen = (
            first_hit(
                mesh.vertices[mesh.faces],
                SPHERE.poses[other, :3, 3],
                points[view].astype(float),
            )
            > 0.999
        )
        assert share[view, other] == pytest.approx(seen.mean(), abs=0.06)


def test_maps_run_from_the_least_to_the_view_itself():
    rng = np.random.default_rng(0)
    share = rng.uniform(0.1, 0.9, (3, 40, 40)).astype(np.float32)
    share[:, np.arange(40), np.arange(40)] = 1
    maps = overlap_maps(share)
    assert (maps.min(-1) == 0).all()
    assert (maps.argmax(-1) == np.arange(40)).all()
    assert (maps.max(-1) == 1).all()
    np.testing.assert_array_equal(overlap_maps(np.zeros((2, 40, 40), np.float32)), 0)


def test_the_command_writes_arrays_and_figure(views, tmp_path):
    overlap(views, tmp_path / "all", workers=0)
    store = ViewStore.open(views)
    found = np.load(tmp_path / "all.npz")
    objects = range(len(store))
    share = np.stack(
        [
            shared_points(
                store.points(i),
                store.depth(i),
                SPHERE.poses,
                store.intrinsics,
            )
            for i in objects
        ]
    )
    np.testing.assert_allclose(found["share"], share.mean(0), rtol=1e-5)
    np.testing.assert_allclose(
        found["maps"],
        overlap_maps(share).mean(0),
        rtol=1e-5,
        atol=1e-7,
    )
    assert (tmp_path / "all.png").read_bytes().startswith(b"\x89PNG")
    overlap(views, tmp_path / "a", label="chair", workers=0)
    np.testing.assert_allclose(
        np.load(tmp_path / "a.npz")["share"],
        share[:6].mean(0),
        rtol=1e-5,
    )
    assert np.load(tmp_path / "a.npz")["objects"] == 6
    with pytest.raises(DatasetError, match="has no class 'c'; there are chair"):
        overlap(views, tmp_path / "c", label="c")
