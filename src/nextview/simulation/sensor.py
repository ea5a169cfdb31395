"""Models of depth sensors: strengths of their errors, including those of the setup.

The module also contains known sensors, and a random mix.
"""

from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.special import ndtr

from nextview.checks import number, whole
from nextview.errors import UsageError
from nextview.geometry.camera import pinhole
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.viewsphere import CAMERA_DISTANCE
from nextview.sensing.frame import Part, within
from nextview.types import Float, Float32, Floats, Index, Mask

# relative step of q between pixels of two surfaces, in addition to the slope of the surface
DEPTH_EDGE = 0.02
# noise models, which diverge towards 90 degrees, are limited to this angle
STEEPEST_INCIDENCE = np.radians(80.0)
# pixels: grain without correlation; narrowest shadow
NO_GRAIN = 0.1
NARROWEST = 1.0
# largest distance of neighbouring pixels of one surface in projector columns
WIDEST_STEP = 8
# corners are bent by at most this share of the depth
MOST_BENT = 0.01
# metres: period of the distance error of a time-of-flight camera, a quarter of its unambiguous
# range at 80 MHz
WIGGLE_LENGTH = 0.47
# limits of settings, sides of images, grain and strength
LARGEST_SETTING = 10_000
SIDE = 4096
GRAIN = 100
STRONGEST = 100
SENSOR_MARGIN = 16  # largest displacement of a surface in the image, pixels
SENSOR_CLEARANCE = 0.25  # metres between the camera and an object of known size
FRAMED = (
    1.1  # camera distance relative to that at which an object just fits into the image
)
MOST_RADII = 40.0  # largest camera distance, object radii
ARM_LENGTH = 0.45  # usual largest camera distance from the object's centre, metres


@dataclass(frozen=True)
class Sensor:
    """A depth sensor with its setup. By default it has no errors.

    The simulated object has a radius of ``radius`` metres and is ``distance`` metres away.
    ``scaled`` multiplies all error strengths, which are all attributes after ``radius``. Deviations
    are standard deviations; those of the setup are drawn for each axis. Invalid values raise
    UsageError.

    Attributes:
        name: of the sensor.
        height: rows of its images.
        width: columns.
        focal: pixels, for both axes; the principal point is in the centre.
        baseline: between the camera and its projector, or its second camera, along x, metres.
        grain: correlation length of errors, pixels: the correlation at a distance k is exp(-k^2 /
            (4 grain^2)).
        nearest: least measured depth, metres.
        farthest: greatest measured depth.
        distance: of the camera from the object's centre, metres.
        radius: of the object, metres.
        axial: depth noise relative to that of a Kinect: see ``kinect_axial``.
        noise: constant depth noise, metres.
        disparity: noise of the disparity, pixels; the depth noise is z^2 / (focal baseline) times
            as much.
        step: quantisation of the disparity, pixels.
        lateral: noise of edge positions relative to that of a Kinect: see ``kinect_lateral``.
        grazing: cosine of the angle of incidence below which pixels are lost, with a probability
            that grows up to 90 degrees.
        flying: share of the pixels at edges that are measured between the two surfaces.
        shadow: pixels occluded from a point at this distance beside the camera, along x, are not
            measured, metres.
        bent: standard deviation of the window over which surfaces that meet in a corner are
            averaged, pixels; planes are unchanged.
        wiggle: amplitude of a depth error that is periodic in the depth, metres.
        holes: share of the pixels without depth.
        turned: rotation error of the camera, degrees, drawn for every view.
        moved: position error of the camera, metres, drawn for every view.
        centre: error of the object's centre, object radii.
        size: relative error of the object's radius.
        tilt: error of the vertical, degrees.
        table: share of the table around the object that is segmented as object.
        crop: largest share of the object's width, or height, outside the image.
        boxes: average number of boxes around the object: see ``boxes_around``.
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
    bent: float = 0.0
    wiggle: float = 0.0
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
        for name in (field.name for field in fields(self) if field.name != "name"):
            what = f"sensor {self.name}: {name}"
            value = getattr(self, name)
            if name in ("height", "width"):
                whole(value, what, 1, SIDE)
            else:
                number(value, what, 0, GRAIN if name == "grain" else LARGEST_SETTING)

        if not min(self.focal, self.baseline, self.farthest, self.radius) > 0:
            raise UsageError(
                f"sensor {self.name}: focal length, baseline, range and radius are positive"
            )
        if not self.distance > self.radius:
            raise UsageError(
                f"sensor {self.name}: at {self.distance} m it stands inside an object of"
                f" {self.radius} m"
            )

    def scaled(self, strength: float) -> "Sensor":
        """Return the sensor with all errors multiplied by a factor from 0 to STRONGEST."""
        number(strength, "the strength of a sensor", 0, STRONGEST)
        name = self.name if strength == 1 else f"{self.name}:{strength:g}"
        return replace(
            self,
            name=name,
            **{error: getattr(self, error) * strength for error in ERRORS},
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of its images, pixels."""
        return self.height, self.width

    @property
    def intrinsics(self) -> Float:
        """Pinhole matrix, (3, 3) float64, pixels; the first pixel's centre is at 0.5."""
        return PinholeCamera.centred(self.focal, self.shape).matrix

    def to_dict(self) -> dict[str, Any]:
        """Return its name and all settings, for JSON."""
        return asdict(self)

    def before(self, radius: float) -> "Sensor":
        """Return the sensor in front of an object of known size, as a robot would place it.

        The distance in object radii is unchanged, but limited to ARM_LENGTH. It is increased if the
        object does not fit into the image, is nearer than the sensor can measure, or is closer than
        SENSOR_CLEARANCE. Objects smaller than a few millimetres are not measured.

        Args:
            radius: of the object, metres.
        """
        usual = min(self.distance / self.radius * radius, ARM_LENGTH)
        half_picture = np.arctan(min(self.shape) / 2 / self.focal)
        whole_object = FRAMED * radius / np.sin(half_picture)
        clear = radius + max(SENSOR_CLEARANCE, self.nearest)
        distance = min(max(usual, whole_object, clear), MOST_RADII * radius)
        return replace(self, radius=radius, distance=float(distance))

    def draw(self, rng: np.random.Generator) -> "Sensor":
        """Return the sensor itself; a ``SensorMix`` draws one for every object."""
        return self

    def measure(
        self,
        depth: Float32,
        rng: np.random.Generator,
    ) -> tuple[Float32, Index]:
        """Simulate the measurement of a true depth image.

        An error of strength 0 leaves the image bitwise unchanged. Each error has its own random
        generator.

        Args:
            depth: true depth, (height, width) float32, metres; 0 for no surface.
            rng: source of all random numbers.

        Returns:
            Depth, (height, width) float32, 0 without valid depth; and the pixel whose surface is
            measured in each pixel, itself or a neighbour, as row * width + column, int64, or -1 for
            a flying pixel.
        """
        measured = depth.copy()
        sources = np.arange(depth.size).reshape(depth.shape)
        part = within(depth, SENSOR_MARGIN)
        depth = depth[part]
        source = sources[part]
        if not depth.size:
            return measured, sources

        intrinsics = self.intrinsics - [
            [0, 0, part[1].start],
            [0, 0, part[0].start],
            [0, 0, 0],
        ]
        axial, lateral, grazing, flying, holes = rng.spawn(5)
        q = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
        slope = slopes(q)
        angle = incidence(q, slope, intrinsics)
        lost = (depth < self.nearest) | (depth > self.farthest)
        if self.shadow:
            lost |= in_shadow(q, self.focal, self.shadow)
        if self.grazing:
            share = normal_field(grazing, q.shape, self.grain)
            cosine = np.cos(angle)
            # the probability is 0 for all other pixels
            steep = cosine < self.grazing
            lost[steep] |= cosine[steep] < self.grazing * ndtr(share[steep])
        changed = q
        if self.bent:
            changed = with_bent_corners(q, self.bent)
        if self.wiggle:
            turn = 2 * np.pi / WIGGLE_LENGTH * depth
            changed = changed / (1 + self.wiggle * np.sin(turn) * q)
        if self.flying:
            at = flying.random(q.shape)
            to = flying.random(q.shape)
            other = across_edges(q, slope)
            flies = (at < self.flying) & (other != q)
            changed = np.where(flies, q + to * (other - q), changed)
            source = np.where(flies, -1, source)
        if self.lateral:
            reach = self.lateral * kinect_lateral(angle)
            right, down = (
                np.rint(reach * normal_field(lateral, q.shape, self.grain)).astype(int)
                for _ in "xy"
            )
            changed, near = shifted(changed, slope, right, down)
            source = source.take(near)
            lost = lost.take(near)
        if self.axial or self.noise or self.disparity:
            changed = self._noisy(changed, angle, axial)
        if self.step:
            unit = self.step / (self.focal * self.baseline)
            changed = np.rint(changed / unit) * unit
        if self.holes:
            lost |= uniform_field(holes, q.shape, self.grain) < self.holes
        sources[part] = source
        if changed is q:
            measured[part] = np.where(lost, np.float32(0), depth)
        else:
            found = changed > 1 / self.farthest
            made = np.where(found, 1 / np.where(found, changed, 1), 0)
            measured[part] = np.where(lost | (made < self.nearest), 0, made)

        return measured, sources

    def _noisy(self, q: Float, angle: Float, rng: np.random.Generator) -> Float:
        """Return inverse depth with the noise of depth and of disparity."""
        z = np.where(q > 0, 1 / np.where(q > 0, q, 1), 1.0)
        along = (self.axial * kinect_axial(z, angle)) ** 2 + self.noise**2
        # The published models include quantisation noise, which is subtracted here.
        steps = (self.disparity**2 - self.step**2 / 12) / (
            self.focal * self.baseline
        ) ** 2
        sigma = np.sqrt(np.maximum(along / z**4 + steps, 0))
        return np.where(q > 0, q + sigma * normal_field(rng, q.shape, self.grain), 0)


# the error strengths, from axial on
ERRORS = tuple(field.name for field in fields(Sensor))[10:]

_SETUP: dict[str, Any] = {
    "turned": 0.3,
    "moved": 0.003,
    "centre": 0.05,
    "size": 0.05,
    "tilt": 2.0,
    "table": 0.05,
    "crop": 0.1,
}
_KINECT = Sensor(
    "kinect",
    grain=2.0,
    nearest=0.4,
    farthest=8.0,
    axial=1.0,
    step=1 / 8,
    lateral=1.0,
    grazing=0.25,
    flying=0.2,
    shadow=0.075,
    holes=0.01,
)
_STEREO = Sensor(
    "stereo",
    height=480,
    width=848,
    focal=424.0,
    baseline=0.05,
    grain=2.5,
    nearest=0.2,
    farthest=10.0,
    disparity=0.08,
    step=1 / 32,
    lateral=1.5,
    grazing=0.3,
    flying=0.3,
    shadow=0.05,
    holes=0.03,
)
_TOF = Sensor(
    "tof",
    height=576,
    width=640,
    focal=504.0,
    grain=0.5,
    nearest=0.5,
    farthest=3.86,
    axial=0.5,
    lateral=0.5,
    grazing=0.1,
    flying=0.6,
    bent=2.5,
    wiggle=0.003,
    holes=0.01,
)
_SCANNER = Sensor(
    "scanner",
    height=600,
    width=972,
    focal=902.0,
    baseline=0.11,
    grain=1.0,
    nearest=0.3,
    farthest=1.3,
    disparity=0.011,
    lateral=0.3,
    grazing=0.3,
    flying=0.02,
    shadow=0.11,
    holes=0.02,
)
_ALL = (
    Sensor(),
    _KINECT,
    _STEREO,
    _TOF,
    _SCANNER,
    Sensor("setup", **_SETUP),
    replace(_STEREO, name="wrist", **_SETUP),
)
SENSORS = {sensor.name: sensor for sensor in _ALL}
"""Sensors by name: "none" has no errors; "kinect" is the first Kinect; "stereo" is like a RealSense
D435 of 848 x 480; "tof" is like an Azure Kinect, which measures the time of flight; "scanner" is
like a Zivid 2, which projects stripes; "setup" has only errors of pose, object frame, table and
image; "wrist" is "stereo" in such a setup."""

_SIDE = 224
_RADIUS = SENSORS["none"].radius
_FOCAL = float(pinhole(_SIDE, CAMERA_DISTANCE)[0, 0])
# virtual camera of the networks
RENDER = Sensor(
    "render",
    _SIDE,
    _SIDE,
    _FOCAL,
    distance=CAMERA_DISTANCE * _RADIUS,
    radius=_RADIUS,
)


@dataclass(frozen=True)
class SensorMix:
    """Random sensors, from no errors to twice those of the known ones, in any setup.

    Half of the draws resemble renders, some with noise up to 0.02 object radii or with up to a
    quarter of the pixels missing. The others are a Kinect or a stereo camera.

    Attributes:
        strength: factor of every error.
    """

    strength: float = 1.0

    def __post_init__(self) -> None:
        SENSORS["none"].scaled(self.strength)  # raises an error for an invalid strength

    @property
    def name(self) -> str:
        """Name and, if it is not 1, strength."""
        return "mix" if self.strength == 1 else f"mix:{self.strength:g}"

    def draw(self, rng: np.random.Generator) -> Sensor:
        """Draw a sensor in a setup, for one object."""
        kind = rng.choice(["render", "kinect", "stereo"], p=[0.5, 0.2, 0.3])
        if kind == "render":
            errors = {
                "noise": (0.6, 0.02 * _RADIUS),
                "holes": (0.4, 0.25),
                "grain": (0.3, 2.0),
            }
            sensor = replace(RENDER, **_some(rng, errors))
        else:
            sensor = SENSORS[str(kind)].scaled(float(rng.uniform(0, 2)))

        setup = {
            "tilt": (0.5, 12.0),
            "centre": (0.5, 0.1),
            "size": (0.5, 0.15),
            "crop": (0.4, 0.4),
            "boxes": (0.5, 12.0),
            "table": (0.2, 0.1),
            "turned": (0.3, 0.5),
            "moved": (0.3, 0.005),
        }
        return replace(sensor, **_some(rng, setup)).scaled(self.strength)

    def to_dict(self) -> dict[str, Any]:
        """Return its name and its strength, for JSON."""
        return {"name": self.name, **asdict(self)}


def _some(
    rng: np.random.Generator,
    errors: dict[str, tuple[float, float]],
) -> dict[str, Any]:
    """Draw the strengths of some errors, each with its probability and its largest strength."""
    there, share = rng.random((2, len(errors)))
    chance, most = np.array(list(errors.values())).T
    return dict(zip(errors, (share * most * (there < chance)).tolist(), strict=True))


def sensor_named(text: str | Sensor | SensorMix) -> Sensor | SensorMix:
    """Return a sensor by NAME or NAME:STRENGTH; "mix" is another one for every object."""
    if isinstance(text, Sensor | SensorMix):
        return text
    name, given, strength = str(text).partition(":")
    if name not in (*SENSORS, "mix"):
        raise UsageError(
            f"no sensor is called {name!r}; there are {', '.join(SENSORS)} and mix"
        )
    try:
        times = float(strength) if given else 1.0
    except ValueError:
        raise UsageError(
            f"{text}: a sensor is NAME or NAME:STRENGTH, a number of at least 0"
        ) from None
    return SensorMix(times) if name == "mix" else SENSORS[name].scaled(times)


# Components of the errors, on inverse depth q = 1/z, (H, W), which is linear on a plane


def slopes(q: Float) -> tuple[Float, Float]:
    """Return the change per pixel along x and y, on the side where it is smaller.

    It is 0 for an isolated pixel.
    """
    return _slope(q), _slope(q.T).T


def _slope(q: Float) -> Float:
    here = q > 0
    nothing = np.full((len(q), 1), np.inf)
    difference = np.where(here[:, 1:] & here[:, :-1], q[:, 1:] - q[:, :-1], np.inf)
    forth = np.hstack([difference, nothing])
    back = np.hstack([nothing, difference])
    smaller = np.where(np.abs(back) < np.abs(forth), back, forth)
    return np.where(np.isfinite(smaller), smaller, 0.0)


def shifted(
    q: Float,
    slope: tuple[Float, Float],
    right: Index,
    down: Index,
) -> tuple[Float, Index]:
    """Replace the surface in each pixel by that of a neighbour.

    The depth is that at which the pixel's own ray meets the surface: edges move, and planes are
    unchanged.

    Args:
        q: inverse depth, (H, W).
        slope: its change per column and per row, (H, W) each.
        right: columns to the neighbour, (H, W).
        down: rows to the neighbour, (H, W).

    Returns:
        Inverse depth, (H, W), and the neighbour as row * width + column.
    """
    row = np.arange(len(q))[:, None]
    column = np.arange(q.shape[1])
    at_row = np.clip(row + down, 0, len(q) - 1)
    at_column = np.clip(column + right, 0, q.shape[1] - 1)
    # flat indices are twice as fast in NumPy
    at = at_row * q.shape[1] + at_column
    there = q.take(at)
    moved = (
        there
        - slope[0].take(at) * (at_column - column)
        - slope[1].take(at) * (at_row - row)
    )
    # surfaces seen edge-on have unreliable slopes
    moved = np.where(np.abs(moved - there) < 0.1 * there, moved, there)
    return np.where(there > 0, moved, 0), at


def incidence(q: Float, slope: tuple[Float, Float], intrinsics: Float) -> Float:
    """Return the angle between each pixel's ray and the surface normal.

    Args:
        q: inverse depth, (H, W).
        slope: its change per column and per row, (H, W) each.
        intrinsics: pinhole matrix, (3, 3), pixels.

    Returns:
        Angles, (H, W), radians; 0 for empty pixels.
    """
    camera = PinholeCamera.of(intrinsics, q.shape)
    x, y = camera.image_slopes
    y = y[:, None]
    # n = (a, b, c) with n . (x, y, 1) = q
    a = slope[0] * camera.fx
    b = slope[1] * camera.fy
    c = q - a * x - b * y
    length = np.sqrt((a * a + b * b + c * c) * (x * x + y * y + 1))
    return np.where(
        q > 0,
        np.arccos(np.clip(q / np.where(length > 0, length, 1), 0, 1)),
        0.0,
    )


def across_edges(q: Float, slope: tuple[Float, Float]) -> Float:
    """Return the inverse depth on the other side of the largest step to a neighbour.

    Args:
        q: inverse depth, (H, W).
        slope: its change per column and per row, (H, W) each.

    Returns:
        Inverse depth, (H, W); that of the pixel itself if there is no step.
    """
    padded = np.pad(q, 1)
    other = q.copy()
    highest = DEPTH_EDGE * q
    height, width = q.shape
    for dy, dx in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        beside = padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        step = np.abs(beside - q - slope[0] * dx - slope[1] * dy)
        over = (step > highest) & (beside > 0) & (q > 0)
        other[over] = beside[over]
        highest[over] = step[over]
    return other


def with_bent_corners(q: Float, width: float) -> Float:
    """Average surfaces over their corners, as light that is reflected twice does.

    Args:
        q: inverse depth, (H, W).
        width: standard deviation of the Gaussian window, pixels.

    Returns:
        Inverse depth, (H, W), changed by at most MOST_BENT of it.
    """
    seen = gaussian_filter((q > 0).astype(float), width)
    smooth = gaussian_filter(q, width) / np.maximum(seen, 1e-6)
    return q + np.clip(smooth - q, -MOST_BENT * q, MOST_BENT * q)


def in_shadow(q: Float, focal: float, baseline: float) -> Mask:
    """Return the pixels that a projector does not illuminate because of an occluder.

    The pixel in column u is illuminated by the projector column u - focal * baseline * q, which
    reaches the nearest surface.

    Args:
        q: inverse depth, (H, W).
        focal: focal length, pixels.
        baseline: of the projector along x, metres.

    Returns:
        Whether each pixel is in shadow, (H, W) bool.
    """
    height, width = q.shape
    disparity = focal * baseline * q
    column = np.arange(width) - disparity
    offset = int(np.ceil(abs(disparity).max(initial=0.0))) + 1
    # the largest disparity in each column of the projector
    lit = np.zeros((height, width + 2 * offset + 2))
    first_in_row = np.arange(height)[:, None] * lit.shape[1] + offset
    seen = q > 0
    # A surface covers all projector columns between neighbouring pixels.
    along = _slope(q)
    joined = np.zeros(q.shape, bool)
    bend = np.abs(q[:, 1:] - q[:, :-1] - along[:, :-1])
    joined[:, :-1] = seen[:, :-1] & seen[:, 1:] & (bend <= DEPTH_EDGE * q[:, :-1])
    last = np.where(joined, np.roll(column, -1, 1), column)
    # Flat indices are twice as fast in NumPy.
    first_index, last_index = (
        first_in_row + np.rint(at).astype(int) for at in (column, last)
    )
    flat = lit.reshape(-1)
    at = first_index[seen]
    end = last_index[seen]
    value = disparity[seen]
    for _ in range(WIDEST_STEP):
        np.maximum.at(flat, at, value)
        wider = at + 1 < end
        at = at[wider] + 1
        end = end[wider]
        value = value[wider]
    narrow = NARROWEST + focal * abs(baseline) * np.abs(along)
    return seen & (flat[np.where(seen, first_index, 0)] > disparity + narrow)


def kinect_axial(depth: Floats, angle: Floats) -> Float:
    """Return the standard deviation of the depth of a Kinect (v1), metres.

    0.0012 + 0.0019 (z - 0.4)^2 + 0.0001 / sqrt(z) (angle / (pi/2 - angle))^2, from Nguyen, Izadi
    and Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT
    2012.

    Args:
        depth: along the optical axis, metres.
        angle: of incidence, radians.

    Returns:
        Standard deviation along the optical axis, metres.
    """
    angle = np.minimum(angle, STEEPEST_INCIDENCE)
    return (
        0.0012
        + 0.0019 * (depth - 0.4) ** 2
        + 0.0001 / np.sqrt(depth) * (angle / (np.pi / 2 - angle)) ** 2
    )


def kinect_lateral(angle: Floats) -> Float:
    """Return the standard deviation of edge positions in a Kinect (v1), pixels; same source."""
    angle = np.minimum(angle, STEEPEST_INCIDENCE)
    return 0.8 + 0.035 * angle / (np.pi / 2 - angle)


def normal_field(
    rng: np.random.Generator,
    shape: tuple[int, int],
    grain: float,
    part: Part | None = None,
) -> Float:
    """Draw white noise of variance 1 under a Gaussian window.

    Args:
        rng: source of all random numbers.
        shape: rows and columns of the whole field.
        grain: width of the window, pixels.
        part: rows and columns to return; None for all.

    Returns:
        The field, or its part.
    """
    white = rng.standard_normal(shape)
    part = part or (slice(0, shape[0]), slice(0, shape[1]))
    if grain < NO_GRAIN:
        return white[part]

    far = int(4 * grain + 0.5) + 1  # radius of the window
    inside = all(
        s.start >= far and s.stop + far <= side
        for s, side in zip(part, shape, strict=True)
    )
    if inside:
        rows, columns = (slice(s.start - far, s.stop + far) for s in part)
        window = white[rows, columns]
        filtered = gaussian_filter(window, grain)[far:-far, far:-far]
    else:
        filtered = gaussian_filter(white, grain, mode="wrap")[part]

    return np.asarray(filtered) / _power(grain)


@lru_cache(maxsize=16)
def _power(grain: float) -> float:
    """Return the standard deviation of white noise of variance 1 under a Gaussian window."""
    impulse = np.zeros(8 * int(np.ceil(grain)) + 17)
    impulse[len(impulse) // 2] = 1
    return float((gaussian_filter1d(impulse, grain) ** 2).sum())


def uniform_field(
    rng: np.random.Generator,
    shape: tuple[int, int],
    grain: float,
    part: Part | None = None,
) -> Float:
    """Draw numbers between 0 and 1 with correlated neighbours, as in ``normal_field``.

    Args:
        rng: source of all random numbers.
        shape: rows and columns of the whole field.
        grain: correlation length, pixels.
        part: rows and columns to return; None for all.

    Returns:
        The field, or its part.
    """
    if grain == 0:
        return rng.random(shape)[part or ...]
    return np.asarray(ndtr(normal_field(rng, shape, grain, part)))
