"""Scans with faults, things of one shape, and frames that show a part: right, or not sure."""

import numpy as np
import pytest
import trimesh
from exact_views import (
    cup,
    explained,
    framed,
    l_block,
    library_of,
    off_by,
    turned_views,
    wall_behind,
)

from nextview.geometry.mesh import Mesh, make_mesh
from nextview.geometry.viewsphere import rotation_z
from nextview.sensing.observation import Observation
from nextview.things.naming import CONFIDENT

YAW = rotation_z(0.3)


def fine(mesh: Mesh) -> trimesh.Trimesh:
    """A mesh in the frame and the unit of its file, with edges of 5 mm at most."""
    whole = trimesh.Trimesh(mesh.vertices * mesh.radius + mesh.centre, mesh.faces)
    return whole.subdivide_to_size(0.005)


def inverted(scan: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(scan.vertices, scan.faces[:, ::-1], process=False)


def half_inverted(scan: trimesh.Trimesh) -> trimesh.Trimesh:
    faces = scan.faces.copy()
    some = np.random.default_rng(0).random(len(faces)) < 0.5
    faces[some] = faces[some, ::-1]
    return trimesh.Trimesh(scan.vertices, faces, process=False)


def with_holes(scan: trimesh.Trimesh) -> trimesh.Trimesh:
    """Round holes of 1 cm in a twentieth of the surface."""
    middles = scan.triangles_center
    rng = np.random.default_rng(0)
    left = np.ones(len(middles), bool)
    while left.mean() > 0.95:
        left &= np.linalg.norm(middles - rng.choice(middles), axis=1) > 0.005
    return trimesh.Trimesh(scan.vertices, scan.faces[left], process=False)


def shell(scan: trimesh.Trimesh) -> trimesh.Trimesh:
    """What a scanner above a table saw of it: nothing of what points down."""
    return trimesh.Trimesh(
        scan.vertices, scan.faces[scan.face_normals[:, 2] > -0.5], process=False
    )


def double_walled(scan: trimesh.Trimesh) -> trimesh.Trimesh:
    """With a second surface 2 mm within."""
    within = scan.copy()
    within.vertices -= 0.002 * within.vertex_normals
    return trimesh.util.concatenate([scan, within])


@pytest.mark.parametrize(
    "fault", [inverted, half_inverted, with_holes, shell, double_walled]
)
@pytest.mark.parametrize("thing", [0, 1])
def test_a_scan_with_faults_is_recognised(thing, fault):
    intact = (l_block(), cup(True))
    faulty = fault(fine(intact[thing]))
    taught = list(intact)
    taught[thing] = make_mesh(faulty.vertices, faulty.faces, unit="m")
    views, true = turned_views(intact[thing], YAW)
    found = explained(library_of(*taught, cup(False)), views[:2])
    assert found.thing == thing
    degrees, millimetres = off_by(found.pose, true, intact[thing].centre)
    if thing == 1:
        degrees = min(degrees, 180 - degrees)  # the cup looks the same upside down
    assert degrees < 2
    assert millimetres < 2


def cut(observation: Observation, share: float) -> Observation:
    """The same view in a picture that ends within the thing: a share of its columns is missing."""
    depth, target = wall_behind(observation)
    columns = np.flatnonzero(target.any(0))
    last = int(columns[-1] - share * (columns[-1] - columns[0]))
    return framed(observation, depth[:, :last], target[:, :last])


@pytest.fixture(scope="module")
def things():
    return l_block(), cup(True), cup(False)


@pytest.fixture(scope="module")
def library(things):
    return library_of(*things)


@pytest.mark.parametrize(
    ("thing", "share"),
    [
        (0, 0.1),
        (0, 0.5),
        (1, 0.1),
        (1, 0.5),
    ],
)
def test_what_the_border_of_the_picture_cuts_is_right_or_not_sure(
    things, library, thing, share
):
    views, true = turned_views(things[thing], YAW)
    found = explained(library, [cut(view, share) for view in views[:2]])
    assert found is None or found.thing == thing or found.right < CONFIDENT
    if share < 0.2:
        assert found.thing == thing
        degrees, _ = off_by(found.pose, true, things[thing].centre)
        if thing == 1:
            degrees = min(degrees, 180 - degrees)  # the same upside down
        assert degrees < 3
