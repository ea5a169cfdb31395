"""The pinhole model of a camera: from pixels to rays and points, and back."""

from dataclasses import dataclass

import numpy as np

from nextview.types import Float, Float32, Index


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Float:
    """Return the pinhole matrix of focal lengths and a principal point.

    Args:
        fx: focal length along the rows, pixels.
        fy: focal length along the columns, pixels.
        cx: column of the principal point.
        cy: row of the principal point.

    Returns:
        Matrix, (3, 3) float64, pixels.
    """
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera without distortion.

    Camera axes are OpenCV's (x right, y down, z forward). The centre of the first pixel is at 0.5.

    Attributes:
        fx: focal length along the rows, pixels.
        fy: focal length along the columns, pixels.
        cx: column of the principal point, pixels.
        cy: row of the principal point, pixels.
        width: of the image, pixels.
        height: of the image, pixels.

    Example:
        >>> camera = PinholeCamera(100.0, 100.0, 32.0, 24.0, width=64, height=48)
        >>> camera.project(np.array([[0.5, 0.0, 2.0]])).tolist()
        [[57.0, 24.0]]
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @classmethod
    def of(cls, intrinsics: Float, shape: tuple[int, ...]) -> "PinholeCamera":
        """Return the camera of a pinhole matrix.

        Args:
            intrinsics: pinhole matrix, (3, 3) float64, pixels.
            shape: rows and columns of the image.
        """
        (fx, _, cx), (_, fy, cy) = intrinsics[:2]
        return cls(fx, fy, cx, cy, width=shape[1], height=shape[0])

    @classmethod
    def centred(cls, focal: float, shape: tuple[int, int]) -> "PinholeCamera":
        """Return a camera whose principal point is in the middle of the image.

        Args:
            focal: focal length, pixels.
            shape: rows and columns of the image.
        """
        height, width = shape
        return cls(focal, focal, width / 2, height / 2, width=width, height=height)

    @property
    def matrix(self) -> Float:
        """The pinhole matrix, (3, 3) float64, pixels."""
        return pinhole_matrix(self.fx, self.fy, self.cx, self.cy)

    def slopes(self, rows: Index, columns: Index) -> tuple[Float, Float]:
        """Return x and y of the rays (x, y, 1) through rows and columns of pixels.

        Args:
            rows: of pixels, (N,) int64.
            columns: of pixels, (M,) int64.

        Returns:
            x for each column, (M,) float64, and y for each row, (N,) float64.
        """
        x = (np.asarray(columns, np.float64) + 0.5 - self.cx) / self.fx
        y = (np.asarray(rows, np.float64) + 0.5 - self.cy) / self.fy
        return x, y

    @property
    def image_slopes(self) -> tuple[Float, Float]:
        """x of the rays through all columns, (W,), and y of those through all rows, (H,)."""
        return self.slopes(np.arange(self.height), np.arange(self.width))

    @property
    def rays(self) -> Float32:
        """Rays through all pixels, (H, W, 3) float32, with z = 1: multiples of a ray are depths."""
        x, y = np.meshgrid(*self.image_slopes)
        return np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)

    def rays_through(self, rows: Index, columns: Index) -> Float:
        """Return the rays through some pixels.

        Args:
            rows: of the pixels, (N,) int64.
            columns: of the pixels, (N,) int64.

        Returns:
            Rays, (N, 3) float64, camera frame, with z = 1.
        """
        x, y = self.slopes(rows, columns)
        return np.stack([x, y, np.ones(len(x))], -1)

    def project(self, points: Float) -> Float:
        """Return where points are seen.

        Args:
            points: before the camera, (N, 3) float64, camera frame.

        Returns:
            Column and row, (N, 2) float64, pixels; they may lie outside the image.
        """
        flat = points[:, :2] / points[:, 2:]
        return flat * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy])
