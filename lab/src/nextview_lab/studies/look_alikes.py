"""Pairs of things that differ in one place only, made from scans and models, as PLY in metres.

    python -m nextview_lab.studies.look_alikes YCB OUT [--models ModelNet10] [--pairs 40] [--seed 0]

Each pair is one body with and without a change, or with two changes that differ, and the change is
on one side of the body:

| change | first | second |
|---|---|---|
| knob | the body | a ball on its side |
| handle | the body | half a ring on its side |
| handle moved | a handle low on its side | the same handle high on the same side |
| plate | the body | a flat plate on its side |
| hole | the body | a round pocket in its side |
| spout | a straight spout on its side | a spout of the same length that is bent upward |

Bodies are scans of the folder YCB (metres) that are at least 6 cm in diameter and 4 cm in each
direction, and models of ModelNet10 (split "test"), scaled to a diameter of 20 cm. Scans
and models take turns, and so do the changes; bodies and places are drawn by the seed. A place is
taken if the two things differ in 15 to 60 % of the 40 views, that is by more than 4 mm in 10 or
more pixels of a picture of 64 x 64; so a view chosen at random often tells nothing. OUT receives
two files a pair, in one frame of reference, and ``pairs.csv``; the table of pairs is printed.
"""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
import tyro

from nextview.cli.exit_status import orderly_end
from nextview.errors import MeshError, UsageError
from nextview.geometry.camera import pinhole
from nextview.geometry.mesh import load_mesh
from nextview.geometry.ray_caster import RayCaster, embree_scene
from nextview.geometry.viewsphere import ViewSphere
from nextview.types import Float
from nextview_lab.studies.shared import scans_in

SMALLEST_DIAMETER = 0.06  # metres, of a body
SMALLEST_EXTENT = 0.04  # metres, of a body in each direction
TOY_DIAMETER = 0.2  # metres, to which models without a scale are brought
MOST_FACES = 60_000  # of a model

VIEWPOINTS = ViewSphere.named("40")
PICTURE_SIDE = 64  # pixels
RADII_AWAY = 5.0  # of the camera from the centre
DIFFERENT_DEPTH = 0.004  # metres
DIFFERENT_PIXELS = 10
FEWEST_TELL = 0.15  # share of the views in which a pair differs
MOST_TELL = 0.6
PLACES_TRIED = 6  # on one body, before another change is tried


@dataclass(frozen=True)
class Place:
    """Where on the side of a body something is changed.

    Attributes:
        point: on the surface, (3,), metres.
        outward: horizontal unit vector away from the body, (3,).
    """

    point: Float
    outward: Float

    @property
    def axes(self) -> Float:
        """Outward, sideways and up as columns, (3, 3)."""
        up = np.array([0.0, 0.0, 1.0])
        return np.stack([self.outward, np.cross(up, self.outward), up], 1)

    def put(
        self,
        part: trimesh.Trimesh,
        outward: float = 0.0,
        up: float = 0.0,
    ) -> trimesh.Trimesh:
        """A part whose x axis points outward, moved here and some metres farther."""
        moved = part.copy()
        pose = np.eye(4)
        pose[:3, :3] = self.axes
        pose[:3, 3] = self.point + outward * self.outward + (0.0, 0.0, up)
        moved.apply_transform(pose)
        return moved


Pair = tuple[trimesh.Trimesh, trimesh.Trimesh]


def _joined(body: trimesh.Trimesh, *parts: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate([body, *parts])


def _size(body: trimesh.Trimesh) -> float:
    """Diameter by which parts are scaled, metres."""
    return float(np.linalg.norm(body.extents))


def _tube(centres: Float, radius: float) -> trimesh.Trimesh:
    """A tube of balls and cylinders along a line of points, (N, 3)."""
    parts = [trimesh.creation.icosphere(subdivisions=2, radius=radius) for _ in centres]
    for ball, centre in zip(parts, centres, strict=True):
        ball.apply_translation(centre)
    for begin, end in pairwise(centres):
        rod = trimesh.creation.cylinder(
            radius=radius,
            segment=[begin, end],
            sections=16,
        )
        parts.append(rod)
    return trimesh.util.concatenate(parts)


def _handle(body: trimesh.Trimesh) -> trimesh.Trimesh:
    """Half a ring that stands out to +x."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 13)
    high = 0.09 * min(body.extents[2], 0.7 * _size(body))
    wide = max(0.012, 0.06 * _size(body))
    ring = np.stack([wide * np.cos(angles), np.zeros(13), high * np.sin(angles)], 1)
    return _tube(ring, max(0.003, 0.02 * _size(body)))


def knob(body: trimesh.Trimesh, place: Place) -> Pair:
    """A body, and the same with a ball on its side."""
    radius = max(0.006, 0.045 * _size(body))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return body, _joined(body, place.put(ball, outward=0.5 * radius))


def handle(body: trimesh.Trimesh, place: Place) -> Pair:
    """A body, and the same with a handle."""
    return body, _joined(body, place.put(_handle(body)))


def handle_moved(body: trimesh.Trimesh, place: Place) -> Pair:
    """A body with a handle low and one high on the same side."""
    by = 0.12 * float(body.extents[2])
    grip = _handle(body)
    return _joined(body, place.put(grip, up=-by)), _joined(body, place.put(grip, up=by))


def plate(body: trimesh.Trimesh, place: Place) -> Pair:
    """A body, and the same with a plate on its side, that stands a little off it."""
    thick = max(0.01, 0.05 * _size(body))
    wide = 0.12 * _size(body)
    high = 0.25 * min(float(body.extents[2]), _size(body))
    return body, _joined(body, place.put(trimesh.creation.box((thick, wide, high))))


def hole(body: trimesh.Trimesh, place: Place) -> Pair:
    """A body, and the same with a pocket in its side, open outward and closed within."""
    radius = max(0.008, 0.055 * _size(body))
    depth = 1.5 * radius
    corners = (body.triangles - place.point) @ place.axes
    inside = (np.hypot(corners[..., 1], corners[..., 2]) < radius) & (
        corners[..., 0] > -depth
    )
    fine = body.copy()
    fine.update_faces(~inside.all(1))

    wall = trimesh.creation.annulus(radius - 0.001, radius, depth + radius, sections=32)
    wall.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    wall.apply_translation((-(depth - radius) / 2 - radius / 2, 0, 0))
    floor = trimesh.creation.cylinder(radius=radius, height=0.001, sections=32)
    floor.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    # The wall must not stand out of the surface where that bends away.
    outside = wall.triangles[..., 0].min(1) > 0
    wall.update_faces(~outside)
    return body, _joined(fine, place.put(wall), place.put(floor, outward=-depth))


def spout(body: trimesh.Trimesh, place: Place) -> Pair:
    """A body with a straight spout and one with a bent spout."""
    length = max(0.016, 0.1 * _size(body))
    radius = max(0.004, 0.025 * _size(body))
    straight = np.array([[0.0, 0, 0], [0.5, 0, 0.0], [1.0, 0, 0.0]]) * length
    bent = np.array([[0.0, 0, 0], [0.5, 0, 0.0], [0.6, 0, 0.5]]) * length
    first, second = (place.put(_tube(line, radius)) for line in (straight, bent))
    return _joined(body, first), _joined(body, second)


CHANGES: dict[str, Callable[[trimesh.Trimesh, Place], Pair]] = {
    "knob": knob,
    "handle": handle,
    "handle moved": handle_moved,
    "plate": plate,
    "hole": hole,
    "spout": spout,
}
NAMES = {"handle moved": ("low_handle", "high_handle"), "spout": ("straight", "bent")}


def place_on_side(body: trimesh.Trimesh, rng: np.random.Generator) -> Place | None:
    """Draw a place on the outside of a body that looks sideways; None if the ray missed.

    Args:
        body: metres, z up.
        rng: draws.
    """
    azimuth = rng.uniform(0, 2 * np.pi)
    height = rng.uniform(0.35, 0.7)
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    low, high = body.bounds
    aim = (low + high) / 2
    aim[2] = low[2] + height * (high[2] - low[2])
    start = aim + 2 * _size(body) * outward

    scene = embree_scene(
        [(body.vertices.astype(np.float32), body.faces.astype(np.int32))]
    )
    ray = np.ascontiguousarray(-outward[None], np.float32)
    hits = scene.run(np.ascontiguousarray(start[None], np.float32), ray, output=1)
    if hits["primID"][0] < 0:
        return None
    normal = hits["Ng"][0] / np.linalg.norm(hits["Ng"][0])
    if abs(float(normal @ outward)) < 0.8:
        return None
    return Place(start - float(hits["tfar"][0]) * outward, outward)


def depth_pictures(mesh: trimesh.Trimesh, centre: Float, radius: float) -> Float:
    """Exact depth from the 40 views.

    Args:
        mesh: metres.
        centre: at which the cameras look, (3,), metres.
        radius: of a ball about the centre that holds the mesh, metres.

    Returns:
        Depth, (40, PICTURE_SIDE ** 2), metres; infinity beside the mesh.
    """
    caster = RayCaster([(mesh.vertices, mesh.faces)])
    matrix = pinhole(PICTURE_SIDE, RADII_AWAY / 1.3)
    at = (np.arange(PICTURE_SIDE) + 0.5 - matrix[0, 2]) / matrix[0, 0] / 1.02
    x, y = np.meshgrid(at, at)

    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    pictures = []
    for pose in VIEWPOINTS.poses:
        origin = centre + RADII_AWAY * radius * pose[:3, 3] / VIEWPOINTS.distance
        pictures.append(caster.cast(origin, rays @ pose[:3, :3].T)[0])
    return np.stack(pictures)


def telling_share(pair: Pair) -> float:
    """Share of the 40 views in which the two things of a pair differ."""
    both = _joined(*pair)
    centre = both.bounds.mean(0)
    radius = float(np.linalg.norm(both.vertices - centre, axis=1).max())
    first, second = (depth_pictures(mesh, centre, radius) for mesh in pair)
    with np.errstate(invalid="ignore"):
        different = ~(np.abs(first - second) < DIFFERENT_DEPTH) & (
            np.isfinite(first) | np.isfinite(second)
        )
    return float((different.sum(1) >= DIFFERENT_PIXELS).mean())


def body_of(path: Path, scan: bool) -> trimesh.Trimesh | None:
    """The mesh of a file in metres, standing on z = 0.

    Args:
        path: of the file.
        scan: whether it is in metres; a model is scaled to ``TOY_DIAMETER``.

    Returns:
        The mesh; None if it has too many faces, or is too small.
    """
    try:
        mesh = load_mesh(path, unit="m")
    except MeshError:
        return None
    if len(mesh.faces) > MOST_FACES:
        return None
    body = trimesh.Trimesh(mesh.vertices * mesh.radius, mesh.faces, process=False)

    if not scan:
        body.apply_scale(TOY_DIAMETER / _size(body))
    body.apply_translation((0, 0, -body.bounds[0, 2]))

    if _size(body) < SMALLEST_DIAMETER or min(body.extents) < SMALLEST_EXTENT:
        return None
    return body


def make_pairs(
    scans: list[Path],
    models: list[Path],
    count: int,
    seed: int,
) -> list[tuple[tuple[str, str, str, str, str], Pair]]:
    """Draw bodies, changes and places until there are enough pairs.

    Args:
        scans: files in metres.
        models: files that are scaled.
        count: of the pairs.
        seed: decides bodies, changes and places.

    Returns:
        A row of the table, and the meshes, of each.

    Raises:
        UsageError: there are too few bodies.
    """
    rng = np.random.default_rng(seed)
    scans = [scans[k] for k in rng.permutation(len(scans))]
    models = [models[k] for k in rng.permutation(len(models))]
    made: list[tuple[tuple[str, str, str, str, str], Pair]] = []
    while len(made) < count:
        number = len(made)
        scan = not models or number % 2 == 0
        files = scans if scan else models
        if not files:
            raise UsageError(
                f"there are bodies for {number} pairs only, not for {count}"
            )

        path = files.pop()
        body = body_of(path, scan)
        if body is None:
            continue

        # The changes take turns. One that no place on this body suits is left out.
        turn = number % len(CHANGES)
        names = list(CHANGES)
        found = None
        for change in names[turn:] + names[:turn]:
            found = _changed(body, change, rng)
            if found is not None:
                break
        if found is None:
            continue

        pair, share = found
        endings = NAMES.get(change, ("plain", change.replace(" ", "_")))
        first, second = (f"{number:02d}_{path.stem}_{ending}" for ending in endings)
        made.append(((path.stem, change, first, second, f"{share:.3f}"), pair))
    return made


def _changed(
    body: trimesh.Trimesh,
    change: str,
    rng: np.random.Generator,
) -> tuple[Pair, float] | None:
    """A pair of a body that differs in the wanted share of the views, and the share; None if no
    place was found.
    """
    for _ in range(PLACES_TRIED):
        place = place_on_side(body, rng)
        if place is None:
            continue
        pair = CHANGES[change](body, place)
        share = telling_share(pair)
        if FEWEST_TELL <= share <= MOST_TELL:
            return pair, share
    return None


def look_alikes(
    ycb: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    models: Path | None = None,
    pairs: int = 40,
    seed: int = 0,
) -> None:
    """Make pairs of things that differ in one place only.

    Args:
        ycb: folder of scans in metres.
        out: folder of the pairs, which is made.
        models: the folder of ModelNet10; without it all bodies are scans.
        pairs: how many.
        seed: decides bodies and places.
    """
    scans = list(scans_in(ycb, (".ply",)).values())
    others = [] if models is None else sorted(models.glob("*/test/*.off"))
    made = make_pairs(scans, others, pairs, seed)

    out.mkdir(parents=True, exist_ok=False)
    with (out / "pairs.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("body", "change", "first", "second", "telling_share"))
        for row, pair in made:
            table.writerow(row)
            for name, mesh in zip(row[2:4], pair, strict=True):
                mesh.export(out / f"{name}.ply")
    print((out / "pairs.csv").read_text())


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(look_alikes)
