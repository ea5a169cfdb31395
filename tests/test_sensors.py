"""The sensor models against closed forms, against casting rays from the projector, and through
the front door.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import box, cast, meshed, pose_at, rays

from nextview import ViewSphere
from nextview.data.samples import sample_mesh
from nextview.geometry.mesh import make_mesh
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import (
    ERRORS,
    MOST_BENT,
    SENSORS,
    WIGGLE_LENGTH,
    Sensor,
    SensorMix,
)

SPHERE, FEW = ViewSphere.named("40"), ViewSphere((20.0,), 3)
BALL = meshed(trimesh.creation.icosphere(4))


def rng(*seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def plane(
    sensor: Sensor, distance: float, tilt: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """A plane that crosses the optical axis at a distance, turned about y by degrees; depth,
    angles of incidence.
    """
    normal = np.array([np.sin(np.radians(tilt)), 0, np.cos(np.radians(tilt))])
    directions = rays(sensor.intrinsics, sensor.shape)
    along = directions @ normal
    depth = np.where(along > 0, distance * normal[2] / np.where(along > 0, along, 1), 0)
    depth[depth > 4 * distance] = 0
    return depth.astype(np.float32), np.arccos(
        np.clip(along / np.linalg.norm(directions, axis=-1), -1, 1)
    )


def nguyen(z: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Nguyen, Izadi, Lovell 2012."""
    return (
        0.0012
        + 0.0019 * (z - 0.4) ** 2
        + 0.0001 / np.sqrt(z) * angle**2 / (np.pi / 2 - angle) ** 2
    )


@pytest.mark.parametrize(
    ("distance", "tilt"), [(0.6, 0), (1.0, 30), (2.0, 0), (3.0, 60), (1.0, 75)]
)
@pytest.mark.parametrize("step", [0.0, 1 / 8])
def test_axial_noise_of_a_kinect_is_the_published_one(distance, tilt, step):
    sensor = replace(SENSORS["none"], axial=1.0, step=step)
    depth, angle = plane(sensor, distance, tilt)
    measured, _ = sensor.measure(depth, rng(1))
    some = (
        (depth > 0.5 * distance) & (depth < 1.5 * distance) & (angle < np.radians(79))
    )
    some[:2] = some[-2:] = some[:, :2] = some[:, -2:] = False
    scaled = (measured[some] - depth[some]) / nguyen(depth[some], angle[some])
    assert some.sum() > 20_000
    assert scaled.std() == pytest.approx(1, abs=0.02 if step == 0 else 0.03)
    assert abs(scaled.mean()) < 0.05


@pytest.mark.parametrize("distance", [0.4, 1.0, 3.0])
def test_stereo_noise_grows_with_the_square_of_the_distance(distance):
    sensor = replace(SENSORS["none"], disparity=0.1, focal=424.0, baseline=0.05)
    depth, _ = plane(sensor, distance)
    measured, _ = sensor.measure(depth, rng(2))
    assert (measured - depth).std() == pytest.approx(
        distance**2 * 0.1 / (424 * 0.05), rel=0.02
    )


def edge(sensor: Sensor, near: float = 0.8, far: float = 1.2) -> np.ndarray:
    """The left half is near, the right half far."""
    depth = np.full(sensor.shape, far, np.float32)
    depth[:, : sensor.width // 2] = near
    return depth


@pytest.mark.parametrize("baseline", [0.05, 0.075])
def test_shadows_are_where_rays_from_the_projector_do_not_arrive(baseline):
    sensor = replace(SENSORS["none"], shadow=baseline)
    things = [
        box((0.3, 0.06, 0.2), (0, 0, 0.2)),
        box((0.05, 0.05, 0.3), (-0.1, 0.15, 0.1)),
        box((2, 2, 0.02)),
    ]
    things.append(
        trimesh.creation.icosphere(4, 0.08).apply_translation((0.15, -0.2, 0.15))
    )
    pose = pose_at(35, 60, 1.0)
    depth, _ = cast(things, pose, sensor.intrinsics, sensor.shape)
    lost = sensor.measure(depth, rng(12))[0] == 0
    scene = trimesh.util.concatenate(things)
    points = (rays(sensor.intrinsics, sensor.shape) * depth[..., None]) @ pose[
        :3, :3
    ].T + pose[:3, 3]
    projector = pose[:3, 3] + baseline * pose[:3, 0]
    towards = projector - points.reshape(-1, 3)
    length = np.linalg.norm(towards, axis=1)
    starts = points.reshape(-1, 3) + 0.004 * towards / length[:, None]
    hidden = scene.ray.intersects_any(starts, towards / length[:, None]).reshape(
        depth.shape
    ) & (depth > 0)
    lost &= depth > 0
    assert hidden.sum() > 1000
    differ = hidden != lost
    assert (differ & hidden).sum() < 0.1 * hidden.sum()
    assert (differ & lost).sum() < 0.1 * hidden.sum()
    # They differ at borders only: nothing is left of it after one pixel is taken off all around.
    inner = (
        differ[1:-1, 1:-1]
        & differ[:-2, 1:-1]
        & differ[2:, 1:-1]
        & differ[1:-1, :-2]
        & differ[1:-1, 2:]
    )
    assert inner.sum() < 0.005 * hidden.sum()


@pytest.mark.parametrize("tilt", [0, 40])
def test_a_plane_is_not_bent(tilt):
    sensor = replace(SENSORS["none"], bent=2.5)
    depth, _ = plane(sensor, 1.0, tilt)
    measured, _ = sensor.measure(depth, rng(3))
    inner = slice(20, -20), slice(20, -20)
    np.testing.assert_allclose(measured[inner], depth[inner], rtol=1e-5)


@pytest.mark.parametrize("width", [1.5, 3.0])
@pytest.mark.parametrize("slope", [-2e-3, 2e-3])  # of the inverse depth: ridge, groove
def test_a_corner_is_averaged_under_a_gaussian(width, slope):
    sensor = replace(SENSORS["none"], bent=width)
    column = np.abs(np.arange(sensor.width) - sensor.width // 2)
    inverse = np.tile(1 + slope * np.minimum(column, 50), (sensor.height, 1))
    measured, _ = sensor.measure((1 / inverse).astype(np.float32), rng(4))
    averaged = 1 + slope * width * np.sqrt(2 / np.pi)  # mean of |x| under the window
    middle = measured[100, sensor.width // 2]
    assert 1 / middle == pytest.approx(averaged, abs=0.1 * abs(averaged - 1))


def test_corners_are_bent_by_at_most_a_share_of_the_depth():
    sensor = replace(SENSORS["none"], bent=3.0)
    depth = edge(sensor)
    measured, _ = sensor.measure(depth, rng(5))
    assert np.abs(depth / measured - 1).max() == pytest.approx(MOST_BENT, rel=1e-3)


@pytest.mark.parametrize("distance", [0.5, 0.8, 1.7])
def test_the_distance_error_of_time_of_flight_is_periodic(distance):
    sensor = replace(SENSORS["none"], wiggle=0.004)
    for at in (distance, distance + 3 * WIGGLE_LENGTH):
        depth = np.full(sensor.shape, at, np.float32)
        measured, _ = sensor.measure(depth, rng(6))
        wrong = 0.004 * np.sin(2 * np.pi * distance / WIGGLE_LENGTH)
        assert measured - depth == pytest.approx(wrong, abs=1e-6)


@pytest.mark.parametrize("name", ["kinect", "tof", "wrist"])
def test_no_strength_no_error_to_the_bit(name):
    sensor = SENSORS[name].scaled(0)
    depth, _ = plane(sensor, 1.0, 30)
    depth[200:220, 300:340] = 0
    measured, source = sensor.measure(depth, rng(14))
    np.testing.assert_array_equal(measured, depth)
    np.testing.assert_array_equal(source.ravel(), np.arange(depth.size))
    ideal = replace(
        SENSORS["none"], **{n: getattr(sensor, n) for n in ("height", "width", "focal")}
    )
    views = [
        SensedCamera(sample_mesh("chair"), s, rng(15)).observe(SPHERE.poses[20])
        for s in (sensor, ideal)
    ]
    np.testing.assert_array_equal(views[0].depth, views[1].depth)
    np.testing.assert_array_equal(views[0].pose, views[1].pose)


def test_boxes_occlude_the_object_and_are_not_segmented_as_object():
    mesh = sample_mesh("table")
    alone = SensedCamera(mesh, "none", rng(25))
    among = SensedCamera(mesh, replace(SENSORS["none"], boxes=9.0), rng(25))
    shares = []
    for pose in SPHERE.poses[::3]:
        whole, hidden = alone.frame(pose), among.frame(pose)
        kept = np.zeros_like(whole.mask) if hidden is None else hidden.mask
        assert not (kept & ~whole.mask).any()
        if hidden is not None:
            np.testing.assert_array_equal(hidden.depth[kept], whole.depth[kept])
            assert (
                hidden.depth[whole.mask & ~kept] < whole.depth[whole.mask & ~kept]
            ).all()
        shares.append(kept.sum() / whole.mask.sum())
    assert min(shares) < 0.5 < max(shares)


def test_a_mix_is_another_sensor_for_every_object():
    ball = meshed(trimesh.creation.icosphere(1))
    drawn = [SensedCamera(ball, "mix", rng(26, i)).sensor for i in range(300)]
    assert drawn == [
        SensedCamera(ball, SensorMix(), rng(26, i)).sensor for i in range(300)
    ]
    assert {sensor.name.partition(":")[0] for sensor in drawn} == {
        "render",
        "kinect",
        "stereo",
    }
    for error, chance in (("tilt", 0.5), ("crop", 0.4), ("boxes", 0.5), ("table", 0.2)):
        assert np.mean([getattr(s, error) > 0 for s in drawn]) == pytest.approx(
            chance, abs=0.1
        )
    weak = [SensorMix(0.5).draw(rng(27, i)) for i in range(50)]
    strong = [SensorMix().draw(rng(27, i)) for i in range(50)]
    for error in ERRORS:
        assert [getattr(s, error) for s in weak] == pytest.approx(
            [getattr(s, error) / 2 for s in strong]
        )


@pytest.mark.parametrize("name", ["none", "stereo", "kinect", "tof"])
@pytest.mark.parametrize("radius", [0.02, 0.08, 0.3, 1.1])
def test_a_mesh_of_known_unit_is_simulated_at_true_size(name, radius):
    ball = make_mesh(BALL.vertices * radius * 1000 + 40, BALL.faces, unit="mm")
    camera = SensedCamera(ball, name, rng(30))
    assert camera.sensor.radius == pytest.approx(radius)
    clear = radius + max(0.25, camera.sensor.nearest)
    assert camera.sensor.distance >= clear - 1e-9
    assert camera.sensor.distance <= max(0.45, clear, 3 * radius) + 1e-9

    frame = camera.frame(SPHERE.poses[13])
    border = [frame.mask[0], frame.mask[-1], frame.mask[:, 0], frame.mask[:, -1]]
    assert not any(edge.any() for edge in border)
    nearest = frame.depth[frame.mask].min()
    assert nearest == pytest.approx(
        camera.sensor.distance - radius, abs=0.03 * camera.sensor.distance
    )
    assert camera.observe(SPHERE.poses[13]).radius == pytest.approx(radius)
