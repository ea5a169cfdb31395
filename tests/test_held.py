"""Things that do not rest: in a gripper, where no plane is under them, or leaning on a table."""

import numpy as np
import pytest
from factories import (
    box,
    meshes_of,
    poses_around,
)
from scipy.spatial.transform import Rotation

import nextview
from nextview.errors import ObservationError
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.sensing import Frame, ObservedObject
from nextview.simulation.sensor import SENSORS

PLACE = np.array([0.1, 0.0, 0.35])  # of the thing, above a table
SENSOR = SENSORS["stereo"]
WRIST = ((0, 25), (60, 35), (130, 20))  # azimuth and elevation of the views, degrees


def in_a_gripper(name, seed):
    """What is seen of a thing between two fingers, in a random orientation, and its pose."""
    mesh = meshes_of([name])[name]
    metres = mesh.vertices * mesh.radius + mesh.centre
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    turned = metres @ turn.T
    middle = (turned.min(0) + turned.max(0)) / 2
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = PLACE - middle
    placed = turned + pose[:3, 3]

    _, width, _ = np.ptp(placed, axis=0) / 2
    top = placed[:, 2].max()
    fingers = [
        box((0.02, 0.012, 0.09), (PLACE[0], side * (width + 0.006), top + 0.025))
        for side in (-1, 1)
    ]
    others = [
        *fingers,
        box((0.06, 0.2, 0.05), (PLACE[0], 0, top + 0.095)),
        box((0.08, 0.08, 0.4), (PLACE[0], 0, top + 0.32)),
        box((1.5, 1.1, 0.03), (0, 0, -0.015)),
    ]
    caster = RayCaster(
        [(placed, mesh.faces), *((one.vertices, one.faces) for one in others)]
    )
    return caster, pose


def seen(caster, azimuth, elevation, rng) -> Frame:
    """A frame through the stereo sensor."""
    pose = poses_around(np.radians([azimuth]), np.radians(elevation), 0.55, PLACE)[0]
    rays = PinholeCamera.of(SENSOR.intrinsics, SENSOR.shape).rays.reshape(-1, 3)
    depth, _ = caster.cast(pose[:3, 3], rays @ pose[:3, :3].T)
    clean = np.where(np.isfinite(depth), depth, 0).reshape(SENSOR.shape)
    measured, _ = SENSOR.measure(clean.astype(np.float32), rng)
    return Frame(measured, SENSOR.intrinsics, pose, pixel_centre=0.5)


@pytest.mark.parametrize("name", ["tomato_soup_can", "power_drill", "mustard_bottle"])
def test_a_held_thing_is_named_by_a_point_on_it(name):
    caster, pose = in_a_gripper(name, 3)
    held = ObservedObject(support=False, point=PLACE)
    session = nextview.load("ycb").session(object=held, distance=0.55)
    rng = np.random.default_rng(3)
    for azimuth, elevation in WRIST:
        view = session.update(seen(caster, azimuth, elevation, rng))
        assert view.warnings == ()
        if session.done:
            break
    result = session.result
    assert result.answer == name
    assert result.confident
    # where the middle of the scan is, also of a can, of which the turn is not known
    mesh = meshes_of([name])[name]
    found, true = (
        (each @ np.append(mesh.centre, 1))[:3] for each in (result.pose, pose)
    )
    assert np.linalg.norm(found - true) < 0.01


def test_a_point_where_nothing_is_seen_is_refused():
    caster, _ = in_a_gripper("tomato_soup_can", 0)
    frame = seen(caster, 0, 25, np.random.default_rng(0))
    nothing = ObservedObject(
        support=False,
        point=PLACE,
        segmentation=lambda frame: np.zeros(frame.shape, int),
    )
    with pytest.raises(ObservationError):
        nothing.add(frame)
