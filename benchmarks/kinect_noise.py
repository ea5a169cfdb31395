"""Hold the model of the Kinect against frames of a real one.

    python benchmarks/kinect_noise.py FOLDER [--focal 585]

The folder holds depth images (*.depth.png, uint16 millimetres, 640 x 480), as 7-Scenes has them. Squares of 24 x 24
pixels that are about planes, without holes, are fitted by a plane in inverse depth. Then the simulated Kinect looks at
the same planes in the same places. Prints for both, by depth, the standard deviation of inverse depth about the planes,
the correlation of pixels at distances of 1, 2, 3, 4 and 6 along rows and columns, and the median step between
neighbouring measured values of inverse depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from skimage.io import imread

from nextview.cameras.sensors import SENSORS, Sensor
from nextview.cameras.sensors.depth_noise import kinect_axial

SIDE = 24
LAGS = (1, 2, 3, 4, 6)
STEEPEST = 60.0
"""Angle of incidence, degrees, up to which planes are used."""
DEPTHS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)


@dataclass(frozen=True)
class Settings:
    """What is read.

    Attributes:
        folder: with depth images.
        focal: of the camera, pixels.
    """

    folder: tyro.conf.Positional[Path]
    focal: float = 585.0


def squares(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The squares of an image, (N, SIDE * SIDE)."""
    h, w = (side // SIDE for side in q.shape)
    return q[: h * SIDE, : w * SIDE].reshape(h, SIDE, w, SIDE).swapaxes(1, 2).reshape(-1, SIDE * SIDE)


def assembled(rows: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """The image of such squares, 0 beyond them."""
    h, w = (side // SIDE for side in shape)
    q = np.zeros(shape)
    q[: h * SIDE, : w * SIDE] = rows.reshape(h, w, SIDE, SIDE).swapaxes(1, 2).reshape(h * SIDE, w * SIDE)
    return q


def statistics(q: NDArray[np.float64], planes: NDArray[np.float64], fit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation about refitted planes and correlations, (N, 1 + 2 * lags)."""
    rest = q - (q @ fit.T) @ planes.T
    rest = rest.reshape(-1, SIDE, SIDE)
    variance = (rest**2).mean((1, 2))
    found = [np.sqrt(variance)]
    for lag in LAGS:
        found.append((rest[:, :, lag:] * rest[:, :, :-lag]).mean((1, 2)) / variance)
    for lag in LAGS:
        found.append((rest[:, lag:] * rest[:, :-lag]).mean((1, 2)) / variance)
    return np.stack(found, 1)


def main(settings: Settings) -> None:
    row, column = np.indices((SIDE, SIDE)).reshape(2, -1)
    basis = np.stack([column, row, np.ones(SIDE**2)], 1).astype(float)
    fit = np.linalg.pinv(basis)
    whole = SENSORS["kinect"]
    sensor = replace(whole, **dict.fromkeys(("lateral", "grazing", "flying", "shadow", "holes"), 0.0))
    sensor = replace(sensor, focal=settings.focal)
    depths, real, model, values = [], [], [], {"real": set(), "model": set()}
    for number, file in enumerate(sorted(settings.folder.glob("*.depth.png"))):
        image = imread(file)
        z = np.where(image == 65535, 0, image) / 1000
        q = squares(np.divide(1, z, out=np.zeros(z.shape), where=z > 0))
        planes = q @ fit.T  # (N, 3): change along columns, along rows, value at the first pixel
        middle = planes @ [SIDE / 2, SIDE / 2, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.hypot(planes[:, 0], planes[:, 1]) * settings.focal / middle
            law = kinect_axial(1 / middle, np.arctan(slope)) * middle**2
            some = (q > 0).all(1) & (slope < np.tan(np.radians(STEEPEST)))
            some &= statistics(q, basis, fit)[:, 0] < 2 * law  # no edge in it
        clean = assembled(np.where(some[:, None], planes @ basis.T, 0), z.shape)
        true = np.divide(1, clean, out=np.zeros(clean.shape), where=clean > 0).astype(np.float32)
        measured = sensor.measure(true, np.random.default_rng(number))[0]
        again = squares(np.divide(1, measured, out=np.zeros(z.shape), where=measured > 0))
        some &= (again > 0).all(1)
        depths.append(1 / middle[some])
        real.append(statistics(q[some], basis, fit))
        model.append(statistics(again[some], basis, fit))
        values["real"].update(np.unique(image[(image > 0) & (image < 65535)]).tolist())
        values["model"].update(np.unique(np.rint(measured[measured > 0] * 1000)).tolist())
    print_table(np.concatenate(depths), np.concatenate(real), np.concatenate(model), sensor)
    for name, millimetres in values.items():
        inverse = 1000 / np.array(sorted(m for m in millimetres if 700 < m < 2000))
        print(f"median step of inverse depth, {name}: {np.median(-np.diff(inverse)):.5f} per metre")


def print_table(depths: NDArray, real: NDArray, model: NDArray, sensor: Sensor) -> None:
    """Medians over the squares of each range of depth."""
    print("| depth, m | squares | real: sigma, correlations | model: sigma, correlations |\n|---|---|---|---|")
    ranges = [*pairwise(DEPTHS), (DEPTHS[0], DEPTHS[-1])]
    for low, high in ranges:
        here = (depths > low) & (depths <= high)
        if here.sum() < 20:
            continue
        cells = []
        for found in (real, model):
            sigma, *r = np.median(found[here], 0)
            both = (np.array(r[: len(LAGS)]) + np.array(r[len(LAGS) :])) / 2
            cells.append(f"{sigma:.5f}, {' '.join(f'{value:.2f}' for value in both)}")
        print(f"| {low:g}-{high:g} | {here.sum()} | {cells[0]} | {cells[1]} |")


if __name__ == "__main__":
    main(tyro.cli(Settings))
