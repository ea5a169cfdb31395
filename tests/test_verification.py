"""Things of known geometry: their alignment, and what each kind of pixel does to the likelihood."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from recordings import write_captured
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nextview.captured.camera import CapturedCamera
from nextview.captured.folders import read_capture
from nextview.errors import MeshError, ModelError, ObservationError
from nextview.geometry.mesh import Mesh, load_mesh, make_mesh
from nextview.geometry.observation import Observation, SceneView
from nextview.geometry.ray_caster import embree_scene
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import ViewSphere, look_at_origin, rotation_z
from nextview.recognition.model_card import Symmetry
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.depth_view import (
    ELSEWHERE,
    NOT_MEASURED,
    THING,
    MetricImage,
    depth_view,
)
from nextview.things.fusion import fuse
from nextview.things.ground import levelling
from nextview.things.memory import TaughtRecogniser
from nextview.things.registration import (
    COARSE_LEVELS,
    FINE,
    FIRST,
    align,
    inverses,
    render,
    start,
)
from nextview.things.surface import Surface, SurfaceCaster
from nextview.things.symmetry import find_near_symmetries, find_symmetries
from nextview.things.taught import TaughtThings
from nextview.things.unknown import KnownResiduals
from nextview.things.verification import likelihood
from nextview.things.verifier import Verified, Verifier, rival_turns
from nextview.things.view_templates import SeenOutline
from nextview.things.weighing import (
    VIEW_CORRELATIONS,
    EvidenceWeights,
    JudgedEpisode,
    fit_weights,
)

SIDE = 40
VIEWS = ((25.0, 20.0), (50.0, 140.0), (35.0, 260.0))  # elevation and azimuth, degrees


def mesh_of(*boxes, origin=(0.0, 0.0, 0.0)) -> Mesh:
    """A mesh of boxes, each by its extents and its middle, metres, and where its origin lies."""
    parts = [trimesh.creation.box(extents) for extents, _ in boxes]
    for part, (_, middle) in zip(parts, boxes, strict=True):
        part.apply_translation(np.add(middle, origin))
    whole = trimesh.util.concatenate(parts)
    return make_mesh(whole.vertices, whole.faces, unit="m")


def l_block() -> Mesh:
    """Two arms of different length, 4 cm high; the scan's origin is 30 cm off."""
    long_arm = ((0.16, 0.04, 0.04), (0.0, 0.0, 0.0))
    short_arm = ((0.04, 0.08, 0.04), (-0.06, 0.06, 0.0))
    return mesh_of(long_arm, short_arm, origin=(0.3, -0.1, 0.2))


def cup(handle: bool) -> Mesh:
    body = ((0.08, 0.08, 0.1), (0.0, 0.0, 0.0))
    grip = ((0.05, 0.015, 0.06), (0.06, 0.0, 0.0))
    return mesh_of(body, grip) if handle else mesh_of(body)


def views_of(mesh: Mesh, yaw: float = 0.0, directions=VIEWS) -> list[Observation]:
    """Exact views of a mesh turned about the vertical."""
    camera = SimulatedCamera(rotated(mesh, rotation_z(yaw)))
    return [
        camera.observe(look_at_origin(np.radians(up), np.radians(around)))
        for up, around in directions
    ]


def true_pose(mesh: Mesh, yaw: float) -> np.ndarray:
    """The scan file's frame in the object frame, metres, of what ``views_of`` shows."""
    turn = rotation_z(yaw)
    shown = rotated(mesh, turn)
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = -(turn @ mesh.centre + shown.centre)
    return pose


def displaced(observation: Observation, by) -> Observation:
    """The same view, of which the camera is believed to stand elsewhere by some metres."""
    pose = observation.pose.copy()
    pose[:3, 3] += np.asarray(by) / observation.radius
    return replace(observation, pose=pose)


def with_scene(observation: Observation, depth, target) -> Observation:
    """The same view with all that the camera saw, depth in object radii."""
    scene = SceneView(
        depth.astype(np.float32),
        target,
        observation.pose,
        observation.intrinsics,
    )
    return replace(observation, scene=scene)


def on_a_wall(observation: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the view with a wall behind the thing, and the thing's pixels."""
    target = observation.depth > 0
    return np.where(target, observation.depth, 5.0), target


def off_by(found: np.ndarray, true: np.ndarray, at: np.ndarray) -> tuple[float, float]:
    """Degrees and millimetres between two poses, at a point of the scan."""
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).magnitude()
    moved = (found - true) @ np.append(at, 1)
    return float(np.degrees(turn)), float(1000 * np.linalg.norm(moved[:3]))


def aligned(
    mesh: Mesh,
    observations,
    yaws,
    camera: str = "",
) -> tuple[SurfaceCaster, np.ndarray, np.ndarray]:
    """Poses found from some azimuths, and how likely the views are with each."""
    caster = SurfaceCaster([Surface.from_mesh(mesh, "thing")])
    coarse = [replace(depth_view(each, 24), camera=camera) for each in observations]
    fine = [replace(depth_view(each, SIDE), camera=camera) for each in observations]
    seen = np.mean([np.median(view.thing_points, axis=0) for view in coarse], axis=0)
    found = start(
        np.zeros(len(yaws), int),
        rotation_z(yaws),
        np.tile(seen, (len(yaws), 1)),
        len(observations),
    )
    found = align(
        caster,
        found,
        coarse,
        (*FIRST, *COARSE_LEVELS),
    )
    found = align(caster, found, fine, FINE)
    judged = [
        likelihood(view, render(caster, found, view, k)).mean
        for k, view in enumerate(fine)
    ]
    return found, found.poses(caster), np.sum(judged, 0)


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("yaw", [0.3, 2.0, -1.2])
def test_a_known_pose_is_found_to_a_millimetre_and_a_degree(yaw, views):
    mesh = l_block()
    observations = views_of(mesh, yaw)[:views]
    yaws = np.arange(8) * np.pi / 4
    _, poses, likely = aligned(mesh, observations, yaws)
    turn, moved = off_by(poses[likely.argmax()], true_pose(mesh, yaw), mesh.centre)
    assert turn < 1
    assert moved < 1


def test_a_tilt_of_the_vertical_is_found_too():
    mesh = l_block()
    lean = Rotation.from_rotvec([0.03, -0.02, 0.4]).as_matrix()
    shown = rotated(mesh, lean)
    camera = SimulatedCamera(shown)
    observations = [
        camera.observe(look_at_origin(np.radians(up), np.radians(around)))
        for up, around in VIEWS
    ]
    _, poses, _ = aligned(mesh, observations, np.array([0.35]))
    true = np.eye(4)
    true[:3, :3] = lean
    true[:3, 3] = -(lean @ mesh.centre + shown.centre)
    turn, moved = off_by(poses[0], true, mesh.centre)
    assert turn < 0.5
    assert moved < 1


def test_a_centre_that_is_a_quarter_radius_off_is_made_up_for():
    mesh = l_block()
    off = 0.25 * mesh.metres * np.array([0.6, -0.7, 0.3])
    observations = [displaced(each, off) for each in views_of(mesh, 0.5)]
    _, poses, likely = aligned(mesh, observations, np.arange(8) * np.pi / 4)
    true = true_pose(mesh, 0.5)
    true[:3, 3] += off
    turn, moved = off_by(poses[likely.argmax()], true, mesh.centre)
    assert turn < 1
    assert moved < 1


def test_camera_position_errors_are_separated_from_the_object_pose():
    mesh = l_block()
    errors = 0.001 * np.array([[4.0, -2.0, 1.0], [-3.0, 3.0, 2.0], [-1.0, -1.0, -3.0]])
    exact = views_of(mesh, 0.5)
    moved = [displaced(each, error) for each, error in zip(exact, errors, strict=True)]
    found, poses, likely = aligned(mesh, moved, np.array([0.4]))
    np.testing.assert_allclose(found.cameras[0], errors, atol=0.0015)
    assert off_by(poses[0], true_pose(mesh, 0.5), mesh.centre)[1] < 1.5
    _, _, best = aligned(mesh, exact, np.array([0.4]))
    assert likely[0] > best[0] - 0.3


@pytest.mark.parametrize("frames", [1, 4])
def test_frames_of_a_standing_camera_share_its_error(frames):
    """However many it takes, the thing is in the middle of what two cameras say."""
    mesh = l_block()
    one, other, _ = views_of(mesh, 0.5)
    error = np.array([0.004, -0.003, 0.002])
    views = [displaced(one, error)] * frames + [other]
    found, poses, _ = aligned(mesh, views, np.array([0.4]), "fixed")
    true = true_pose(mesh, 0.5)
    true[:3, 3] += error / 2
    assert off_by(poses[0], true, mesh.centre)[1] < 0.7
    np.testing.assert_array_equal(
        found.cameras[0, :frames], np.tile(found.cameras[0, 0], (frames, 1))
    )
    np.testing.assert_allclose(found.cameras[0, 0], error / 2, atol=0.0007)


def test_a_missing_handle_lowers_the_likelihood():
    caster = SurfaceCaster(
        [Surface.from_mesh(cup(handle), str(handle)) for handle in (True, False)]
    )
    for handle in (True, False):
        observation = views_of(cup(handle), directions=((30.0, 60.0),))[0]
        view = depth_view(observation, SIDE)
        found = start(
            np.array([0, 1]), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), 1
        )
        found = align(
            caster,
            found,
            [view],
            (*FIRST, *COARSE_LEVELS, *FINE),
        )
        with_it, without = likelihood(view, render(caster, found, view, 0)).mean
        assert (with_it > without + 0.1) == handle


@pytest.mark.parametrize("times", [0.2, 8.0])  # a die, and a cupboard
def test_small_and_large_things_are_aligned_as_well(times):
    mesh = l_block()
    scaled = make_mesh(
        times * (mesh.vertices * mesh.radius + mesh.centre),
        mesh.faces,
        unit="m",
    )
    _, poses, likely = aligned(
        scaled,
        views_of(scaled, 2.0)[:2],
        np.arange(8) * np.pi / 4,
    )
    turn, moved = off_by(poses[likely.argmax()], true_pose(scaled, 2.0), scaled.centre)
    assert turn < 1
    assert moved < max(1, times)


def standing_view(mesh: Mesh, lean: np.ndarray, noise: float = 0.0) -> Observation:
    """A view of a turned thing on a table that leans as it does; noise as inverse depth, 1/m."""
    shown = rotated(mesh, lean)
    observation = SimulatedCamera(shown).observe(look_at_origin(np.radians(35.0), 0.4))
    rows, columns = np.indices(observation.depth.shape)
    k = observation.intrinsics
    x, y = (columns + 0.5 - k[0, 2]) / k[0, 0], (rows + 0.5 - k[1, 2]) / k[1, 1]
    rays = np.stack([x, y, np.ones(x.shape)], -1) @ observation.pose[:3, :3].T
    bottom = mesh.vertices[:, 2].min() - shown.centre @ lean[:, 2] / shown.radius
    up = lean[:, 2]
    table = (bottom - observation.pose[:3, 3] @ up) / (rays @ up)
    target = observation.depth > 0
    depth = np.where(target, observation.depth, table)
    q = 1 / depth + noise * observation.radius * np.random.default_rng(0).normal(
        size=depth.shape
    )
    return with_scene(observation, 1 / q, target)


def test_the_ground_determines_the_vertical_and_the_noise():
    lean = Rotation.from_rotvec([0.05, -0.04, 0.0]).as_matrix()
    image = MetricImage.of(standing_view(l_block(), lean, noise=0.01))
    assert image.ground is not None
    np.testing.assert_allclose(image.ground.normal, lean[:, 2], atol=0.003)
    assert image.ground.noise == pytest.approx(0.01, rel=0.15)
    level = image.turned(levelling([image.ground]))
    np.testing.assert_allclose(level.ground.normal, (0, 0, 1), atol=1e-9)
    exact = views_of(l_block())[0]
    assert MetricImage.of(exact).ground is None
    np.testing.assert_allclose(levelling([]), np.eye(3))


def test_a_thing_is_found_upright_on_a_table_that_leans():
    mesh = mesh_of(((0.1, 0.08, 0.1), (0, 0, 0)), ((0.05, 0.02, 0.04), (0.07, 0, 0.02)))
    lean = Rotation.from_rotvec([0.06, -0.05, 0.0]).as_matrix() @ rotation_z(0.7)
    observation = standing_view(mesh, lean, noise=0.003)
    found = verifier_of(mesh, l_block())([observation])
    true = np.eye(4)
    true[:3, :3] = lean
    true[:3, 3] = -(lean @ mesh.centre + rotated(mesh, lean).centre)
    turn, moved = off_by(found.poses[0], true, mesh.centre)
    assert found.things[0] == 0
    assert turn < 1
    assert moved < 1.5


def behind_a_box(mesh: Mesh, box: Mesh) -> Observation:
    """A view of a thing on a table, behind a box; both in the same coordinates."""
    observation = SimulatedCamera(mesh).observe(look_at_origin(np.radians(35.0), 0.0))
    rows, columns = np.indices(observation.depth.shape)
    k = observation.intrinsics
    x, y = (columns + 0.5 - k[0, 2]) / k[0, 0], (rows + 0.5 - k[1, 2]) / k[1, 1]
    rays = np.stack([x, y, np.ones(x.shape)], -1) @ observation.pose[:3, :3].T
    rays = np.ascontiguousarray(rays.reshape(-1, 3), np.float32)
    bottom = mesh.vertices[:, 2].min()
    square = np.array(
        [[-9, -9, bottom], [9, -9, bottom], [9, 9, bottom], [-9, 9, bottom]]
    )
    obstacle = (box.vertices * box.radius + box.centre - mesh.centre) / mesh.radius
    scene = embree_scene(
        [
            (mesh.vertices, mesh.faces),
            (obstacle, box.faces),
            (square, np.array([[0, 1, 2], [0, 2, 3]])),
        ]
    )
    start_of = np.tile(observation.pose[:3, 3].astype(np.float32), (len(rays), 1))
    hits = scene.run(start_of, rays, output=1)
    depth = hits["tfar"].reshape(x.shape)
    depth += 0.002 * np.random.default_rng(0).normal(size=depth.shape)
    return with_scene(observation, depth, hits["geomID"].reshape(x.shape) == 0)


def test_the_top_of_a_box_before_a_thing_is_not_its_floor():
    """Its hidden part extends below the top, where the camera sees the table beside the box."""
    thing = mesh_of(((0.08, 0.06, 0.12), (0, 0, 0.06)))
    box = mesh_of(((0.06, 0.16, 0.05), (0.09, 0, 0.025)))
    image = MetricImage.of(behind_a_box(thing, box))
    assert image.ground.height == pytest.approx(0.05 - 0.06, abs=0.002)
    assert image.floor.height == pytest.approx(-0.06, abs=0.002)
    assert SeenOutline.of(image).hidden
    other = mesh_of(((0.08, 0.06, 0.07), (0, 0, 0)))
    found = verifier_of(thing, other)([behind_a_box(thing, box)])
    assert found.things[0] == 0
    assert found.below[0] == 0


def test_poses_do_not_extend_below_the_ground():
    # Seen from the front, a higher block would hide its lower part below the table.
    low = mesh_of(((0.08, 0.06, 0.04), (0, 0, 0)))
    high = mesh_of(((0.08, 0.06, 0.09), (0, 0, 0)))
    observation = standing_view(low, np.eye(3), noise=0.002)
    caster = SurfaceCaster([Surface.from_mesh(mesh, "block") for mesh in (low, high)])
    placed = start(np.array([0, 1]), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), 1)
    lowered = replace(placed, centres=np.array([[0, 0, 0], [0, 0, -0.025]]))
    view = depth_view(observation, SIDE)
    fits, sunk = likelihood(view, render(caster, lowered, view, 0)).mean
    assert fits > -0.3
    assert sunk < fits - 0.5
    unaware = replace(view, ground=None, floor=None)
    assert likelihood(unaware, render(caster, lowered, unaware, 0)).mean[1] > fits - 0.3


def test_a_pose_that_is_hardly_determined_has_no_negative_variance():
    """Matrices of full rank are inverted as usual; next to singular ones are merely uncertain."""
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(20, 6, 6))
    full = factors @ factors.swapaxes(1, 2) + np.eye(6)
    np.testing.assert_allclose(
        inverses(full),
        np.linalg.inv(full),
        rtol=1e-9,
        atol=1e-12,
    )

    turns, _ = np.linalg.qr(factors)
    # the last ones by rounding
    strengths = np.array([1e12, 1e11, 1e9, 1e4, 1e-7, -1e-5])
    singular = (turns * strengths) @ turns.swapaxes(1, 2)
    assert (np.linalg.eigvalsh(inverses(singular)) > 0).all()
    assert (np.trace(inverses(singular), axis1=1, axis2=2) > 1e-6).all()


def test_thin_parts_get_more_pixels():
    rod = mesh_of(((0.2, 0.01, 0.01), (0, 0, 0)))
    slanted, ball = views_of(rod, 0.7)[0], views_of(l_block(), 0.3)[0]
    thin, thick = depth_view(slanted, 16), depth_view(ball, 16)
    assert thin.shape[0] > thick.shape[0]
    assert (thin.kind == THING).sum() > 40


@pytest.fixture
def block_view():
    """An exact view of the block, and its surface in the right pose."""
    mesh = l_block()
    observation = views_of(mesh, directions=VIEWS[:1])[0]
    caster = SurfaceCaster([Surface.from_mesh(mesh, "block")])
    return (
        observation,
        caster,
        start(np.zeros(1, int), np.eye(3)[None], np.zeros((1, 3)), 1),
    )


def mean_likelihood(observation, caster, placed) -> float:
    view = depth_view(observation, SIDE)
    return float(likelihood(view, render(caster, placed, view, 0)).mean[0])


@pytest.mark.parametrize(
    ("distance", "lowers"),
    [(1.0, False), (5.0, True), (0.0, False)],
    ids=[
        "something stands before it",
        "the wall shows through it",
        "nothing is measured there",
    ],
)
def test_what_shows_in_the_place_of_a_part(block_view, distance, lowers):
    observation, caster, placed = block_view
    depth, target = on_a_wall(observation)
    whole = mean_likelihood(with_scene(observation, depth, target), caster, placed)
    columns = np.flatnonzero(target.any(0))
    part = target & (np.arange(target.shape[1]) > np.quantile(columns, 0.6))
    changed = with_scene(observation, np.where(part, distance, depth), target & ~part)
    after = mean_likelihood(changed, caster, placed)
    assert whole > -0.15
    assert after < whole - 0.5 if lowers else after > whole - 0.35


def test_surface_that_no_hypothesis_explains_lowers_the_likelihood(block_view):
    observation, caster, placed = block_view
    depth, target = on_a_wall(observation)
    whole = mean_likelihood(with_scene(observation, depth, target), caster, placed)
    rows, columns = np.nonzero(target)
    more = target.copy()
    more[rows.min() - 12 : rows.min() + 8, int(np.median(columns)) :] = True
    grown = with_scene(observation, np.where(more & ~target, 2.9, depth), more)
    assert mean_likelihood(grown, caster, placed) < whole - 0.3


def test_kinds_of_pixels():
    observation = views_of(l_block(), directions=VIEWS[:1])[0]
    depth, target = on_a_wall(observation)
    depth[:, : depth.shape[1] // 2] = np.where(target, depth, 0)[
        :,
        : depth.shape[1] // 2,
    ]
    view = depth_view(with_scene(observation, depth, target), SIDE)
    assert set(view.kind.tolist()) == {NOT_MEASURED, ELSEWHERE, THING}
    assert len(view.kind) == np.prod(view.shape)
    assert (view.edge[view.kind == THING] < 0).all()
    assert (view.edge[view.kind != THING] > 0).all()
    reach = np.linalg.norm(view.thing_points, axis=1).max()
    assert reach == pytest.approx(
        observation.radius,
        rel=0.1,
    )  # metres, about the centre
    nothing = replace(observation, depth=np.zeros_like(observation.depth))
    assert depth_view(nothing, SIDE) is None
    with pytest.raises(
        ObservationError,
        match="the object radius in metres is not known",
    ):
        depth_view(replace(observation, radius=None), SIDE)


def test_rays_cast_at_many_surfaces_are_those_cast_at_each_alone():
    rng = np.random.default_rng(0)
    meshes = [
        l_block(),
        cup(True),
        mesh_of(((0.5, 0.3, 0.2), (1.0, 2.0, 3.0))),
        cup(False),
    ]
    surfaces = [Surface.from_mesh(mesh, str(k)) for k, mesh in enumerate(meshes)]
    things = rng.integers(len(surfaces), size=12)
    directions = rng.normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centres = np.stack([surfaces[k].centre for k in things])
    origins = (centres + 0.8 * directions).astype(np.float32)
    rays = (
        (centres + rng.normal(0, 0.04, (200, 12, 3)) - origins)
        .swapaxes(0, 1)
        .astype(np.float32)
    )

    depth, normals = SurfaceCaster(surfaces).cast(things, origins, rays)
    for row, thing in enumerate(things):
        alone = embree_scene([(surfaces[thing].vertices, surfaces[thing].faces)])
        hits = alone.run(
            np.tile(origins[row], (200, 1)),
            np.ascontiguousarray(rays[row]),
            output=1,
        )
        met = hits["primID"] >= 0
        # rays along an edge may go either way
        assert np.mean(met != np.isfinite(depth[row])) < 0.02
        both = met & np.isfinite(depth[row])
        assert both.sum() > 20
        np.testing.assert_allclose(depth[row, both], hits["tfar"][both], atol=1e-4)
        assert (np.einsum("pi,pi->p", normals[row, both], rays[row, both]) < 0).all()
        np.testing.assert_allclose(
            np.linalg.norm(normals[row, both], axis=1),
            1,
            atol=1e-4,
        )


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
            few.sample(500, np.random.default_rng(0)) - (2.0, -1.0, 0.5),
            axis=1,
        )
        - 0.05
    )
    assert np.abs(off).max() < 0.001
    block = Surface.from_mesh(l_block(), "block")
    assert block.simplified() is block  # it has no triangle too many
    with pytest.raises(MeshError, match="unit of length is not known"):
        Surface.from_mesh(make_mesh(ball.vertices, ball.faces), "ball")


@pytest.mark.parametrize(
    ("body", "part"),
    [
        (
            trimesh.creation.icosphere(subdivisions=5, radius=0.04),
            trimesh.creation.box((0.02, 0.012, 0.012)),
        ),
        (
            trimesh.creation.box((0.1, 0.07, 0.08)),
            trimesh.creation.icosphere(subdivisions=5, radius=0.01),
        ),
    ],
    ids=["few triangles on a fine body", "a fine knob on a body of few triangles"],
)
def test_a_small_part_is_not_simplified_away_and_does_not_spoil_the_rest(body, part):
    part = part.copy()
    part.apply_translation((0.5 * body.extents[0], 0.0, 0.0))
    whole = trimesh.util.concatenate([body, part])
    mesh = make_mesh(whole.vertices, whole.faces, unit="m")
    few = Surface.from_mesh(mesh, "thing").simplified()
    assert len(few.faces) < len(mesh.faces)

    camera = SimulatedCamera(mesh)
    simple = SimulatedCamera(make_mesh(few.vertices, few.faces, unit="m"))
    for around in (0.0, 60.0, 180.0):
        pose = look_at_origin(np.radians(20.0), np.radians(around))
        exact = camera.observe(pose).depth
        off = np.abs(simple.observe(pose).depth - exact) * mesh.metres
        assert np.mean(off[exact > 0] > 0.003) < 0.01


def verifier_of(*meshes: Mesh) -> Verifier:
    surfaces = [Surface.from_mesh(mesh, str(k)) for k, mesh in enumerate(meshes)]
    return Verifier(surfaces)


@pytest.mark.parametrize("shown", [0, 1, 2])
def test_a_thing_is_named_by_its_geometry_alone(shown):
    meshes = [l_block(), cup(True), cup(False)]
    verifier = verifier_of(*meshes)
    found = verifier(views_of(meshes[shown], 0.8)[:2])
    assert found.belief.argmax() == shown
    assert found.belief[shown] > 0.9
    np.testing.assert_allclose([found.belief.sum(), found.probabilities.sum()], 1)
    assert found.things[0] == shown
    assert found.residual < 0.2
    assert found.explained[0].min() > 0.9
    turn, moved = off_by(
        found.poses[0],
        true_pose(meshes[shown], 0.8),
        meshes[shown].centre,
    )
    assert moved < 1.5
    # The cups look the same upside down, and the one without a handle at four azimuths.
    assert turn < 1 or shown == 2 or (shown == 1 and turn > 179)


def test_poses_related_by_a_near_symmetry_are_tested():
    # A box with a knob near its upper end, which was taught upright alone, stands on its head.
    mesh = mesh_of(
        ((0.1, 0.06, 0.08), (0, 0, 0)), ((0.02, 0.02, 0.02), (0.06, 0, 0.02))
    )
    over = np.diag([1.0, -1.0, -1.0])
    camera = SimulatedCamera(rotated(mesh, over))
    views = [
        camera.observe(look_at_origin(np.radians(30), np.radians(around)))
        for around in (-20, 20)
    ]
    verifier = verifier_of(mesh)
    near = find_near_symmetries(Surface.from_mesh(mesh, "box"))
    assert {one.order for one in near} == {2}
    verifier.rivals = (rival_turns(near),)
    found = verifier(views)
    assert (np.trace(found.poses[0][:3, :3].T @ over) - 1) / 2 > np.cos(np.radians(2))
    assert found.probabilities[0] > 0.9


def test_the_turns_of_near_symmetries_are_those_of_their_orders():
    turns = rival_turns([Symmetry((0.0, 0.0, 1.0), 6), Symmetry((1.0, 0.0, 0.0), 2)])
    expected = Rotation.from_euler("z", np.arange(60, 360, 60)[:, None], degrees=True)
    np.testing.assert_allclose(turns[:5], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(turns[5], np.diag([1, -1, -1]), atol=1e-12)
    assert len(turns) == 6
    assert rival_turns([]).shape == (0, 3, 3)


def test_views_that_do_not_show_the_thing_are_refused():
    nothing = [
        replace(each, depth=np.zeros_like(each.depth)) for each in views_of(cup(True))
    ]
    with pytest.raises(ObservationError, match="no view shows the thing"):
        verifier_of(cup(True))(nothing)


def residual_of(verifier: Verifier, mesh: Mesh) -> Verified:
    return verifier(views_of(mesh, 0.3)[:2])


def test_an_unexplained_object_has_a_small_p_value():
    known = KnownResiduals.fit(
        np.array([0, 0, 1, 1]),
        np.array([0.1, 0.2, 0.15, 0.25]),
        np.array([2, 2, 2, 2]),
        2,
    )
    verifier = verifier_of(cup(True), l_block())
    stranger = mesh_of(
        ((0.12, 0.12, 0.02), (0, 0, 0)),
        ((0.02, 0.02, 0.12), (0, 0, 0.05)),
    )
    taught, strange = residual_of(verifier, l_block()), residual_of(verifier, stranger)
    # the least of 1 in 5
    assert known.p_value(strange.residual, int(strange.things[0]), 2) == pytest.approx(
        0.2
    )
    assert known.p_value(taught.residual, int(taught.things[0]), 2) > 0.5


def test_a_known_thing_that_always_fits_badly_is_not_unknown():
    rng = np.random.default_rng(0)
    things = np.arange(2).repeat(100)
    usual = np.array([0.5, 0.05])
    residuals = usual[things] * np.exp(rng.normal(0, 0.3, 200))
    known = KnownResiduals.fit(things, residuals, np.ones(200, int), 2)
    np.testing.assert_allclose(known.usual, usual, rtol=0.15)
    assert known.p_value(0.6, 0, 1) > 0.2
    assert known.p_value(0.6, 1, 1) < 0.01
    assert known.p_value(0.0, 1, 1) == 1
    # of more views nothing else is known
    assert known.p_value(0.6, 0, 7) == known.p_value(0.6, 0, 1)


def test_real_camera_noise_does_not_make_a_stranger():
    known = KnownResiduals(np.full(1, 0.05), (np.linspace(-0.3, 0.3, 99),))
    # Pixels that are off by the noise, 50 % more of it than was measured, have this mean.
    off = np.random.default_rng(0).normal(0, 1.49, 100_000)
    explained = float((off**2 / 2).mean())
    assert known.p_value(explained, 0, 1) == pytest.approx(0.01)
    assert known.of_real_camera(explained, 0, 1) >= 0.5
    assert known.of_real_camera(explained + 0.1, 0, 1) == pytest.approx(0.01)
    # a banana does not explain a ring, though it lies on a part of it
    assert known.of_real_camera(explained, 0, 1, explained=0.5) == pytest.approx(0.01)
    # a camera that is more exact than the scan does not err by its noise
    assert known.of_real_camera(
        0.4 * explained,
        0,
        1,
        noise_share=0.4,
    ) == pytest.approx(0.01)
    assert known.of_real_camera(explained, 0, 1, noise_share=0.9) == pytest.approx(0.01)
    assert known.of_real_camera(0.9 * explained, 0, 1, noise_share=0.9) >= 0.5
    # better explained things have larger p-values still
    assert known.of_real_camera(0.04, 0, 1) > known.of_real_camera(0.06, 0, 1)


def episode(
    geometry: float,
    outlines: float,
    truth: int = 0,
    views: int = 1,
) -> JudgedEpisode:
    """Two things; by how much geometry, in each view, and outlines speak for the first one."""
    mean = np.tile([[geometry], [0.0]], (1, views))
    by_outline = np.exp([outlines, 0.0])
    by_outline /= by_outline.sum()
    costs = np.zeros((2, views))
    return JudgedEpisode(
        truth,
        np.array([0, 1]),
        mean,
        costs,
        np.log(by_outline),
        by_outline,
    )


def test_the_belief_follows_from_the_sum_of_what_is_weighed():
    weights = EvidenceWeights(
        geometry=10,
        outlines=0.5,
        cameras=0.2,
        correlation=0.5,
        doubt=0.0,
    )
    log_odds = 10 * 0.3 * 2 / 1.5 + 0.5 * -1.0
    belief = episode(0.3, -1.0, views=2).belief(weights)
    np.testing.assert_allclose(belief[0] / belief[1], np.exp(log_odds))
    doubting = replace(weights, doubt=0.1)
    by_outline = 1 / (1 + np.exp(1.0))
    mixed = 0.9 * belief[0] + 0.1 * by_outline
    np.testing.assert_allclose(episode(0.3, -1.0, views=2).belief(doubting)[0], mixed)


@pytest.mark.parametrize(
    ("trusted", "geometry", "outlines"),
    [("geometry", 0.1, -1.0), ("outlines", -0.1, 1.0)],
)
def test_what_misleads_is_given_the_least_weight(trusted, geometry, outlines):
    fitted = fit_weights(
        [episode(geometry, outlines), episode(-geometry, -outlines, truth=1)]
    )
    assert fitted.geometry == (60 if trusted == "geometry" else 5)
    assert fitted.outlines == (0.2 if trusted == "geometry" else 1)


def test_views_that_err_together_are_not_trusted_as_many():
    # Four views are wrong as often as one: a quarter of the cases.
    both = [
        episode(0.1, 0.0, truth=int(case == 0), views=views)
        for views in (1, 4)
        for case in range(4)
    ]
    fitted = fit_weights(both)
    assert fitted.correlation == max(VIEW_CORRELATIONS)
    assert fitted.geometry == 10  # log-odds of 3 to 1 are 1.1
    with pytest.raises(ModelError, match="fitted to episodes, and there is none"):
        fit_weights([])


def test_a_memory_with_scans_gives_name_and_pose(taught, scans):
    recogniser = TaughtRecogniser(taught / "memory.json", threads=1)
    meshes = {
        name: load_mesh(scans / f"{name}.off", unit="m") for name in ("chair", "table")
    }
    things = TaughtThings(
        recogniser,
        [Surface.from_mesh(mesh, name) for name, mesh in meshes.items()],
    )
    for number, (name, mesh) in enumerate(meshes.items()):
        found = things(views_of(mesh, 1.1)[:2])
        assert things.names[found.belief.argmax()] == name
        assert found.things[0] == number
        turn, moved = off_by(found.poses[0], true_pose(mesh, 1.1), mesh.centre)
        assert moved < 0.01 * 1000 * mesh.metres
        assert turn < 1 or name == "table"  # from four azimuths it looks the same
    with pytest.raises(ModelError, match="sofa is none of them"):
        TaughtThings(recogniser, [Surface.from_mesh(meshes["chair"], "sofa")])
    with pytest.raises(ObservationError, match="nothing can be recognised"):
        things([])


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


def with_handle(size):
    """A can with a handle so many metres wide."""
    body = trimesh.creation.cylinder(0.04, 0.1, sections=64)
    handle = trimesh.creation.box((size, 0.01, 0.06))
    handle.apply_translation((0.04 + size / 2, 0, 0))
    return trimesh.util.concatenate([body, handle])


@pytest.mark.parametrize(("handle", "symmetric"), [(0.0003, True), (0.03, False)])
def test_indistinguishable_rotations_are_symmetries_unless_a_handle_breaks_them(
    handle, symmetric
):
    mesh = with_handle(handle)
    found = find_symmetries(turned_about(mesh.vertices, mesh.faces, 3)[1])
    assert any(one.order == 0 for one in found) == symmetric


@pytest.mark.parametrize("thickness", [0.0, 0.004])
def test_a_sheet_has_the_symmetries_of_its_outline(thickness):
    sheet = trimesh.creation.box((0.1, 0.2, thickness or 1e-9))
    found = find_symmetries(turned_about(sheet.vertices, sheet.faces, 4)[1])
    assert {one.order for one in found} == {2}
    irregular = trimesh.Trimesh(
        [[0, 0, 0], [0.1, 0, 0], [-0.1, 0.2, 0]],
        [[0, 1, 2]],
        process=False,
    )
    assert (
        find_symmetries(turned_about(irregular.vertices, irregular.faces, 5)[1]) == ()
    )


# Surfaces from frames


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A block with a thin wall, 12 cm long, captured from 12 viewpoints on a table; metres."""
    mesh = mesh_of(
        ((0.12, 0.06, 0.03), (0.0, 0.0, 0.0)),
        ((0.004, 0.06, 0.05), (0.03, 0.0, 0.04)),
    )
    folder = tmp_path_factory.mktemp("captured") / "block"
    write_captured(mesh, folder, ViewSphere((15.0, 50.0), 6), mesh.metres, table=True)
    return mesh, folder


@pytest.mark.parametrize("noise", [0.0, 0.0015])
def test_a_surface_from_frames_covers_the_visible_part_of_the_thing(
    captured,
    noise,
):
    mesh, folder = captured
    camera = CapturedCamera(read_capture(folder))
    rng = np.random.default_rng(4)
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
    surface = fuse(camera.object.sightings, camera.object.object_frame.radius, "block")

    # the world's origin is below the middle of the mesh
    height = -mesh.metres * mesh.vertices[:, 2].min()
    true = Surface.from_mesh(mesh, "block")
    truth = true.sample(100_000, rng) - true.centre + (0, 0, height)
    off = cKDTree(truth).query(surface.sample(2000, rng))[0]
    assert (
        off.mean() < 0.0006 + noise / 4
    )  # samples of the truth lie half a millimetre apart
    assert np.quantile(off, 0.95) < 0.0015 + noise

    seen = truth[truth[:, 2] > 0.004]  # not the side that it stands on
    gaps = cKDTree(surface.sample(20_000, rng)).query(seen[:2000])[0]
    assert np.quantile(gaps, 0.95) < 0.003


def test_frames_with_almost_no_visible_points_give_no_surface(captured):
    camera = CapturedCamera(read_capture(captured[1]))
    camera.take_all(look_at_origin(0.3, 0.0))
    one = camera.object.sightings[0]
    few = replace(one, facets=one.facets.some(slice(0, 20)))
    assert fuse([few], 0.07, "block") is None
    assert (
        fuse([replace(one, facets=one.facets.some(slice(0, 0)))], 0.07, "block") is None
    )


def can(knob: bool) -> Mesh:
    """A round tin, with a small knob on its side or without."""
    body = trimesh.creation.cylinder(radius=0.05, height=0.1, sections=96)
    part = trimesh.creation.box((0.016, 0.012, 0.016))
    part.apply_translation((0.054, 0.0, 0.0))
    whole = trimesh.util.concatenate([body, part]) if knob else body
    return make_mesh(whole.vertices, whole.faces, unit="m")


@pytest.mark.parametrize("yaw", [10, 40, 55])
def test_a_small_part_of_a_round_thing_is_found(yaw):
    verifier = verifier_of(can(True), can(False))
    verifier.rivals = tuple(
        rival_turns(find_near_symmetries(surface))
        for surface in verifier.caster.surfaces
    )
    observation = views_of(can(True), np.radians(yaw), [(25.0, 30.0)])
    found = verifier(observation)
    assert found.belief.argmax() == 0
    turned = np.degrees(np.arctan2(found.poses[0, 1, 0], found.poses[0, 0, 0]))
    assert turned == pytest.approx(yaw, abs=3)
