"""Random solids for training a segmentation: containers, machine parts, tools, boxes, lumps.

Every function draws one solid in metres at an arbitrary position, with a longest side of about the
requested size. No solid is a scan or a copy of a product.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.types import Float

Solid = tuple[
    Float, NDArray[np.int32]
]  # vertices, (V, 3), metres, and triangles, (F, 3)

ROUND_SECTIONS = (24, 32)  # sides of a round outline
TUBE_STEPS = 16  # segments of a bent tube


def random_solid(rng: Generator, size: float) -> tuple[str, Solid]:
    """Draw a solid of any kind.

    Args:
        rng: source of all random numbers.
        size: its longest side, metres, within a third.

    Returns:
        Its family, one of ``FAMILIES``; vertices, (V, 3) float64, metres, and triangles, (F, 3)
        int32.
    """
    kinds = [(name, kind) for name, family in FAMILIES.items() for kind in family]
    name, kind = kinds[int(rng.integers(len(kinds)))]
    vertices, faces = kind(rng)
    extent = float(np.ptp(vertices, axis=0).max())
    vertices = vertices * (size * rng.uniform(0.75, 1.33) / extent)
    return name, (vertices, np.asarray(faces, np.int32))


def joined(parts: Sequence[Solid]) -> Solid:
    """Combine several solids, which may overlap, into one."""
    vertices = np.concatenate([part[0] for part in parts])
    starts = np.cumsum([0, *(len(part[0]) for part in parts[:-1])])
    faces = np.concatenate(
        [part[1] + start for part, start in zip(parts, starts, strict=True)]
    )
    return vertices, faces.astype(np.int32)


def moved(
    solid: Solid, turn: Rotation | None = None, by: Sequence[float] = (0, 0, 0)
) -> Solid:
    """Rotate a solid about the origin, then translate it.

    Args:
        solid: the solid.
        turn: rotation; None for none.
        by: translation, metres.
    """
    vertices = solid[0] if turn is None else turn.apply(solid[0])
    return vertices + np.asarray(by, float), solid[1]


def extruded(rings: Sequence[Float], height: float) -> Solid:
    """Extrude an outline with holes from z = 0 upwards; the normals of all faces point outwards.

    Args:
        rings: the outline, (N, 2), and its holes, (M, 2) each, in any sense of rotation.
        height: metres.
    """
    from mapbox_earcut import triangulate_float64

    # the solid is on the left of each ring
    rings = [
        ring if (_signed_area(ring) > 0) == (number == 0) else ring[::-1]
        for number, ring in enumerate(rings)
    ]
    flat = np.concatenate(rings)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    caps = triangulate_float64(flat, ends).reshape(-1, 3)
    upwards = np.array([_signed_area(flat[cap]) > 0 for cap in caps])
    caps = np.where(upwards[:, None], caps, caps[:, ::-1])
    count = len(flat)
    vertices = np.concatenate(
        [np.c_[flat, np.zeros(count)], np.c_[flat, np.full(count, height)]]
    )
    sides = []
    start = 0
    for end in ends:
        at = np.arange(start, end)
        following = np.roll(at, -1)
        sides.append(np.c_[at, following, following + count])
        sides.append(np.c_[at, following + count, at + count])
        start = int(end)
    faces = np.concatenate([caps[:, ::-1], caps + count, *sides])
    return vertices, faces.astype(np.int32)


def _signed_area(ring: Float) -> float:
    """Return the area of a polygon, (N, 2), negative if its corners go clockwise."""
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def ring_points(radius: float, sides: int, centre: Sequence[float] = (0, 0)) -> Float:
    """Return the corners of a regular polygon, (sides, 2).

    Args:
        radius: of its corners.
        sides: number of sides.
        centre: x and y of its centre.
    """
    angles = np.arange(sides) / sides * 2 * np.pi
    return radius * np.c_[np.cos(angles), np.sin(angles)] + np.asarray(centre, float)


def tube(path: Float, radii: Float, sides: int = 12) -> Solid:
    """A closed tube along a path.

    Args:
        path: points, (N, 3).
        radii: of the tube at each of them, (N,).
        sides: of its outline.
    """
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross(along, [0.0, 0.0, 1.0])
    flat = np.linalg.norm(aside, axis=1) < 0.1
    aside[flat] = np.cross(along[flat], [1.0, 0.0, 0.0])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)

    over = np.cross(along, aside)
    corners = ring_points(1.0, sides)
    vertices = path[:, None] + radii[:, None, None] * (
        corners[:, :1] * aside[:, None] + corners[:, 1:] * over[:, None]
    )

    count = len(path)
    vertices = np.concatenate([vertices.reshape(-1, 3), path[:1], path[-1:]])
    steps = np.arange(count - 1)[:, None] * sides
    at = (steps + np.arange(sides)).ravel()
    beside = (steps + (np.arange(sides) + 1) % sides).ravel()

    first = np.arange(sides)
    second = (first + 1) % sides
    last = (count - 1) * sides
    faces = np.concatenate(
        [
            np.c_[at, beside, beside + sides],
            np.c_[at, beside + sides, at + sides],
            np.c_[np.full(sides, count * sides), second, first],
            np.c_[np.full(sides, count * sides + 1), last + first, last + second],
        ]
    )
    return vertices, faces.astype(np.int32)


def box(rng: Generator) -> Solid:
    """A box of any proportions."""
    sides = np.exp(rng.uniform(np.log(0.1), 0, 3))
    corners = sides[:2] * [[0, 0], [1, 0], [1, 1], [0, 1]]
    return extruded([corners], float(sides[2]))


def plate(rng: Generator) -> Solid:
    """A flat box or disc: a book, a plate, a card."""
    thickness = rng.uniform(0.01, 0.12)
    if rng.random() < 0.4:
        return extruded([ring_points(0.5, 32)], thickness)
    corners = np.array([1, rng.uniform(0.4, 1)]) * [[0, 0], [1, 0], [1, 1], [0, 1]]
    return extruded([corners], thickness)


def cylinder(rng: Generator) -> Solid:
    """A can, a disc, a rod, or a prism."""
    sides = int(rng.choice([6, 8, 32, 32, 32]))
    height = float(np.exp(rng.uniform(np.log(0.15), np.log(6))))
    solid = extruded([ring_points(0.5, sides)], height)
    if rng.random() < 0.3:  # a rim or a lid
        wider = extruded(
            [ring_points(0.5 * rng.uniform(0.6, 1.1), sides)], 0.08 * height
        )
        solid = joined([solid, moved(wider, by=(0, 0, height))])
    return solid


def _outline(rng: Generator) -> tuple[Float, Float]:
    """Return radii and heights of a random profile from the bottom up."""
    count = int(rng.integers(3, 9))
    heights = np.linspace(0, rng.uniform(0.3, 3.0), count)
    wobble = rng.normal(0, 0.25, count).cumsum() * rng.choice([0.15, 0.5, 1.0])
    return 0.5 * np.clip(1 + wobble, 0.2, 2.2), heights


def container(rng: Generator) -> Solid:
    """A solid or hollow bottle, bowl, cup or vase."""
    from trimesh.creation import revolve

    radii, heights = _outline(rng)
    outside = np.c_[radii, heights]
    foot = [[0.0, 0.0]]
    if rng.random() < 0.55:
        wall = rng.uniform(0.02, 0.07)
        floor = heights[0] + wall
        inside = np.c_[np.maximum(radii - wall, 0.01), np.maximum(heights, floor)][::-1]
        profile = np.concatenate([foot, outside, inside, [[0.0, floor]]])
    else:
        profile = np.concatenate([foot, outside, [[0.0, heights[-1]]]])
    sections = int(rng.choice([8, *ROUND_SECTIONS, *ROUND_SECTIONS]))
    vessel = revolve(profile, sections=sections, process=False)
    return np.asarray(vessel.vertices), np.asarray(vessel.faces, np.int32)


def bottle(rng: Generator) -> Solid:
    """A body with shoulders, a neck and a cap."""
    from trimesh.creation import revolve

    body, neck, cap = rng.uniform([0.1, 0.03, 0.03], [0.25, 0.09, 0.1])
    shoulder, throat, lip = np.sort(rng.uniform(0.4, 1, 3))
    profile = [[0, 0], [body, 0], [body, shoulder], [neck, throat], [neck, lip]]
    profile += [[cap, lip], [cap, 1], [0, 1]]
    vessel = revolve(np.array(profile, float), sections=32, process=False)
    flatter = [1, rng.choice([1.0, rng.uniform(0.5, 1)]), 1]
    return np.asarray(vessel.vertices) * flatter, np.asarray(vessel.faces, np.int32)


def handled_container(rng: Generator) -> Solid:
    """A mug, a jug, a pan: a container with a handle or a spout."""
    vessel = container(rng)
    height = float(vessel[0][:, 2].max())
    radius = float(np.median(np.linalg.norm(vessel[0][:, :2], axis=1)))
    if rng.random() < 0.6:
        arc = np.linspace(-np.pi / 2, np.pi / 2, TUBE_STEPS)
        reach = rng.uniform(0.2, 0.6)
        path = np.c_[
            0.9 * radius + reach * np.cos(arc),
            np.zeros(TUBE_STEPS),
            height * (0.5 + rng.uniform(0.2, 0.45) * np.sin(arc)),
        ]
    else:
        length = rng.uniform(0.4, 1.5)
        path = np.c_[
            radius * 0.9 + np.linspace(0, length, TUBE_STEPS),
            np.zeros(TUBE_STEPS),
            height * rng.uniform(0.3, 0.95)
            + np.linspace(0, rng.uniform(0, 0.3), TUBE_STEPS),
        ]
    thickness = np.full(TUBE_STEPS, rng.uniform(0.03, 0.1))
    return joined([vessel, tube(path, thickness)])


def compound(rng: Generator) -> Solid:
    """Two to four simple solids, each placed on a face of an earlier one."""
    simple = (box, cylinder, box, lump)
    parts = [simple[int(rng.integers(4))](rng)]
    for _ in range(int(rng.integers(1, 4))):
        part = simple[int(rng.integers(4))](rng)
        part = part[0] * rng.uniform(0.3, 0.9), part[1]
        under = parts[int(rng.integers(len(parts)))][0]
        low = under.min(0)
        high = under.max(0)
        own_low = part[0].min(0)
        own_high = part[0].max(0)

        shift = (low + high - own_low - own_high) / 2
        axis = int(rng.integers(3))
        side = rng.choice([-1, 1])
        reach = (high - low + own_high - own_low)[axis] / 2
        shift[axis] += side * 0.97 * reach
        others = np.arange(3) != axis
        shift[others] += (
            rng.uniform(-0.35, 0.35, 2) * (high - low)[others] * rng.integers(2)
        )
        parts.append(moved(part, by=shift))
    return joined(parts)


def bracket(rng: Generator) -> Solid:
    """A bent sheet: an L, U, Z or T profile, with holes or gussets."""
    thick = rng.uniform(0.03, 0.15)
    width = rng.uniform(0.3, 1.2)
    first, second = rng.uniform(0.4, 1.0, 2)
    legs = [
        extruded([_rectangle(0, 0, first, width), *_holes(rng, first, width)], thick),
        moved(
            extruded(
                [_rectangle(0, 0, second, width), *_holes(rng, second, width)], thick
            ),
            Rotation.from_euler("y", -90, degrees=True),
            (thick, 0, 0),
        ),
    ]

    kind = rng.random()
    if kind < 0.3:
        legs.append(moved(legs[1], by=(first - thick, 0, 0)))
    elif kind < 0.45:
        legs.append(moved(legs[0], by=(-first + thick, 0, second - thick)))
    elif kind < 0.6:
        legs[1] = moved(legs[1], by=(first * rng.uniform(0.3, 0.6), 0, 0))
    return joined(legs)


def _rectangle(left: float, low: float, width: float, height: float) -> Float:
    """Return the corners of a rectangle, (4, 2)."""
    return np.array(
        [
            [left, low],
            [left + width, low],
            [left + width, low + height],
            [left, low + height],
        ]
    )


def _holes(rng: Generator, width: float, height: float) -> list[Float]:
    """Return up to three round holes in a row inside a rectangle."""
    count = int(rng.integers(0, 4))
    radius = 0.16 * min(width / (count + 1), height) * rng.uniform(0.6, 1.5)
    return [
        ring_points(radius, 16, (width * (k + 1) / (count + 1), height / 2))
        for k in range(count)
    ]


def flange(rng: Generator) -> Solid:
    """A disc with bolt holes and a hub on one side."""
    count = int(rng.integers(3, 9))
    bore = rng.uniform(0.08, 0.22)
    hub = bore + rng.uniform(0.05, 0.15)
    circle = (hub + 0.5) / 2
    hole = min(0.06, 0.3 * (0.5 - hub))
    holes = [
        ring_points(hole, 12, (circle * np.cos(angle), circle * np.sin(angle)))
        for angle in np.arange(count) / count * 2 * np.pi
    ]
    thick = rng.uniform(0.06, 0.2)
    disc = extruded([ring_points(0.5, 32), ring_points(bore, 24), *holes], thick)
    tall = rng.uniform(0.1, 0.7)
    neck = extruded([ring_points(hub, 32), ring_points(bore, 24)], tall)
    return joined([disc, moved(neck, by=(0, 0, thick))])


def bolt(rng: Generator) -> Solid:
    """A shaft with a head: a bolt, a screw, a knob; sometimes with a nut."""
    shaft = rng.uniform(0.15, 0.4)
    length = rng.uniform(0.8, 4.0)
    head = extruded(
        [ring_points(0.5, int(rng.choice([6, 24])))], rng.uniform(0.25, 0.6)
    )
    parts = [
        head,
        moved(extruded([ring_points(shaft, 16)], length), by=(0, 0, -length)),
    ]
    if rng.random() < 0.3:
        nut = extruded([ring_points(0.5, 6)], 0.35)
        parts.append(moved(nut, by=(0, 0, -length * rng.uniform(0.5, 0.95))))
    return joined(parts)


def pipe(rng: Generator) -> Solid:
    """A pipe, straight or bent, with collars at its ends."""
    bend = rng.choice([0.0, np.pi / 4, np.pi / 2, np.pi / 2, np.pi])
    radius = rng.uniform(0.1, 0.25)
    if bend:
        angles = np.linspace(0, bend, TUBE_STEPS)
        turn = radius * rng.uniform(1.3, 3.5)
        path = turn * np.c_[np.sin(angles), 1 - np.cos(angles), 0 * angles]
    else:
        path = np.c_[
            np.linspace(0, rng.uniform(0.6, 2), TUBE_STEPS), np.zeros((TUBE_STEPS, 2))
        ]
    parts = [tube(path, np.full(TUBE_STEPS, radius), 20)]

    collar = radius * rng.uniform(1.15, 1.6)
    for end, inner in ((0, 2), (-1, -3)):
        if rng.random() < 0.7:
            ends = np.linspace(path[end], path[inner], 4)
            parts.append(tube(ends, np.full(4, collar), 20))
    return joined(parts)


def gear(rng: Generator) -> Solid:
    """A toothed wheel with a bore and possibly a hub."""
    teeth = int(rng.integers(8, 30))
    angles = np.arange(4 * teeth) / (4 * teeth) * 2 * np.pi
    depth = rng.uniform(0.04, 0.1)
    radii = np.where(np.arange(4 * teeth) % 4 < 2, 0.5, 0.5 - depth)
    outline = np.c_[radii * np.cos(angles), radii * np.sin(angles)]
    bore = ring_points(rng.uniform(0.06, 0.2), 20)
    thick = rng.uniform(0.08, 0.4)
    wheel = extruded([outline, bore], thick)
    if rng.random() < 0.5:
        hub = extruded([ring_points(0.28, 24), bore], rng.uniform(0.1, 0.3))
        wheel = joined([wheel, moved(hub, by=(0, 0, thick))])
    return wheel


def tool(rng: Generator) -> Solid:
    """A long, thin object with a head: cutlery, pliers, hammers, brushes."""
    length = 1.0
    bend = rng.normal(0, 0.15)
    at = np.linspace(0, 1, TUBE_STEPS)
    path = np.c_[at * length, bend * at * (1 - at), np.zeros(TUBE_STEPS)]
    swell = 1 + rng.uniform(-0.4, 0.6) * np.sin(at * np.pi * rng.uniform(0.5, 2))
    grip = tube(path, rng.uniform(0.02, 0.07) * swell)
    grip[0][:, 2] *= rng.uniform(0.3, 1)
    kind = rng.random()
    if kind < 0.3:
        vertices, faces = lump(rng)
        vertices = vertices * rng.uniform(0.15, 0.35)
        head = vertices * [1, 1, rng.uniform(0.2, 1)], faces
    elif kind < 0.6:
        head = box(rng)
        head = (
            head[0] * (rng.uniform(0.15, 0.4) / np.ptp(head[0], axis=0).max()),
            head[1],
        )
        head = moved(head, by=-head[0].mean(0))
    elif kind < 0.8:
        ring = [ring_points(0.12, 24), ring_points(0.07, 20)]
        head = extruded(ring, 0.05)
    else:  # two legs, as of scissors or clamps
        head = moved(grip, Rotation.from_euler("z", rng.uniform(8, 35), degrees=True))
        head = head[0] - [length, 0, 0], head[1]
    return joined([grip, moved(head, by=(length, 0, 0))])


def frame(rng: Generator) -> Solid:
    """A thin object around a hole: a ring, a clamp, a tray's rim, a coat hanger."""
    kind = rng.random()
    if kind < 0.3:  # flat: a washer, a picture frame
        sides = int(rng.choice([4, 6, 32]))
        inner = 0.5 * rng.uniform(0.5, 0.9)
        rings = [ring_points(0.5, sides), ring_points(inner, sides)]
        return extruded(rings, rng.uniform(0.02, 0.15))
    sides = int(rng.choice([3, 4, TUBE_STEPS, 2 * TUBE_STEPS]))
    whole = rng.random() < 0.5
    angles = np.linspace(0, 2 * np.pi * (1 if whole else rng.uniform(0.4, 0.9)), sides)
    corners = 0.5 * np.c_[np.cos(angles), np.sin(angles), 0 * angles]
    corners[:, 1] *= rng.uniform(0.3, 1.0)
    between = np.linspace(0, len(corners) - 1, 3 * TUBE_STEPS)
    path = np.stack(
        [np.interp(between, np.arange(len(corners)), axis) for axis in corners.T], 1
    )
    bow = tube(path, np.full(len(path), rng.uniform(0.015, 0.07)))
    if kind < 0.6:
        return bow
    stem = np.linspace([0.5, 0, 0], [rng.uniform(0.8, 1.6), rng.normal(0, 0.1), 0], 6)
    return joined([bow, tube(stem, np.full(6, rng.uniform(0.015, 0.06)))])


def chain(rng: Generator) -> Solid:
    """A pile of thin links: a chain, a necklace, a string of beads."""
    radius = rng.uniform(0.06, 0.18)
    links = []
    place = np.zeros(2)
    heading = rng.uniform(0, 2 * np.pi)
    for _ in range(int(rng.integers(4, 16))):
        sides = 10
        angles = np.linspace(0, 2 * np.pi, sides)
        ring = np.c_[np.cos(angles), rng.uniform(0.4, 0.9) * np.sin(angles), 0 * angles]
        link = tube(0.5 * ring, np.full(sides, radius), 6)
        tilt = [heading, rng.normal(0, 0.4), rng.normal(0, 0.4)]
        turn = Rotation.from_euler("zyx", tilt)
        links.append(moved(link, turn, (*place, rng.uniform(0, radius))))
        heading += rng.normal(0, 0.9)
        place = place + 0.7 * np.array([np.cos(heading), np.sin(heading)])
    return joined(links)


def sheet(rng: Generator) -> Solid:
    """A flat object with an irregular outline: a key, a spatula, a gasket, a leaf."""
    count = int(rng.integers(5, 40))
    angles = np.sort(rng.uniform(0, 2 * np.pi, count))
    if np.diff(angles, append=angles[0] + 2 * np.pi).max() > 2.5:
        angles = np.arange(count) / count * 2 * np.pi
    waves = rng.normal(0, [0.2, 0.15, 0.1, 0.08])
    turns = np.arange(2, 6)[:, None] * angles + rng.uniform(0, 2 * np.pi, 4)[:, None]
    radii = 0.5 * np.clip(1 + waves @ np.sin(turns), 0.35, 2)
    outline = radii[:, None] * np.c_[np.cos(angles), np.sin(angles)]
    rings = [outline]
    if rng.random() < 0.4:
        rings.append(ring_points(rng.uniform(0.05, 0.14), 16))
    flat, faces = extruded(rings, rng.uniform(0.01, 0.08))
    return flat * [rng.uniform(1, 4), 1, 1], faces


def cutlery(rng: Generator) -> Solid:
    """A flat bow with or without a wider end: a knife, a fork, a spoon, a pen, a ruler."""
    at = np.linspace(0, 1, 2 * TUBE_STEPS)
    start = rng.uniform(0.3, 0.8)
    end = np.sin(np.pi * np.clip((at - start) / (1 - start), 0, 1))
    half = rng.uniform(0.015, 0.05) + rng.choice([0, rng.uniform(0, 0.08)]) * end
    outline = np.concatenate([np.c_[at, half], np.c_[at, -half][::-1]])
    vertices, faces = extruded([outline], rng.uniform(0.012, 0.05))
    vertices[:, 2] += rng.uniform(0, 0.06) * np.sin(np.pi * vertices[:, 0])
    return vertices, faces


def scissors(rng: Generator) -> Solid:
    """Two blades that cross, each with an eye: scissors, pliers."""
    thick = rng.uniform(0.01, 0.03)
    eye = rng.uniform(0.08, 0.14)
    pivot = rng.uniform(-0.2, 0.1)
    opening = rng.uniform(3, 25)
    halves = []
    for side in (-1, 1):
        corners = [[-0.5, -0.02], [pivot, -0.04], [0.5, -0.01], [0.5, 0.01]]
        blade = extruded([np.array([*corners, [pivot, 0.04], [-0.5, 0.02]])], thick)
        centre = -0.5 - 0.8 * eye, side * 0.6 * eye
        rings = [ring_points(eye, 20, centre), ring_points(0.7 * eye, 20, centre)]
        half = moved(joined([blade, extruded(rings, thick)]), by=(-pivot, 0, 0))
        turn = Rotation.from_euler("z", -side * opening, degrees=True)
        halves.append(moved(half, turn, (0, 0, side * thick / 2)))
    return joined(halves)


def dish(rng: Generator) -> Solid:
    """A plate, a saucer or a tray, or upside down with a knob: a lid."""
    from trimesh.creation import revolve

    foot, rim, wall = rng.uniform([0.15, 0.02, 0.01], [0.45, 0.15, 0.03])
    profile = [
        [0, 0],
        [foot, 0],
        [0.5, rim],
        [0.5, rim + wall],
        [foot, wall],
        [0, wall],
    ]
    sections = int(rng.choice([4, *ROUND_SECTIONS]))
    round_one = revolve(np.array(profile), sections=sections, process=False)
    solid = np.asarray(round_one.vertices), np.asarray(round_one.faces, np.int32)
    if rng.random() < 0.5:
        return solid
    knob = extruded([ring_points(rng.uniform(0.04, 0.12), 20)], rng.uniform(0.05, 0.2))
    lid = moved(solid, Rotation.from_euler("x", 180, degrees=True))
    return joined([lid, knob])


def lump(rng: Generator) -> Solid:
    """A round object with a soft relief: a ball, an egg, a fruit, a crumpled cloth."""
    from trimesh.creation import icosphere

    ball = icosphere(3, 0.5)
    directions = np.asarray(ball.vertices) * 2
    relief = np.ones(len(directions))
    strength = rng.choice([0.0, 0.05, 0.12])
    for _ in range(5):
        wave = rng.normal(0, 2.5, 3)
        relief += (
            strength * rng.normal() * np.sin(directions @ wave + rng.uniform(0, 6))
        )
    sides = np.exp(rng.uniform(np.log(0.4), 0, 3)) if rng.random() < 0.6 else np.ones(3)
    vertices = 0.5 * directions * relief[:, None] * sides
    return vertices, np.asarray(ball.faces, np.int32)


def bent_lump(rng: Generator) -> Solid:
    """A banana, a hook, a handle: a tube that bends and tapers."""
    at = np.linspace(0, 1, TUBE_STEPS)
    bend = rng.uniform(0.3, 3.5)
    path = np.c_[np.sin(bend * (at - 0.5)), np.cos(bend * (at - 0.5)), 0 * at] / bend
    taper = 1 - rng.uniform(0, 0.8) * np.abs(2 * at - 1) ** rng.integers(1, 6)
    return tube(path, (rng.uniform(0.04, 0.16) * taper).astype(float))


FAMILIES: dict[str, Sequence[Callable[[Generator], Solid]]] = {
    "groceries": (box, box, cylinder, cylinder, bottle, container),
    "flat": (plate, plate, sheet, cutlery, cutlery, scissors, dish),
    "others": (
        container,
        handled_container,
        compound,
        compound,
        bracket,
        flange,
        bolt,
        pipe,
        gear,
        tool,
        tool,
        frame,
        frame,
        chain,
        lump,
        bent_lump,
    ),
}
"""Kinds of solids that are drawn equally often, by what may lie together."""
