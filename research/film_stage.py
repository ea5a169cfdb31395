"""Light and shadow for a film: things on a table under a lamp and a sky, cast by Embree without a graphics card."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from nextview.geometry.viewsphere import look_at_origin

Array = np.ndarray
KEY, SUN, SKY = np.array([-0.62, -0.30, 0.72]), np.array([1.30, 1.22, 1.08]), np.array([0.46, 0.50, 0.56])
"""Where the lamp is, how bright it is and the sky: red, green, blue."""
SAMPLES = 12
"""Rays to the lamp and to the sky from each point of a still."""


class Stage:
    """Things in the light of a lamp and a sky: Embree casts what is seen, the shadows and the sky's share."""

    def __init__(self, things: list[tuple[Array, Array, tuple]]) -> None:
        self.scene, self.things = EmbreeScene(), []
        for vertices, faces, colour in things:
            TriangleMesh(self.scene, vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32))
            normals = np.zeros_like(vertices)
            of_faces = np.cross(*(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2)))
            for i in range(3):
                np.add.at(normals, faces[:, i], of_faces)
            self.things.append((faces, normals, np.array(colour)))

    def blocked(self, points: Array, rays: Array) -> Array:
        points, rays = np.broadcast_arrays(points, rays)
        shape = rays.shape[:-1]
        flat = [np.ascontiguousarray(x.reshape(-1, 3), np.float32) for x in (points, rays)]
        return (self.scene.run(*flat) >= 0).reshape(shape)

    def hits(self, eye: Array, rays: Array) -> tuple[Array, Array, Array, Array]:
        """Which rays (N, 3) hit, and of these points, normals and colours."""
        origins = np.broadcast_to(eye, rays.shape)
        found = self.scene.run(*(np.ascontiguousarray(x, np.float32) for x in (origins, rays)), output=1)
        hit = found["primID"] >= 0
        points = eye + rays[hit] * found["tfar"][hit, None]
        normals, colours = np.zeros_like(points), np.zeros_like(points)
        u, v = found["u"][hit, None], found["v"][hit, None]
        for k, (faces, of_vertices, colour) in enumerate(self.things):
            own = found["geomID"][hit] == k
            corner = of_vertices[faces[found["primID"][hit][own]]]
            normals[own] = (1 - u - v)[own] * corner[:, 0] + u[own] * corner[:, 1] + v[own] * corner[:, 2]
            colours[own] = colour
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
        normals *= np.where((normals * rays[hit]).sum(1, keepdims=True) > 0, -1, 1)
        return hit, points, normals, colours

    def lit(
        self, points: Array, normals: Array, colours: Array, rng: np.random.Generator, samples: int
    ) -> tuple[Array, Array]:
        """The light of the sky, and of the lamp, that comes from each point."""
        start, sky, lamp = points + 1e-4 * normals, np.zeros(len(points)), np.zeros(len(points))
        for k in range(samples):
            turn = 2 * np.pi * (k / samples + rng.random((len(points), 1)))
            height = 1 - 2 * ((k + rng.random((len(points), 1))) / samples)
            ball = np.hstack([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height])
            up = normals + 0.999 * ball
            sky += (
                np.where(self.blocked(start, up), 0.22, 0.75 + 0.25 * up[:, 2] / np.linalg.norm(up, axis=1)) / samples
            )
            lamp += ~self.blocked(start, KEY + 0.11 * ball) / samples
        facing = np.maximum(normals @ KEY / np.linalg.norm(KEY), 0)
        return colours * SKY * sky[:, None], colours * SUN * (lamp * facing)[:, None]


def toned(light: Array) -> Array:
    """Light as sRGB, uint8: filmic (Narkowicz's fit of ACES)."""
    x = 0.82 * light
    x = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return (255 * np.where(x < 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) + 0.5).astype(np.uint8)


@dataclass(frozen=True)
class Shot:
    """A still of one thing, and what is needed to draw on it: light of sky and lamp, points, and the camera."""

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
        return inside[:, :2] / inside[:, 2:] * self.focal + [width / 2, height / 2], inside[:, 2]


def rays_of(pose: Array, focal: float, width: int, height: int) -> Array:
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T


def wood(points: Array) -> Array:
    """How light the table's boards are, beside their mean."""
    board, along = np.floor(points[:, 1] / 0.16), points[:, 0] + 0.37 * np.floor(points[:, 1] / 0.16)
    across = points[:, 1] + 0.006 * np.sin(9 * along + 2 * board) + 0.003 * np.sin(23 * along)
    fine = np.sin(900 * across) + np.sin(1490 * across + 3 * along) + np.sin(370 * across + 1.3 * along)
    joint = 1 - 0.35 * np.exp(-(((0.5 - np.abs(points[:, 1] / 0.16 % 1 - 0.5)) / 0.006) ** 2))
    return (1 + 0.014 * fine + 0.05 * np.sin(2.4 * board + 1)) * joint


def shot(stage: Stage, r: float, centre: Array, size: tuple[int, int]) -> Shot:
    """A still of a thing of radius ``r`` from before the table."""
    (width, height), rng = size, np.random.default_rng(0)
    pose, focal = look_at_origin(np.radians(23), np.radians(-63), 13 * r), width / 2 / (2.6 / 13)
    pose[:3, 3] += centre + [0, 0, 0.5 * r]
    rays = rays_of(pose, focal, width, height)
    hit, points, normals, colours = stage.hits(pose[:3, 3], rays)
    sky, lamp, where = np.tile(SKY * 0.9, (len(rays), 1)), np.zeros_like(rays), np.full_like(rays, np.inf)
    light = stage.lit(points, normals, colours, rng, SAMPLES)
    grain = np.where(points[:, 2:] < 1e-4, wood(points)[:, None], 1)
    light = [x * grain for x in light]
    far = (
        np.clip(np.linalg.norm(points - centre, axis=1) / 2.2 - 0.25, 0, 1)[:, None] ** 2
    )  # into the background's haze
    sky[hit], lamp[hit] = light[0] * (1 - far) + 1.15 * SKY * far, light[1] * (1 - far)
    where[hit] = points
    return Shot(*(x.reshape(height, width, 3) for x in (sky, lamp, where)), pose, focal, centre, r)


def unit(x: Array) -> Array:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)
