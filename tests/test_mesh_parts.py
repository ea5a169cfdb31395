"""Scans with a table, a turntable's plate or loose pieces, and scans that were saved far from
their origin.
"""

import itertools
import re

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from nextview.errors import MeshError
from nextview.geometry.mesh import load_mesh, make_mesh, mesh_warnings
from nextview.geometry.mesh_parts import mesh_doubts
from nextview.teaching import thing_views

NOISE = np.random.default_rng(0)


def thing(size: float = 0.05) -> trimesh.Trimesh:
    """An egg with a dent, as of a scanner: many small triangles, rough; it stands on the ground."""
    egg = trimesh.creation.icosphere(4)
    egg.vertices *= (
        1
        + 0.15 * np.sin(3 * egg.vertices[:, :1])
        + 0.004 * NOISE.standard_normal((len(egg.vertices), 1))
    )
    egg.vertices *= (size, 0.8 * size, 1.3 * size)
    egg.vertices[:, 2] -= egg.vertices[:, 2].min()
    return egg


def disc(radius: float, thickness: float = 0.01) -> trimesh.Trimesh:
    plate = trimesh.creation.cylinder(radius, thickness, sections=60)
    return plate.apply_translation((0, 0, -thickness / 2 - 1e-4))


def ground(side: float, steps: int = 60) -> trimesh.Trimesh:
    """A table top as of a scanner."""
    x, y = np.meshgrid(*2 * [np.linspace(-side / 2, side / 2, steps)])
    points = np.stack([x, y, 0.001 * NOISE.standard_normal(x.shape)], -1).reshape(-1, 3)
    corner = (np.arange(steps - 1)[:, None] * steps + np.arange(steps - 1)).ravel()
    faces = np.concatenate(
        [
            [corner, corner + 1, corner + steps],
            [corner + 1, corner + steps + 1, corner + steps],
        ],
        1,
    )
    return trimesh.Trimesh(points, faces.T, process=False)


def joined(*parts: trimesh.Trimesh, connected: bool = False) -> trimesh.Trimesh:
    """Parts as one mesh; connected by a thin sliver from each to the next."""
    whole = trimesh.util.concatenate(parts)
    if connected:
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
        whole.faces = np.vstack(
            [whole.faces, [(a, b, b + 1) for a, b in itertools.pairwise(starts)]]
        )
    return whole


def saved(path, shape: trimesh.Trimesh):
    shape.export(path)
    return path


SCANS = {
    "a loose piece": (
        (thing(), thing(0.004).apply_translation((0.5, 0, 0.1))),
        False,
        "2 parts",
    ),
    "crumbs around": (
        (thing(), *(thing(0.001).apply_translation((x, 0.4, 0)) for x in (-0.4, 0.4))),
        False,
        "3 parts",
    ),
    "a plate": ((thing(), disc(0.22)), False, "2 parts"),
    "a large plate": (
        (thing(), disc(0.4, 0.02), thing(0.001).apply_translation((0.3, 0, 0))),
        False,
        "3 parts",
    ),
    "a table that it touches": ((thing(), ground(0.6)), True, "a plane in it is"),
    "a turntable that it touches": ((thing(), disc(0.15)), True, "a plane in it is"),
}


@pytest.mark.parametrize(("kind", "turn"), [("ply", True), ("stl", False)])
@pytest.mark.parametrize("name", SCANS)
def test_what_does_not_belong_to_an_object_is_asked_about(tmp_path, name, kind, turn):
    parts, connected, sentence = SCANS[name]
    shape = joined(*parts, connected=connected)
    if turn:  # a scanner's own axes
        shape.vertices = (
            shape.vertices @ Rotation.from_euler("xyz", (0.4, -1.1, 2)).as_matrix().T
        )
    doubts = mesh_warnings(load_mesh(saved(tmp_path / f"scan.{kind}", shape)))
    assert len(doubts) == 1
    assert sentence in doubts[0]

    if not connected:
        mesh = load_mesh(tmp_path / f"scan.{kind}", largest_part=True)
        alone = make_mesh(
            *(np.asarray(each) for each in (shape.vertices, parts[0].faces))
        )
        assert len(mesh.faces) == len(parts[0].faces)
        assert mesh.radius == pytest.approx(alone.radius, rel=1e-5)
        assert re.fullmatch(
            r"the largest of its \d parts was taken, \d+% of the surface",
            *mesh_warnings(mesh),
        )


@pytest.mark.parametrize(
    "shape",
    [
        thing(),
        disc(0.2),
        trimesh.creation.box((1, 1, 0.001)),
        ground(1.0),
        joined(
            trimesh.creation.box((1.2, 0.6, 0.03)),
            *(
                trimesh.creation.box((0.05, 0.05, 0.7)).apply_translation((x, y, -0.37))
                for x in (-0.55, 0.55)
                for y in (-0.25, 0.25)
            ),
        ),
        joined(thing(), disc(0.06)),
        trimesh.creation.annulus(0.2, 0.25, 0.02),
    ],
    ids=[
        "an egg",
        "a plate",
        "a board",
        "a sheet",
        "a table of five parts",
        "a cup on a saucer",
        "a ring",
    ],
)
def test_nothing_is_asked_about_an_object(shape):
    assert mesh_doubts(np.asarray(shape.vertices), np.asarray(shape.faces)) == ()


@pytest.mark.parametrize(("unit", "radius"), [("m", 70), ("mm", 0.5)])
def test_an_odd_size_is_asked_about(unit, radius):
    egg = thing(radius)
    assert (
        f"is its unit {unit}?"
        in mesh_warnings(make_mesh(egg.vertices, egg.faces, unit=unit))[0]
    )
    assert mesh_warnings(make_mesh(egg.vertices, egg.faces)) == ()


# Far from the origin


@pytest.mark.parametrize("kind", ["ply", "stl", "obj"])
@pytest.mark.parametrize(
    ("offset", "lost"), [(1e3, False), (1e4, False), (1e6, True), (-4e6, True)]
)
def test_a_scan_far_from_its_origin_in_single_precision(tmp_path, kind, offset, lost):
    egg = thing()
    egg.vertices = (egg.vertices + np.array((offset, 10, -20))).astype(np.float32)
    path = saved(tmp_path / f"far.{kind}", egg)
    if lost:
        with pytest.raises(MeshError):
            load_mesh(path)
    else:
        assert load_mesh(path).radius == pytest.approx(
            make_mesh(thing().vertices, thing().faces).radius, rel=0.05
        )


# The option everywhere


def test_what_is_taught_of_a_scan_says_what_is_odd_about_it(tmp_path):
    path = saved(tmp_path / "scan.ply", joined(thing(), disc(0.4)))
    radii = []
    for largest, sentence in (
        (False, "it has 2 parts"),
        (True, "the largest of its 2 parts was taken"),
    ):
        taught = thing_views.teach(
            path,
            "egg",
            thing_views.TeachingOptions(unit="m", upright=True, largest_part=largest),
        )
        assert taught["doubts"].tobytes().decode().startswith(sentence)
        radii.append(float(taught["radii"][0]))
    assert radii[0] > 5 * radii[1]
