"""Surfaces of scans and frames: rays cast at them, what is simplified, and their symmetries."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from exact_views import l_block, mesh_of
from recordings import write_captured
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nextview.captured.camera import CapturedCamera
from nextview.captured.folders import read_capture
from nextview.errors import MeshError
from nextview.geometry.mesh import make_mesh
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.things.fusion import fuse
from nextview.things.surface import Surface
from nextview.things.symmetry import find_symmetries


def test_a_surface_keeps_the_scan_frame_and_drops_invisible_parts():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    ball.apply_translation((2.0, -1.0, 0.5))
    in_millimetres = make_mesh(1000 * ball.vertices, ball.faces, unit="mm")
    surface = Surface.from_mesh(in_millimetres, "ball")
    np.testing.assert_allclose(surface.centre, (2.0, -1.0, 0.5), atol=1e-5)
    assert surface.diameter == pytest.approx(0.1, rel=1e-3)
    few = surface.simplified()
    assert len(few.faces) < len(surface.faces) / 4
    off = (
        np.linalg.norm(
            few.sample(500, np.random.default_rng(0)) - (2.0, -1.0, 0.5), axis=1
        )
        - 0.05
    )
    assert np.abs(off).max() < 0.001
    block = Surface.from_mesh(l_block(), "block")
    assert block.simplified() is block  # it has no triangle too many
    with pytest.raises(MeshError):
        Surface.from_mesh(make_mesh(ball.vertices, ball.faces), "ball")


# Symmetries


def turned_about(mesh_vertices, faces, seed, name="thing"):
    """A surface with its axes and its origin anywhere."""
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return rotation, Surface(
        name,
        (mesh_vertices @ rotation.T + (0.4, -0.2, 0.1)).astype(np.float32),
        faces.astype(np.int32),
    )


def prism(sides, radius=0.04, height=0.1):
    return trimesh.creation.cylinder(radius, height, sections=sides)


SYMMETRIC = {
    "can": (trimesh.creation.cylinder(0.03, 0.12, sections=64), [0, 2]),
    "cone": (trimesh.creation.cone(0.04, 0.1, sections=64), [0]),
    "ball": (trimesh.creation.icosphere(4, 0.04), [0, 0, 0]),
    "box": (trimesh.creation.box((0.05, 0.09, 0.16)), [2, 2, 2]),
    "square block": (trimesh.creation.box((0.08, 0.08, 0.2)), [4, 2, 2]),
    "cube": (trimesh.creation.box((0.06, 0.06, 0.06)), [4, 4, 4]),
    "prism of three": (prism(3), [3, 2]),
    "prism of five": (prism(5, 0.08), [5, 2]),
    "two arms": (
        trimesh.util.concatenate(
            [trimesh.creation.box((0.16, 0.03, 0.03)), prism(48, 0.03, 0.06)]
        ),
        [2, 2, 2],
    ),
}


@pytest.mark.parametrize(("seed", "name"), enumerate(SYMMETRIC))
def test_symmetries_are_found_about_any_axis(seed, name):
    mesh, expected = SYMMETRIC[name]
    rotation, surface = turned_about(mesh.vertices, mesh.faces, seed)
    found = find_symmetries(surface)
    orders = [one.order for one in found]
    if (
        expected[0] % 2
    ):  # several axes across an odd one are alike: one of them is enough
        orders = orders[:1] + sorted(set(orders[1:]))
    assert orders == expected
    if len(set(expected)) > 1 or expected == [0]:
        assert (
            abs(rotation[:, 2] @ found[0].axis) > 0.998
        )  # the axis of what is made here is z


# Surfaces from frames


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A block with a thin wall, 12 cm long, captured from 12 viewpoints on a table; metres."""
    mesh = mesh_of(
        ((0.12, 0.06, 0.03), (0.0, 0.0, 0.0)), ((0.004, 0.06, 0.05), (0.03, 0.0, 0.04))
    )
    folder = tmp_path_factory.mktemp("captured") / "block"
    write_captured(mesh, folder, ViewSphere((15.0, 50.0), 6), mesh.metres, table=True)
    return mesh, folder


def taken(folder, noise, rng):
    """The object of all frames of a folder, with more noise, metres."""
    camera = CapturedCamera(read_capture(folder))
    clean = camera.observe

    def observe(pose):
        frame = clean(pose)
        depth = frame.depth + (noise * rng.normal(size=frame.shape)).astype(np.float32)
        return replace(
            frame,
            depth=np.where(frame.depth > 0, depth, 0).astype(np.float32),
            pixel_centre=0.5,
        )

    camera.observe = observe
    camera.take_all(look_at_origin(0.3, 0.0))
    return camera.object


def test_a_surface_from_frames_covers_the_visible_part_of_the_thing(captured):
    mesh, folder = captured
    rng = np.random.default_rng(4)
    noise = 0.0015
    seen = taken(folder, noise, rng)
    surface = fuse(seen.sightings, seen.object_frame.radius, "block")

    # the world's origin is below the middle of the mesh
    height = -mesh.metres * mesh.vertices[:, 2].min()
    true = Surface.from_mesh(mesh, "block")
    truth = true.sample(100_000, rng) - true.centre + (0, 0, height)
    off = cKDTree(truth).query(surface.sample(2000, rng))[0]
    assert (
        off.mean() < 0.0006 + noise / 4
    )  # samples of the truth lie half a millimetre apart
    assert np.quantile(off, 0.95) < 0.0015 + noise

    above = truth[truth[:, 2] > 0.004]  # not the side that it stands on
    gaps = cKDTree(surface.sample(20_000, rng)).query(above[:2000])[0]
    assert np.quantile(gaps, 0.95) < 0.003
