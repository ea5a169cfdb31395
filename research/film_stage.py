"""Light and shadow for a film: things on a table under a lamp and a sky, cast by Embree without
a graphics card.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import binary_dilation, binary_erosion

from nextview.geometry.viewsphere import (
    VIEW_LAYOUTS,
    great_circle,
    level_pose,
    look_at_origin,
)
from nextview.session.style import heat
from nextview.things.expected_views import RivalPictures

Array = np.ndarray
Colour = tuple[int, int, int]
KEY = np.array([-0.62, -0.30, 0.72])
SUN = np.array([1.30, 1.22, 1.08])
SKY = np.array([0.46, 0.50, 0.56])
"""Where the lamp is, how bright it is and the sky: red, green, blue."""
SAMPLES = 12
"""Rays to the lamp and to the sky from each point of a still."""
BEFORE_THE_TABLE = (23.0, -63.0)  # elevation and azimuth of the film's camera, degrees
REACH = 2.0
"""Object radii from which the camera is drawn."""


class Stage:
    """Things in the light of a lamp and a sky: Embree casts what is seen, the shadows and the
    sky's share.
    """

    def __init__(self, things: list[tuple[Array, Array, tuple]]) -> None:
        self.scene = EmbreeScene()
        self.things = []
        for vertices, faces, colour in things:
            TriangleMesh(
                self.scene,
                vertices.astype(np.float32),
                np.ascontiguousarray(faces, np.int32),
            )
            normals = np.zeros_like(vertices)
            of_faces = np.cross(
                *(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2))
            )
            for i in range(3):
                np.add.at(normals, faces[:, i], of_faces)
            self.things.append((faces, normals, np.array(colour)))

    def blocked(self, points: Array, rays: Array) -> Array:
        """Whether rays (..., 3) from points meet anything."""
        points, rays = np.broadcast_arrays(points, rays)
        shape = rays.shape[:-1]
        flat = [
            np.ascontiguousarray(x.reshape(-1, 3), np.float32) for x in (points, rays)
        ]
        return (self.scene.run(*flat) >= 0).reshape(shape)

    def hits(self, eye: Array, rays: Array) -> tuple[Array, Array, Array, Array]:
        """Which rays (N, 3) hit, and of these points, normals and colours."""
        origins = np.broadcast_to(eye, rays.shape)
        found = self.scene.run(
            *(np.ascontiguousarray(x, np.float32) for x in (origins, rays)),
            output=1,
        )
        hit = found["primID"] >= 0
        points = eye + rays[hit] * found["tfar"][hit, None]
        normals = np.zeros_like(points)
        colours = np.zeros_like(points)
        u = found["u"][hit, None]
        v = found["v"][hit, None]
        for k, (faces, of_vertices, colour) in enumerate(self.things):
            own = found["geomID"][hit] == k
            corner = of_vertices[faces[found["primID"][hit][own]]]
            normals[own] = (
                (1 - u - v)[own] * corner[:, 0]
                + u[own] * corner[:, 1]
                + v[own] * corner[:, 2]
            )
            colours[own] = colour
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
        normals *= np.where((normals * rays[hit]).sum(1, keepdims=True) > 0, -1, 1)
        return hit, points, normals, colours

    def lit(
        self,
        points: Array,
        normals: Array,
        colours: Array,
        rng: np.random.Generator,
        samples: int,
    ) -> tuple[Array, Array]:
        """The light of the sky, and of the lamp, that comes from each point."""
        start = points + 1e-4 * normals
        sky = np.zeros(len(points))
        lamp = np.zeros(len(points))
        for k in range(samples):
            turn = 2 * np.pi * (k / samples + rng.random((len(points), 1)))
            height = 1 - 2 * ((k + rng.random((len(points), 1))) / samples)
            ball = np.hstack(
                [
                    np.sqrt(1 - height**2) * np.cos(turn),
                    np.sqrt(1 - height**2) * np.sin(turn),
                    height,
                ]
            )
            up = normals + 0.999 * ball
            sky += (
                np.where(
                    self.blocked(start, up),
                    0.22,
                    0.75 + 0.25 * up[:, 2] / np.linalg.norm(up, axis=1),
                )
                / samples
            )
            lamp += ~self.blocked(start, KEY + 0.11 * ball) / samples
        facing = np.maximum(normals @ KEY / np.linalg.norm(KEY), 0)
        return colours * SKY * sky[:, None], colours * SUN * (lamp * facing)[:, None]


def toned(light: Array) -> Array:
    """Light as sRGB, uint8: filmic (Narkowicz's fit of ACES)."""
    x = 0.82 * light
    x = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return (
        255 * np.where(x < 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) + 0.5
    ).astype(np.uint8)


@dataclass(frozen=True)
class Shot:
    """A still of one thing, and what is needed to draw on it: light of sky and lamp, points, and
    the camera.
    """

    sky: Array
    lamp: Array
    points: Array
    pose: Array
    focal: float
    centre: Array
    radius: float

    def place(self, points: Array) -> tuple[Array, Array]:
        """Pixels (N, 2) of points, and their depths."""
        inside = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        height, width = self.sky.shape[:2]
        return inside[:, :2] / inside[:, 2:] * self.focal + [
            width / 2,
            height / 2,
        ], inside[:, 2]


def rays_of(pose: Array, focal: float, width: int, height: int) -> Array:
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) / focal,
        (np.arange(height) + 0.5 - height / 2) / focal,
    )
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T


def wood(points: Array) -> Array:
    """How light the table's boards are, beside their mean."""
    board = np.floor(points[:, 1] / 0.16)
    along = points[:, 0] + 0.37 * np.floor(points[:, 1] / 0.16)
    across = (
        points[:, 1]
        + 0.006 * np.sin(9 * along + 2 * board)
        + 0.003 * np.sin(23 * along)
    )
    fine = (
        np.sin(900 * across)
        + np.sin(1490 * across + 3 * along)
        + np.sin(370 * across + 1.3 * along)
    )
    joint = 1 - 0.35 * np.exp(
        -(((0.5 - np.abs(points[:, 1] / 0.16 % 1 - 0.5)) / 0.006) ** 2)
    )
    return (1 + 0.014 * fine + 0.05 * np.sin(2.4 * board + 1)) * joint


def shot(
    stage: Stage,
    r: float,
    centre: Array,
    size: tuple[int, int],
    towards: tuple[float, float] = BEFORE_THE_TABLE,
) -> Shot:
    """A still of a thing.

    Args:
        stage: what is seen.
        r: radius of the thing, metres.
        centre: of the thing, (3,), metres.
        size: width and height, pixels.
        towards: elevation and azimuth of the camera, degrees.
    """
    width, height = size
    rng = np.random.default_rng(0)
    elevation, azimuth = np.radians(towards)
    pose = look_at_origin(elevation, azimuth, 13 * r)
    focal = width / 2 / (2.6 / 13)
    pose[:3, 3] += centre + np.array([0, 0, 0.5 * r])
    rays = rays_of(pose, focal, width, height)
    hit, points, normals, colours = stage.hits(pose[:3, 3], rays)
    sky = np.tile(SKY * 0.9, (len(rays), 1))
    lamp = np.zeros_like(rays)
    where = np.full_like(rays, np.inf)
    light = stage.lit(points, normals, colours, rng, SAMPLES)
    grain = np.where(points[:, 2:] < 1e-4, wood(points)[:, None], 1)
    light = [x * grain for x in light]
    # Into the background's haze.
    away = np.linalg.norm(points - centre, axis=1) / 2.2 - 0.25
    far = np.clip(away, 0, 1)[:, None] ** 2
    sky[hit], lamp[hit] = light[0] * (1 - far) + 1.15 * SKY * far, light[1] * (1 - far)
    where[hit] = points
    return Shot(
        *(x.reshape(height, width, 3) for x in (sky, lamp, where)),
        pose,
        focal,
        centre,
        r,
    )


def unit(x: Array) -> Array:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


@dataclass(frozen=True)
class Look:
    """A view and what followed: the leading classes with their belief, what views are worth, and
    the leading two as the next view would show them.
    """

    direction: Array
    picture: Array
    leading: list[tuple[str, float]]
    values: Array | None
    rivals: RivalPictures | None
    names: tuple[str, str]
    next_view: int | None
    travel: float


def gadget() -> tuple[Array, Array]:
    """A camera at the end of a wrist, looking along z; one is its distance from a thing's middle
    to its surface.
    """
    box = trimesh.creation.box((0.62, 0.26, 0.22))
    lens = trimesh.creation.cylinder(0.11, 0.14, 40)
    lens.apply_translation((0.14, 0, 0.17))
    second = lens.copy()
    second.apply_translation((-0.30, 0, 0))
    wrist = trimesh.creation.cylinder(0.15, 0.5, 40)
    wrist.apply_translation((0, 0, -0.36))
    parts = trimesh.util.concatenate([box, lens, second, wrist])
    return np.array(parts.vertices), np.array(parts.faces, np.int32)


def scene(
    shot: Shot,
    colour: Colour,
    looks: list[Look],
    at: int,
    progress: float,
) -> Image.Image:
    """The table: what views are worth, the way so far, and the camera on its way to look ``at``."""
    look = looks[at]
    before = looks[max(at - 1, 0)]
    way = great_circle(before.direction, look.direction, 25)
    here = way[round(24 * progress)]
    pose = level_pose(here, REACH)
    vertices, faces = gadget()
    hand = Stage(
        [
            (
                (0.36 * vertices @ pose[:3, :3].T + pose[:3, 3]) * shot.radius
                + shot.centre,
                faces,
                (0.05, 0.055, 0.065),
            )
        ]
    )
    middle = pose[:3, 3] * shot.radius + shot.centre
    to_lamp = KEY / np.linalg.norm(KEY)
    off = middle - np.where(np.isfinite(shot.points), shot.points, 1e3)
    near = (
        np.linalg.norm(off - (off @ to_lamp)[..., None] * to_lamp, axis=2)
        < 0.5 * shot.radius
    )
    lamp = shot.lamp.copy()
    rng = np.random.default_rng(0)
    jitter = 0.09 * rng.normal(size=(6, 1, 3))
    lamp[near] *= (
        1 - hand.blocked(shot.points[near] + 1e-4, KEY + jitter).mean(0)[:, None]
    )
    picture = Image.fromarray(toned(shot.sky + lamp))
    draw = ImageDraw.Draw(picture, "RGBA")
    dots(draw, shot, before if progress < 1 else look, colour)
    stood = [great_circle(a.direction, b.direction) for a, b in pairwise(looks[:at])]
    path = (
        np.concatenate([*stood, way[: round(24 * progress) + 1]])[::2]
        * REACH
        * shot.radius
        + shot.centre
    )
    draw.line([tuple(p) for p in shot.place(path)[0]], (*colour, 230), 5, "curve")
    for past in looks[: at + (progress == 1)]:
        circle(
            draw,
            shot.place((past.direction * REACH * shot.radius + shot.centre)[None])[0][
                0
            ],
            8,
            (*colour, 255),
        )
    if progress == 1:
        corners = [
            middle,
            *(
                shot.centre + 0.62 * shot.radius * (pose[:3, 0] * x + pose[:3, 1] * y)
                for x, y in SQUARE
            ),
        ]
        flat = [tuple(p) for p in shot.place(np.array(corners))[0]]
        for a, b in zip(flat[1:], [*flat[2:], flat[1]], strict=True):
            draw.polygon([flat[0], a, b], (*colour, 26))
        draw.line([*flat[1:], flat[1]], (*colour, 150), 2)
    pasted(picture, shot, hand, middle)
    return picture


def outlined(
    picture: Image.Image,
    shot: Shot,
    vertices: Array,
    faces: Array,
    colour: Colour,
) -> None:
    """Draw the outline of a mesh, in the frame of the table, over a picture of the scene."""
    width, height = picture.size
    rays = rays_of(shot.pose, shot.focal, width, height)
    hit = Stage([(vertices, faces, (1.0, 1.0, 1.0))]).hits(shot.pose[:3, 3], rays)[0]
    shows = hit.reshape(height, width)
    line = binary_dilation(shows, iterations=3) & ~binary_erosion(shows, iterations=2)
    pixels = np.asarray(picture).copy()
    pixels[line] = colour
    picture.paste(Image.fromarray(pixels))


SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def dots(draw: ImageDraw.ImageDraw, shot: Shot, look: Look, colour: Colour) -> None:
    """The candidate views, in the colours of what they are worth; those behind the thing faint."""
    places = VIEW_LAYOUTS["40"].directions * REACH * shot.radius + shot.centre
    flat, depth = shot.place(places)
    known = look.values is not None and np.isfinite(look.values).any()
    colours = heat(look.values) if known else np.full((len(places), 3), 150)
    back = np.linalg.norm(shot.pose[:3, 3] - shot.centre)
    for k in np.argsort(-depth):
        if look.next_view is not None and places[k, 2] > 0:
            faint = 235 if depth[k] < back else 110
            circle(
                draw,
                flat[k],
                13 if k == look.next_view else 7,
                (*map(int, colours[k]), faint),
            )
            if k == look.next_view:
                circle(draw, flat[k], 15, None, (*colour, 255), 4)


def circle(
    draw: ImageDraw.ImageDraw,
    at: Array,
    r: float,
    fill: tuple | None,
    outline: tuple | None = None,
    width: int = 1,
) -> None:
    draw.ellipse((at[0] - r, at[1] - r, at[0] + r, at[1] + r), fill, outline, width)


def pasted(picture: Image.Image, shot: Shot, hand: Stage, middle: Array) -> None:
    """Draw the camera where nothing stands before it."""
    (x, y), reach = (
        shot.place(middle[None])[0][0],
        int(0.4 * shot.radius * shot.focal / np.linalg.norm(shot.pose[:3, 3] - middle)),
    )
    width, height = picture.size
    x0, x1, y0, y1 = (
        int(np.clip(v, 0, m))
        for v, m in (
            (x - reach, width),
            (x + reach, width),
            (y - reach, height),
            (y + reach, height),
        )
    )
    if x0 >= x1 or y0 >= y1:
        return
    rays = (
        rays_of(shot.pose, shot.focal, width, height)
        .reshape(height, width, 3)[y0:y1, x0:x1]
        .reshape(-1, 3)
    )
    hit, points, normals, colours = hand.hits(shot.pose[:3, 3], rays)
    light = sum(hand.lit(points, normals, colours, np.random.default_rng(0), 6))
    shine = np.maximum((normals * unit(unit(KEY) - unit(rays[hit]))).sum(1), 0) ** 30
    light += 0.25 * shine[:, None]
    eye = shot.pose[:3, 3]
    behind = np.linalg.norm(
        shot.points[y0:y1, x0:x1].reshape(-1, 3)[hit] - eye,
        axis=1,
    ) < np.linalg.norm(points - eye, axis=1)
    pixels = np.asarray(picture).copy()
    part = pixels[y0:y1, x0:x1].reshape(-1, 3)
    part[np.flatnonzero(hit)[~behind]] = toned(light)[~behind]
    pixels[y0:y1, x0:x1] = part.reshape(y1 - y0, x1 - x0, 3)
    picture.paste(Image.fromarray(pixels))


@cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    weight = "bold" if bold else "normal"
    return ImageFont.truetype(
        font_manager.findfont(
            font_manager.FontProperties("DejaVu Sans", weight=weight)
        ),
        size,
    )


def tag(
    draw: ImageDraw.ImageDraw,
    text: str,
    at: tuple[int, int],
    colour: Colour,
) -> None:
    wide = draw.textlength(text, font(34, True)) / 2 + 30
    draw.rounded_rectangle(
        (at[0] - wide, at[1] - 30, at[0] + wide, at[1] + 30),
        30,
        (*colour, 240),
    )
    draw.text(at, text, (255, 255, 255), font(34, True), anchor="mm")
