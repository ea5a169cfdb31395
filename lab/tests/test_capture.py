"""Captures that are written of a mesh, and recognised: the nearest view, the way there and back."""

import numpy as np
import pytest

import nextview
from nextview.captured.camera import CapturedCamera
from nextview.captured.folders import read_box, read_capture
from nextview.data.samples import sample_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview_lab.data.writing import write_capture

TWELVE = ViewSphere.named("12")
RADIUS = 0.55
"""Metres; the sample chair's is 0.54."""


# There and back


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """The sample chair on a table, from twelve viewpoints."""
    folder = tmp_path_factory.mktemp("captures") / "chair"
    done = list(write_capture(sample_mesh("chair"), folder, TWELVE, RADIUS, table=True))
    assert done == list(range(1, 13))
    return folder


@pytest.fixture(scope="module")
def system():
    return nextview.load(policy="spread", threshold=1.0, max_views=3, viewpoints="12")


def test_captured_from_the_viewpoints_it_is_the_same_as_looking(captured, system):
    """With the box known no pose is off, the same views are taken, and they are believed as
    those of the mesh.
    """
    camera = CapturedCamera(
        read_capture(captured), up=(0, 0, 1), box=read_box(captured / "box.json")
    )
    found = system.recognise(camera, start=4)
    looked = system.recognise(sample_mesh("chair"), start=4)
    assert max(view.degrees_off for view in found.views) < 1e-5
    assert [view.index for view in found.views] == [view.index for view in looked.views]
    assert [camera.capture.frames.index(taken.frame) for taken in camera.taken] == [
        v.index for v in looked.views
    ]
    assert found.answer == looked.answer == "chair"
    centre = camera.object.object_frame.centre
    height = -RADIUS * sample_mesh("chair").vertices[:, 2].min()
    np.testing.assert_allclose(centre, [0, 0, height], atol=1e-9)
    for view in found.views:
        np.testing.assert_allclose(
            view.observation.pose, TWELVE.poses[view.index], atol=1e-6
        )


def test_the_object_is_found_without_a_box(captured, system):
    result = system.recognise(captured, start=4)
    assert result.answer == "chair"
    assert all(view.degrees_off < 3 for view in result.views)
    assert result.views[0].observation.radius == pytest.approx(RADIUS, rel=0.1)
