"""Read organised point clouds in PCD files, as PCL and ROS write them, as depth images.

The format is that of PCL, version 0.7 and earlier: a header in ASCII, and the points as text
(``ascii``), one point after the other (``binary``), or one field after the other, packed by LZF
(``binary_compressed``). An organised cloud has a point for each pixel of the camera, row by row,
and NaN where nothing was measured. Points are in the optical frame of the camera; VIEWPOINT is the
camera's pose. The intrinsics are not in the file: they are fitted to the points.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.captured.camera_file import CameraFile, check_size
from nextview.captured.frames import MOST_PIXELS, CapturedFrame, LayoutViews, rigid
from nextview.checks import one_line
from nextview.errors import DAMAGED, DatasetError
from nextview.files import regular_file
from nextview.geometry.pinhole import pinhole_matrix
from nextview.types import Float, Float32

LONGEST_HEADER = 2**16  # bytes
LARGEST_CLOUD = 2**28  # bytes of a file, and of the points in it
LARGEST_POINT = 2**12  # bytes of all fields of a point
# pixels, largest distance of most points from where the fitted pinhole camera sees them
LARGEST_MISFIT = 1.0
MISFIT_PERCENTILE = 95
FEWEST_POINTS = 100
PCD_TYPES = {"F": "f", "I": "i", "U": "u"}  # numpy's kinds by the letters of a header
PCD_SIZES = {"f": (4, 8), "i": (1, 2, 4, 8), "u": (1, 2, 4, 8)}  # bytes, by kind
NOT_PCD = "is no PCD file, or its header is damaged"
ORIGIN = [
    "0",
    "0",
    "0",
    "1",
    "0",
    "0",
    "0",
]  # VIEWPOINT of a cloud whose camera is the world


@dataclass(frozen=True, eq=False)
class PcdHeader:
    """Header of a PCD file with an organised cloud.

    Attributes:
        path: of the file.
        point: fields of a point, in order, with the bytes between them.
        width: points in a row.
        height: rows.
        pose: of the camera in the world, camera-to-world, (4, 4) float64, metres.
        posed: whether the file states another pose than that of the world.
        kind: "ascii", "binary" or "binary_compressed".
        start: byte at which the points begin.
    """

    path: Path
    point: np.dtype
    width: int
    height: int
    pose: Float
    posed: bool
    kind: str
    start: int


@dataclass(frozen=True, eq=False)
class PcdDepth:
    """The depth image of an organised cloud.

    Attributes:
        header: of the file.
        intrinsics: pinhole matrix with which the points have to agree, (3, 3); None for any.
    """

    header: PcdHeader
    intrinsics: Float | None = field(default=None)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.header.width, self.header.height

    def read(self) -> Float32:
        """Read the depth, (H, W) float32, units of the cloud; 0 where nothing was measured.

        Raises:
            DatasetError: the file is damaged, or its points are those of another camera.
        """
        points = read_points(self.header)
        if self.intrinsics is not None:
            misfit = _misfit(points, self.intrinsics)
            if misfit > LARGEST_MISFIT:
                raise DatasetError(
                    f"{self}: its points are {misfit:.1f} pixels off those of the camera that was"
                    " fitted to the first cloud: is it of another camera?"
                )
        return np.where(_measured(points), points[..., 2], 0).astype(np.float32)

    def __str__(self) -> str:
        return str(self.header.path)


def is_organised(path: Path) -> bool:
    """Return True if a file has the header of an organised cloud."""
    try:
        read_pcd_header(path)
    except DatasetError:
        return False
    return True


def read_clouds(paths: Sequence[Path], given: CameraFile | None) -> LayoutViews:
    """Read organised clouds of one camera.

    Args:
        paths: of PCD files, at least one.
        given: camera of the clouds; None to fit its intrinsics to the points.

    Raises:
        DatasetError: no file holds an organised cloud of a pinhole camera, or there are several,
            and no VIEWPOINT tells where the camera was.
    """
    views = LayoutViews([], [], z_is_up=False)
    headers = []
    intrinsics = None if given is None else given.intrinsics
    for path in paths:
        try:
            header = read_pcd_header(path)
            if intrinsics is None:
                intrinsics = _fitted(header)
                fx, fy = intrinsics.diagonal()[:2]
                cx, cy = intrinsics[:2, 2]
                views.notes.append(
                    f"intrinsics fitted to {path.name}: {fx:.1f} {fy:.1f} {cx:.1f} {cy:.1f}"
                )
            headers.append(header)
        except DatasetError as error:
            views.unreadable[path.stem] = str(error)

    if len(headers) > 1 and not any(header.posed for header in headers):
        raise DatasetError(
            f"{paths[0].parent}: has {len(headers)} clouds, and VIEWPOINT is {' '.join(ORIGIN)} in"
            f" all: nothing tells where the camera was; name one of them, as {paths[-1]}"
        )
    if len(headers) == 1 and not headers[0].posed:
        views.notes.append("one cloud: its camera is the world")
    elif headers:
        views.notes.append("poses of VIEWPOINT")
    for header in headers:
        depth = PcdDepth(header, intrinsics if given is None else None)
        if given is not None:
            check_size(given, depth)
        assert intrinsics is not None
        name = header.path.stem
        views.frames.append(CapturedFrame(name, depth, 1.0, intrinsics, header.pose))
    return views


def read_pcd_header(path: Path) -> PcdHeader:
    """Read the header of an organised cloud.

    Args:
        path: of the PCD file.

    Raises:
        DatasetError: the file is no PCD file, its header is damaged or claims absurd sizes, or the
            cloud is not organised.
    """
    regular_file(path, "a PCD file", DatasetError, LARGEST_CLOUD)
    try:
        with path.open("rb") as file:
            lines, start = _header_lines(file.read(LONGEST_HEADER))
        width, height, count = (int(lines[name][0]) for name in _COUNTS)
        point = _point_type(lines)
        said = lines.get("VIEWPOINT", ORIGIN)
        place = [float(word) for word in said[:3]]
        w, x, y, z = (float(word) for word in said[3:7])
        (kind,) = lines["DATA"]
    except DAMAGED as error:
        raise DatasetError(f"{path}: {NOT_PCD} ({one_line(str(error), 100)})") from None

    if height == 1 and width > 1:
        raise DatasetError(
            f"{path}: is an unorganised cloud (HEIGHT 1): without a point for each pixel of the"
            " camera it is no depth image; save it before it is filtered"
        )
    if width < 1 or height < 1 or width * height != count:
        raise DatasetError(
            f"{path}: {NOT_PCD}: WIDTH {width} x HEIGHT {height} are not POINTS {count}"
        )
    if width * height > MOST_PIXELS:
        raise DatasetError(
            f"{path}: has {width} x {height} points, more than any depth camera"
        )
    if point.itemsize > LARGEST_POINT or count * point.itemsize > LARGEST_CLOUD:
        raise DatasetError(
            f"{path}: its points take {count * point.itemsize >> 20} MB, at most"
            f" {LARGEST_CLOUD >> 20} MB are read"
        )
    if kind not in _READERS:
        raise DatasetError(
            f"{path}: DATA is one of {', '.join(_READERS)}, not {one_line(kind)}"
        )
    pose = np.eye(4)
    if (
        not np.isfinite([*place, w, x, y, z]).all()
        or abs(w) + abs(x) + abs(y) + abs(z) < 1e-6
    ):
        raise DatasetError(f"{path}: VIEWPOINT is no pose: {one_line(' '.join(said))}")
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = place
    posed = not np.allclose(pose, np.eye(4), atol=1e-9)
    where = f"VIEWPOINT of {path}"
    return PcdHeader(path, point, width, height, rigid(pose, where), posed, kind, start)


def read_points(header: PcdHeader) -> Float:
    """Read the points of an organised cloud.

    Args:
        header: of the file.

    Returns:
        (H, W, 3) float64, units of the file; NaN or 0 where nothing was measured.

    Raises:
        DatasetError: the file is damaged.
    """
    try:
        points = _READERS[header.kind](header)
    except DAMAGED as error:
        raise DatasetError(
            f"{header.path}: its points cannot be read ({one_line(str(error), 100)})"
        ) from None
    return points.reshape(header.height, header.width, 3)


def fitted_intrinsics(points: Float) -> tuple[Float, float]:
    """Fit a pinhole camera to the points of its pixels.

    Args:
        points: in the optical frame, (H, W, 3); NaN or 0 where nothing was measured.

    Returns:
        The pinhole matrix, (3, 3) float64, pixels, first pixel's centre at 0; and how many pixels
        most points are at most off, infinity if they are no image of a camera.
    """
    measured = _measured(points)
    rows, columns = np.nonzero(measured)
    if len(rows) < FEWEST_POINTS:
        return np.eye(3), np.inf

    x, y, z = points[measured].T
    fitted = []
    for across, at in ((x / z, columns), (y / z, rows)):
        spread = across - across.mean()
        if not np.ptp(across) > 0:
            return np.eye(3), np.inf
        focal = float(spread @ (at - at.mean()) / (spread @ spread))
        fitted += [focal, float(at.mean() - focal * across.mean())]

    fx, cx, fy, cy = fitted
    intrinsics = pinhole_matrix(fx, fy, cx, cy)
    if not (np.isfinite(fitted).all() and fx > 0 and fy > 0):
        return np.eye(3), np.inf
    return intrinsics, _misfit(points, intrinsics)


def decompress_lzf(packed: bytes, size: int) -> bytes:
    """Unpack bytes that were packed by LZF.

    Args:
        packed: the packed bytes.
        size: number of bytes that they hold.

    Raises:
        ValueError: they are damaged, or hold more or fewer bytes.
    """
    out = bytearray()
    at = 0
    while at < len(packed) and len(out) <= size:
        control = packed[at]
        at += 1
        if control < 32:  # so many bytes and one as they are
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = (control >> 5) + 2
        long = length == 9  # another byte of it follows, then one of the distance
        if at + long >= len(packed):
            raise ValueError("damaged LZF data")
        if long:
            length += packed[at]
            at += 1
        begin = len(out) - ((control & 31) << 8) - packed[at] - 1
        at += 1
        if begin < 0:
            raise ValueError("damaged LZF data")
        chunk = out[begin : begin + length]
        # what is copied may overlap with the copy
        out += (chunk * (length // len(chunk) + 1))[:length]
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes where {size} are expected")
    return bytes(out)


_COUNTS = ("WIDTH", "HEIGHT", "POINTS")


def _header_lines(begin: bytes) -> tuple[dict[str, list[str]], int]:
    """Return the words of each line of a header by its first word, and where the points begin."""
    lines: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in lines:
        end = begin.find(b"\n", at)
        if end < 0:
            raise ValueError("there is no line DATA")
        words = begin[at:end].decode("ascii").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            lines[words[0]] = words[1:]

    if "FIELDS" not in lines and "COLUMNS" in lines:  # before version 0.6
        lines["FIELDS"] = lines["COLUMNS"]
    for name in ("FIELDS", *_COUNTS):
        if not lines.get(name):
            raise ValueError(f"there is no line {name}")
    missing = sorted({"x", "y", "z"} - set(lines["FIELDS"]))
    if missing:
        raise ValueError(f"its points have no {', '.join(missing)}")
    return lines, at


def _point_type(lines: dict[str, list[str]]) -> np.dtype:
    """Return the type of a point; fields without a name of their own are padding."""
    names = lines["FIELDS"]
    sizes = [int(word) for word in lines.get("SIZE", ["4"] * len(names))]
    types = lines.get("TYPE", ["F"] * len(names))
    counts = [int(word) for word in lines.get("COUNT", ["1"] * len(names))]

    fields = []
    for n, (name, size, letter, count) in enumerate(
        zip(names, sizes, types, counts, strict=True)
    ):
        kind = PCD_TYPES[letter]
        if size not in PCD_SIZES[kind] or not 1 <= count <= LARGEST_POINT:
            raise ValueError(f"field {name} of {count} times {size} bytes")
        own = name if name in ("x", "y", "z") else f"{n}"
        if own == name and count != 1:
            raise ValueError(f"{count} values of {name} in a point")
        fields.append((own, f"<{kind}{size}", (count,)))
    return np.dtype(fields)


def _ascii_points(header: PcdHeader) -> Float:
    """Return the points of a text file, (N, 3)."""
    names = header.point.names or ()
    lengths = [header.point[name].shape[0] for name in names]
    before = dict(zip(names, np.cumsum([0, *lengths]).tolist(), strict=False))
    count = header.width * header.height

    with header.path.open("rb") as file:
        file.seek(header.start)
        found = np.loadtxt(
            file,
            np.float64,
            comments=None,
            usecols=[before[name] for name in ("x", "y", "z")],
            max_rows=count,
            ndmin=2,
        )
    if len(found) != count:
        raise ValueError(f"{len(found)} points where {count} are expected")
    return found


def _binary_points(header: PcdHeader) -> Float:
    """Return the points of a file with one point after the other, (N, 3)."""
    count = header.width * header.height
    size = count * header.point.itemsize
    _check_left(header, size)
    with header.path.open("rb") as file:
        file.seek(header.start)
        content = file.read(size)
    points = np.frombuffer(content, header.point, count)
    return np.concatenate([points[name] for name in ("x", "y", "z")], 1).astype(float)


def _check_left(header: PcdHeader, size: int) -> None:
    """Check that a file has so many bytes after its header, before memory is spent on them."""
    left = header.path.stat().st_size - header.start
    if left < size:
        raise ValueError(f"{left} bytes where {size} are expected")


def _packed_points(header: PcdHeader) -> Float:
    """Return the points of a compressed file with one field after the other, (N, 3)."""
    count = header.width * header.height
    size = count * header.point.itemsize
    with header.path.open("rb") as file:
        file.seek(header.start)
        packed_size, said = struct.unpack("<II", file.read(8))
        if said != size:
            raise ValueError(f"{said} bytes where {size} are expected")
        _check_left(header, 8 + packed_size)
        packed = file.read(packed_size)

    content = decompress_lzf(packed, size)
    assert header.point.fields is not None
    found = []
    for name in ("x", "y", "z"):
        kind, offset = header.point.fields[name][:2]
        found.append(np.frombuffer(content, kind.base, count, offset * count))
    return np.stack(found, 1).astype(float)


_READERS = {
    "ascii": _ascii_points,
    "binary": _binary_points,
    "binary_compressed": _packed_points,
}


def _measured(points: Float) -> NDArray[np.bool_]:
    """Return which points were measured in front of the camera, (H, W) bool."""
    return np.asarray(np.isfinite(points).all(-1) & (points[..., 2] > 0))


def _misfit(points: Float, intrinsics: Float) -> float:
    """Return how far most points are at most from their pixels, pixels; 0 without points."""
    measured = _measured(points)
    at = np.argwhere(measured)[:, ::-1]
    if not len(at):
        return 0.0
    seen = points[measured] @ intrinsics.T
    off = np.abs(seen[:, :2] / seen[:, 2:] - at).max(1)
    return float(np.percentile(off, MISFIT_PERCENTILE))


def _fitted(header: PcdHeader) -> Float:
    """Return the intrinsics of the camera of a cloud, (3, 3)."""
    intrinsics, misfit = fitted_intrinsics(read_points(header))
    if misfit > LARGEST_MISFIT:
        raise DatasetError(
            f"{header.path}: its points are not those that a pinhole camera sees in its pixels; are"
            " they in another frame than the optical frame of the camera (x right, y down, z"
            " forward)?"
        )
    return intrinsics
