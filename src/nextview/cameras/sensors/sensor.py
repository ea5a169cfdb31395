"""A depth sensor as numbers: how strong each of its errors is, and those of the setup around it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import number, of_kind, whole
from nextview.cameras.sensors.depth_noise import kinect_axial, kinect_lateral, normal_field, uniform_field
from nextview.cameras.sensors.projector_shadow import in_shadow
from nextview.cameras.sensors.surface_angle import across_edges, incidence, inverse_depth, slopes
from nextview.errors import UsageError

STRONGEST = 100
"""How many times as strong errors can be made: of what is left at 10 nothing can be made."""
LIMITS = {
    "height": (1, 4096),
    "width": (1, 4096),
    "focal": (1, 100_000),
    "baseline": (0.0001, 100),
    "grain": (0, 100),
    "nearest": (0, 1000),
    "farthest": (0.001, 1000),
    "distance": (0.001, 1000),
    "radius": (0.001, 1000),
}
LARGEST = 10_000
"""Of all other numbers, the errors: what is beyond is no sensor, and takes memory or time without end."""
MARGIN = 16
"""How far beside what there is a pixel may show it, pixels."""


@dataclass(frozen=True)
class Sensor:
    """A depth sensor, and the setup that it stands in. Without arguments it has no errors.

    The simulated object is ``radius`` metres large and ``distance`` metres away. ``scaled`` multiplies every strength,
    that is all but what the sensor is (height to radius).

    Attributes:
        name: what it is called.
        height: rows of its pictures.
        width: columns.
        focal: focal length, pixels, for both axes; the principal point is in the middle.
        baseline: between the camera and its projector, or its second camera, along x, metres.
        grain: how far pixels err together, pixels: the correlation at a distance k is exp(-k^2 / (4 grain^2)).
        nearest: least depth that it can measure, metres.
        farthest: greatest one.
        distance: of the camera from the object's centre, metres.
        radius: object radius, metres.
        axial: error of depth, in those of a Kinect: see ``kinect_axial``.
        noise: standard deviation of the depth, metres, the same everywhere.
        disparity: standard deviation of the disparity, pixels: of the depth, z^2 / (focal baseline) times as much.
        step: of the disparity, which is measured in whole steps, pixels.
        lateral: error of where edges are seen, in those of a Kinect: see ``kinect_lateral``.
        grazing: cosine of the angle of incidence below which pixels are lost, ever more until all are at 90 degrees.
        flying: share of the pixels at edges that hang in the air between the two surfaces.
        shadow: what is hidden from a point so many metres beside the camera, along x, is not measured.
        holes: share of the pixels without depth.
        turned: standard deviation of the error of the camera's pose, about each axis, degrees, anew in every view.
        moved: the same of its place, along each axis, metres.
        centre: standard deviation of the error of the object's centre, along each axis, object radii.
        size: standard deviation of the relative error of the object's radius.
        tilt: standard deviation of the error of the vertical, about both horizontal axes, degrees.
        table: share of the table around the object that is taken for the object.
        crop: up to this share of the object's width, or height, lies outside of the picture.
        boxes: so many boxes stand around the object on average and hide parts of it; see ``boxes_around``.

    Raises:
        UsageError: numbers that no sensor has.
    """

    name: str = "none"
    height: int = 480
    width: int = 640
    focal: float = 585.0
    baseline: float = 0.075
    grain: float = 0.0
    nearest: float = 0.0
    farthest: float = 60.0
    distance: float = 0.6
    radius: float = 0.12

    axial: float = 0.0
    noise: float = 0.0
    disparity: float = 0.0
    step: float = 0.0
    lateral: float = 0.0
    grazing: float = 0.0
    flying: float = 0.0
    shadow: float = 0.0
    holes: float = 0.0

    turned: float = 0.0
    moved: float = 0.0
    centre: float = 0.0
    size: float = 0.0
    tilt: float = 0.0
    table: float = 0.0
    crop: float = 0.0
    boxes: float = 0.0

    def __post_init__(self) -> None:
        of_kind(self.name, str, "the name of a sensor is a text")
        for name in (field.name for field in fields(self) if field.name != "name"):
            what, (least, most) = f"sensor {self.name}: {name}", LIMITS.get(name, (0, LARGEST))
            if name in ("height", "width"):
                whole(getattr(self, name), what, int(least), int(most))
            elif not least <= number(getattr(self, name), what) <= most:
                raise UsageError(f"{what} is a number from {least} to {most}, not {getattr(self, name)}")
        if not self.distance > self.radius:
            raise UsageError(f"sensor {self.name}: at {self.distance} m it stands inside an object of {self.radius} m")

    def scaled(self, strength: float) -> Sensor:
        """The same sensor with all errors so many times as strong; 0 for none.

        Raises:
            UsageError: a strength that is negative, or more than STRONGEST.
        """
        if not 0 <= number(strength, "the strength of a sensor") <= STRONGEST:
            raise UsageError(f"the strength of a sensor is a number from 0 to {STRONGEST}, not {strength}")
        name = self.name if strength == 1 else f"{self.name}:{strength:g}"
        return replace(self, name=name, **{error: getattr(self, error) * strength for error in ERRORS})

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of its pictures, pixels."""
        return self.height, self.width

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Pinhole matrix, (3, 3) float64, pixels; the first pixel's centre is at 0.5."""
        return np.array([[self.focal, 0, self.width / 2], [0, self.focal, self.height / 2], [0, 0, 1.0]])

    def to_dict(self) -> dict[str, Any]:
        """Its name and all its numbers, for JSON."""
        return asdict(self)

    def noise_of_inverse(self, depth: NDArray[np.floating], angle: NDArray[np.floating]) -> NDArray[np.float64]:
        """Standard deviation of inverse depth before it is measured in steps, 1/metres.

        The published laws were measured on what came out, in steps already: theirs is taken off.

        Args:
            depth: metres, positive.
            angle: between the surface's normal and the line of sight, radians; the same shape.
        """
        along = (self.axial * kinect_axial(depth, angle)) ** 2 + self.noise**2
        steps = (self.disparity**2 - self.step**2 / 12) / (self.focal * self.baseline) ** 2
        return np.asarray(np.sqrt(np.maximum(along / depth**4 + steps, 0)))

    def measure(
        self, depth: NDArray[np.float32], rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """What the sensor makes of a true depth image. Errors of strength 0 change nothing, to the bit.

        Each error draws from a generator of its own, so that changing one strength changes no other error.

        Args:
            depth: (height, width) float32, metres, 0 where there is nothing.
            rng: for all that is random.

        Returns:
            Depth, (height, width) float32, 0 where none was measured. And whose surface each pixel shows, its own or
            that of one nearby: row * width + column, int64, or -1 if it hangs in the air.
        """
        measured, source = depth.copy(), np.arange(depth.size).reshape(depth.shape)
        rows, columns = np.flatnonzero(depth.any(1)), np.flatnonzero(depth.any(0))
        if len(rows):  # where there is nothing there is nothing to do
            top, left = max(rows[0] - MARGIN, 0), max(columns[0] - MARGIN, 0)
            part = slice(top, rows[-1] + MARGIN + 1), slice(left, columns[-1] + MARGIN + 1)
            intrinsics = self.intrinsics - [[0, 0, left], [0, 0, top], [0, 0, 0]]
            measured[part], source[part] = self._measure(depth[part], source[part], intrinsics, rng)
        return measured, source

    def _measure(
        self,
        depth: NDArray[np.float32],
        source: NDArray[np.int64],
        intrinsics: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """The same for a part of a picture."""
        axial, lateral, grazing, flying, holes = rng.spawn(5)
        q = inverse_depth(depth)
        slope = slopes(q)
        angle = incidence(q, slope, intrinsics)
        lost = (depth < self.nearest) | (depth > self.farthest)
        if self.shadow:
            lost |= in_shadow(q, self.focal, self.shadow)
        if self.grazing:
            lost |= np.cos(angle) < self.grazing * uniform_field(grazing, q.shape, self.grain)
        changed = q
        if self.flying:
            at, to, other = flying.random(q.shape), flying.random(q.shape), across_edges(q, slope)
            flies = (at < self.flying) & (other != q)
            changed = np.where(flies, q + to * (other - q), q)
            source = np.where(flies, -1, source)
        if self.lateral:
            changed, source, lost = self._shifted(changed, source, lost, slope, angle, lateral)
        if self.axial or self.noise or self.disparity:
            sigma = self.noise_of_inverse(np.where(changed > 0, 1 / np.where(changed > 0, changed, 1), 1.0), angle)
            changed = np.where(changed > 0, changed + sigma * normal_field(axial, q.shape, self.grain), 0)
        if self.step:
            unit = self.step / (self.focal * self.baseline)
            changed = np.rint(changed / unit) * unit
        if self.holes:
            lost |= uniform_field(holes, q.shape, self.grain) < self.holes
        if changed is q:
            return np.where(lost, np.float32(0), depth), source
        found = changed > 1 / self.farthest
        made = np.where(found, 1 / np.where(found, changed, 1), 0)
        return np.where(lost | (made < self.nearest), 0, made).astype(np.float32), source

    def _shifted(
        self,
        q: NDArray[np.float64],
        source: NDArray[np.int64],
        lost: NDArray[np.bool_],
        slope: tuple[NDArray[np.float64], NDArray[np.float64]],
        angle: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
        """Each pixel shows the surface of another one nearby, at the depth where its own ray meets it.

        So edges move and planes stay: the published error along the axis holds all that noise does to them.
        """
        reach = self.lateral * kinect_lateral(angle)
        right = np.rint(reach * normal_field(rng, q.shape, self.grain)).astype(int)
        down = np.rint(reach * normal_field(rng, q.shape, self.grain)).astype(int)
        row, column = np.indices(q.shape)
        at = np.clip(row + down, 0, len(q) - 1), np.clip(column + right, 0, q.shape[1] - 1)
        right, down = at[1] - column, at[0] - row
        there = q[at]
        moved = there - slope[0][at] * right - slope[1][at] * down
        # The slope of a surface seen edge-on leads anywhere.
        moved = np.where(np.abs(moved - there) < 0.1 * there, moved, there)
        return np.where(there > 0, moved, 0), source[at], lost[at]


_NAMES = tuple(field.name for field in fields(Sensor))
ERRORS = _NAMES[_NAMES.index("axial") :]
"""The strengths: what ``Sensor.scaled`` multiplies."""
