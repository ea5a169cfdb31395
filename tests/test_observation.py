"""What an observation takes, what it refuses, and what it derives."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import meshed
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from nextview.data.samples import sample_mesh
from nextview.errors import ObservationError
from nextview.geometry.camera import pinhole
from nextview.geometry.viewsphere import ViewSphere
from nextview.sensing.observation import LEAST_PIXELS, LEAST_VISIBLE_SHARE, Observation
from nextview.simulation.simulated import SimulatedCamera

POSE = ViewSphere.named("40").poses[13]
SIZE = 64
INTRINSICS = pinhole(SIZE, 3.0)
CHAIR = SimulatedCamera(sample_mesh("chair"), SIZE)
VIEW = CHAIR.observe(POSE)


def observe(**other) -> Observation:
    return Observation(
        **({"depth": VIEW.depth, "pose": POSE, "intrinsics": INTRINSICS} | other)
    )


# Taking


@pytest.mark.parametrize("name", ["chair", "ball"])
def test_without_an_image_the_depth_is_lit_as_the_renderer_lights_the_mesh(name):
    mesh = (
        meshed(trimesh.creation.icosphere(5)) if name == "ball" else sample_mesh(name)
    )
    camera = SimulatedCamera(mesh, 224)
    for pose in ViewSphere.named("40").poses[::7]:
        view = camera.observe(pose)
        lit = replace(view, image=None).picture
        assert lit.dtype == np.uint8
        np.testing.assert_array_equal(lit > 0, view.image > 0)
        gap = np.abs(lit.astype(float) - view.image)[view.depth > 0]
        assert np.median(gap) <= 2
        assert np.mean(gap > 25) < 0.2  # edges, where the neighbours are on other faces


@pytest.mark.parametrize("size", [16, 64, 224])
def test_a_view_shows_something_from_so_many_pixels_on(size):
    least = {16: 9, 64: 25, 224: 302}[size]
    for pixels in (0, 1, least - 1, least):
        depth = np.zeros(size * size, np.float32)
        depth[:pixels] = 3
        view = Observation(depth.reshape(size, size), POSE, pinhole(size, 3.0))
        assert view.seen == (pixels == least)
    assert least - 1 < max(LEAST_PIXELS, LEAST_VISIBLE_SHARE * size**2) <= least


# Refusing


images = npst.arrays(
    st.sampled_from([np.float32, np.float64, np.uint16, np.int8]),
    npst.array_shapes(min_dims=2, max_dims=2, max_side=20),
)


@settings(deadline=None)
@given(images)
def test_any_depth_gives_an_object_or_nothing_or_an_error(depth):
    try:
        view = Observation(depth, POSE, pinhole(max(depth.shape), 3.0))
    except ObservationError:
        assert np.count_nonzero(depth >= 50) > 9
        return
    assert view.depth.dtype == np.float32
    kept = view.depth > 0
    assert (view.depth[kept] < 50).all()
    np.testing.assert_array_equal(view.depth[kept], depth[kept].astype(np.float32))
    assert np.isfinite(view.points).all()
    np.testing.assert_array_equal(view.picture > 0, kept)


def test_later_changes_of_input_arrays_do_not_affect_observations():
    depth, pose, intrinsics = np.full((9, 9), 3, np.float32), np.eye(4), pinhole(9, 3.0)
    image = np.full((9, 9), 7, np.uint8)
    seen = Observation(depth, pose, intrinsics, image=image)
    for array in (depth, pose, intrinsics, image):
        array[:] = 1
    assert (
        seen.depth[0, 0],
        seen.pose[0, 1],
        seen.intrinsics[0, 1],
        seen.image[0, 0],
    ) == (3, 0, 0, 7)
    with pytest.raises(ValueError, match="read-only"):
        seen.depth[0] = 0
