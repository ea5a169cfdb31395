"""What candidate views are expected to tell: closed forms, and what the score really says."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from exact_views import framed, mesh_of

from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.viewsphere import (
    ViewSphere,
    angle_between,
    look_at_origin,
    rotation_z,
)
from nextview.policies.base import EpisodeState
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.recognition.evidence import Evidence
from nextview.session.ranked import rank_views
from nextview.session.recogniser import ThingRecogniser
from nextview.session.target import view_of
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import SENSORS
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.library import Hypotheses, Library
from nextview.things.score import score
from nextview.things.surface import Surface, SurfaceCaster
from nextview.views.expected_images import ExpectedSensor, SeenSurroundings
from nextview.views.expected_model import Leading
from nextview.views.expected_views import ExpectedViews, Outlook, expected_views

SPHERE = ViewSphere.named("40")
AWAY = 0.45  # metres from the centre
SENSOR = ExpectedSensor(pitch=1 / 424, noise=0.004)
BODY = ((0.08, 0.08, 0.1), (0.0, 0.0, 0.0))
KNOB = ((0.02, 0.02, 0.02), (0.05, 0.0, 0.0))  # on the side of +x
HANDLE = ((0.05, 0.015, 0.06), (0.06, 0.0, 0.0))


def surfaces_of(*meshes: Mesh) -> SurfaceCaster:
    return SurfaceCaster(
        [Surface.from_mesh(mesh, str(k)) for k, mesh in enumerate(meshes)]
    )


def hypotheses_of(things, belief, yaws=None) -> Leading:
    poses = np.tile(np.eye(4), (len(things), 1, 1))
    if yaws is not None:
        poses[:, :3, :3] = rotation_z(yaws)
    return Leading(np.array(things), poses, np.array(belief, float))


def cameras(sphere=SPHERE) -> np.ndarray:
    poses = sphere.poses.copy()
    poses[:, :3, 3] *= AWAY / sphere.distance
    return poses


def knob_or_not(belief=(0.5, 0.5), order=(0, 1), surroundings=None) -> ExpectedViews:
    """A box, and the same with a knob; hypotheses in some order."""
    caster = surfaces_of(mesh_of(BODY), mesh_of(BODY, KNOB))
    hypotheses = hypotheses_of(order, np.array(belief)[list(order)])
    return expected_views(caster, hypotheses, cameras(), SENSOR, surroundings)


def test_the_best_view_shows_the_place_in_which_two_things_differ():
    values = knob_or_not().information()
    towards = np.degrees(angle_between(SPHERE.directions, np.array([1.0, 0, 0])))
    assert towards[values.argmax()] < 60
    assert values[(towards > 120)].max() < 0.01  # the body hides the knob
    assert values[(towards < 40)].min() > 0.35
    assert values.max() < np.log(2) + 1e-9


def test_a_motion_absorbed_by_registration_gives_no_information():
    caster = surfaces_of(mesh_of(BODY), mesh_of(BODY))
    hypotheses = hypotheses_of((0, 1), (0.5, 0.5))
    hypotheses.poses[1, :3, 3] = (0.0015, -0.001, 0.0)
    found = expected_views(caster, hypotheses, cameras(), SENSOR)
    assert found.information().max() < 0.2
    hypotheses.poses[1, :3, 3] = (0.03, 0.0, 0.0)
    assert (
        expected_views(caster, hypotheses, cameras(), SENSOR).information().max() > 0.4
    )


def wall(distance: float) -> np.ndarray:
    """Points of a wall on the side of +x, metres."""
    y, z = np.meshgrid(np.linspace(-0.3, 0.3, 121), np.linspace(-0.3, 0.5, 161))
    return np.stack([np.full(y.size, distance), y.ravel(), z.ravel()], 1)


def test_views_from_behind_an_obstacle_are_worth_nothing():
    open_view = knob_or_not().information()
    hidden = knob_or_not(surroundings=SeenSurroundings(wall(0.12))).information()
    ahead = (SPHERE.elevation < 0.4) & (SPHERE.directions[:, 0] > 0.6)
    assert open_view[ahead].min() > 0.3
    np.testing.assert_allclose(hidden[ahead], 0, atol=1e-9)
    behind = knob_or_not(surroundings=SeenSurroundings(wall(-0.2))).information()
    np.testing.assert_allclose(behind[ahead], open_view[ahead], atol=0.2)
    assert behind[ahead].min() > 0.3


def expected(divergence, belief, things) -> ExpectedViews:
    """Views of which the divergences are known."""
    divergence = np.asarray(divergence, float)
    hypotheses = hypotheses_of(things, belief)
    some = np.ones(len(divergence))
    return ExpectedViews(
        hypotheses, divergence, np.zeros_like(divergence), some, some, 0 * some
    )


def test_poses_of_one_thing_are_worth_telling_apart_only_for_the_pose():
    far = 4000.0 * (1 - np.eye(2))[None]
    found = expected(far, (0.5, 0.5), (3, 3))
    np.testing.assert_allclose(found.information("thing"), 0, atol=1e-12)
    np.testing.assert_allclose(found.information("pose"), np.log(2))

    caster = surfaces_of(mesh_of(BODY, HANDLE))
    two = hypotheses_of((0, 0), (0.5, 0.5), yaws=(0.0, np.pi))
    by_render = expected_views(caster, two, cameras(), SENSOR)
    np.testing.assert_allclose(by_render.information("thing"), 0, atol=1e-12)
    assert by_render.information("pose").max() > 0.6
    quarter = hypotheses_of((0, 0), (0.5, 0.5), yaws=(0.0, np.pi / 2))
    square = expected_views(surfaces_of(mesh_of(BODY)), quarter, cameras(), SENSOR)
    assert square.information("pose").max() < 0.1  # it looks the same


@pytest.mark.parametrize("shown", [0, 1])
@pytest.mark.parametrize("side", [0.0, 180.0])
def test_a_view_is_expected_to_tell_where_the_score_tells(shown, side):
    """With the handle in sight, and behind the body."""
    meshes = [mesh_of(BODY), mesh_of(BODY, HANDLE)]
    mesh = meshes[shown]
    camera = SimulatedCamera(mesh, 200)
    found = camera.observe(look_at_origin(np.radians(36.0), np.radians(side)))
    rng = np.random.default_rng(shown)
    depth = found.depth
    noise = SENSOR.noise * depth**2 * found.radius * rng.standard_normal(depth.shape)
    measured = np.where(depth > 0, depth + noise, 5.0).astype(np.float32)
    seen = framed(found, measured, depth > 0)

    library = Library([Surface.from_mesh(one, str(k)) for k, one in enumerate(meshes)])
    centres = library.centres - mesh.centre
    both = Hypotheses.of(np.array([0, 1]), np.tile(np.eye(3), (2, 1, 1)), centres)
    said = score(library, view_of(seen), both)
    ratio = said[shown].total - said[1 - shown].total

    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = -mesh.centre
    hypotheses = Leading(np.array([0, 1]), poses, np.array([0.5, 0.5]))
    pose = found.pose.copy()
    pose[:3, 3] *= found.radius
    expected = expected_views(library.caster, hypotheses, pose[None], SENSOR)
    if side == 0.0:
        assert ratio > 0.1 * said[shown].total
        assert expected.information()[0] > 0.5 * np.log(2)
    else:
        assert abs(ratio) < 0.02 * said[shown].total
        assert expected.information()[0] < 0.1 * np.log(2)


def outlook_of(belief, taken=1, unknown=0.0) -> Outlook:
    """A box, or the same with a knob, last seen from the side of -x."""
    return Outlook(
        caster=surfaces_of(mesh_of(BODY), mesh_of(BODY, KNOB)),
        hypotheses=hypotheses_of((0, 1), belief),
        sensor=SENSOR,
        surroundings=SeenSurroundings.nothing(),
        place=np.array([-AWAY, 0.0, 0.0]),
        taken=taken,
        covariance=1e-6 * np.eye(6),
        unknown=unknown,
    )


def settled(
    belief, visited, reachable=None, travel=None, unknown=0.0, **policy
) -> tuple[int, np.ndarray]:
    """Where the policy goes from some views, a box or the same with a knob, and its values."""
    been = np.isin(np.arange(len(SPHERE)), visited)[None]
    state = EpisodeState(
        current=np.array(visited[-1:]),
        visited=been,
        belief=np.array([belief]),
        evidence=Evidence(np.zeros((1, 2))),
        step=len(visited),
        reachable=reachable,
        travel=travel,
        outlook=[outlook_of(belief, len(visited), unknown)],
    )
    chooses = DiscriminateGeometry(SPHERE, **policy)
    values = chooses.view_values(state)[0]
    return int(chooses.next_views(state, np.random.default_rng(0))[0]), values


def test_the_policy_goes_where_the_knob_shows_and_can_be_reached():
    from_behind = 4  # on the ring of elevation 0, at an azimuth of 180 degrees
    chosen, values = settled((0.5, 0.5), [from_behind])
    assert SPHERE.directions[chosen, 0] > 0.5
    assert np.isnan(values[from_behind])

    reachable = (SPHERE.directions[:, 0] < 0.3)[None]
    chosen, values = settled((0.5, 0.5), [from_behind], reachable)
    assert reachable[0, chosen]
    assert (np.isnan(values) == ~(reachable[0] & (np.arange(40) != from_behind))).all()


def test_what_is_none_of_the_hypotheses_is_looked_at_from_the_other_side():
    ahead = 0  # the knob shows
    chosen, values = settled((0.5, 0.5), [ahead], unknown=1.0)
    apart = angle_between(SPHERE.directions, SPHERE.directions[ahead])
    assert apart[chosen] > np.radians(120)
    assert np.nanmax(values) > 0.2


def test_something_unknown_has_an_outlook_as_large_as_it_is(knobs_memory, knobs):
    recogniser = ThingRecogniser(knobs_memory / "memory.json", 1)
    library = recogniser.library
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    points *= library.radii.max() / np.linalg.norm(points, axis=1, keepdims=True)
    found = Leading.as_large_as(points + np.array([0.3, 0.0, 0.1]), library)
    (thing,) = found.things
    assert library.radii[thing] == library.radii.max()
    middle = found.poses[0, :3, 3] + library.centres[thing]
    np.testing.assert_allclose(middle, [0.3, 0.0, 0.1], atol=0.01)


def test_an_outlook_combines_the_views_and_what_explains_them(knobs_memory, knobs):
    recogniser = ThingRecogniser(knobs_memory / "memory.json", 1)
    mesh = load_mesh(knobs / "knob.ply", unit="m")
    sensor = replace(SENSORS["none"], radius=mesh.metres, distance=AWAY)
    block = trimesh.creation.box((0.2, 1.0, 1.5))
    block.apply_translation((1.8, 0.0, 0.0))  # object radii
    obstacle = Mesh(
        np.asarray(block.vertices), block.faces.astype(np.int32), np.zeros(3), 1.0
    )
    camera = SensedCamera(mesh, sensor, np.random.default_rng(0), around=obstacle)
    observations = [camera.observe(SPHERE.poses[view]) for view in (12, 18)]
    total = np.zeros(len(recogniser.classes))
    found = recogniser.together(observations, total, 2)
    outlook = recogniser.outlook(observations, found)
    assert outlook.taken == 2
    # its camera is corrected within its accuracy
    assert outlook.distance == pytest.approx(AWAY, abs=0.004)
    assert outlook.sensor.pitch == pytest.approx(
        1 / observations[0].sighting.frame.intrinsics[0, 0]
    )
    assert outlook.hypotheses.belief.sum() == pytest.approx(1)
    around = outlook.surroundings
    metres = mesh.metres
    assert around.floor == pytest.approx(-0.05, abs=0.003)
    assert around.reach == pytest.approx(1.5 * metres, rel=0.1)  # radius of the table
    assert len(around.obstacles) > 20
    assert around.obstacles[:, 0].min() > 1.6 * metres


def test_poses_of_a_robot_are_ranked():
    outlook = outlook_of((0.5, 0.5))
    behind, aside, ahead = (
        look_at_origin(0.3, azimuth, AWAY) for azimuth in (3.1, 1.5, 0.1)
    )
    inside = np.stack([behind, aside, ahead])
    ranked = rank_views(outlook, inside, inside, np.array([7, 8, 9]), "thing")
    assert ranked[0].index == 9
    np.testing.assert_array_equal(ranked[0].pose, ahead)
    assert ranked[0].settles > 0.5
    assert ranked[0].words.startswith("would settle 0 or 1")
    assert "9: would settle 0 or 1" in repr(ranked[0])
    worth = [view.information for view in ranked]
    assert worth[0] > worth[1] >= worth[2]
    assert rank_views(outlook, inside[:0], inside[:0], np.arange(0), "thing") == ()
    with pytest.raises(UsageError):
        rank_views(outlook, inside, inside, np.arange(3), "name")


def test_what_is_not_the_object_explains_nothing_and_costs_nothing():
    mesh = mesh_of(BODY)
    camera = SimulatedCamera(mesh, 200)
    found = camera.observe(look_at_origin(np.radians(36.0), 0.0))
    shown = found.depth > 0
    half = shown & (np.arange(200) < 100)  # the rest is of another object
    library = Library([Surface.from_mesh(mesh, "body")])
    there = Hypotheses.of(
        np.zeros(1, int), np.eye(3)[None], library.centres - mesh.centre
    )

    def said(target):
        seen = framed(found, found.depth, target)
        return score(library, view_of(seen), there)[0]

    part, whole = said(half), said(shown)
    assert half.ravel()[part.cells[part.gain > 0]].all()
    assert part.share == pytest.approx(whole.share, abs=0.05)
    assert part.total == pytest.approx(whole.total / 2, rel=0.1)
