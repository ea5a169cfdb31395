"""How novel an object is to a recogniser, and whether it is of any class it knows (out-of-distribution detection)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from nextview.errors import ModelError
from nextview.files import checked_bytes, new_file

Float = NDArray[np.floating]

NEIGHBOUR = 10
"""The distance to this one of the nearest known views counts."""


@dataclass(frozen=True)
class Quantiles:
    """The distribution of a novelty score over objects of known classes: the mean over the views of an object.

    Attributes:
        quantiles: scores of known objects after 1, 2, ... views, ascending, at even steps of probability from 0 to 1,
            (views, Q) float32.
        objects: how many known objects they are of, (1,) int64.
    """

    quantiles: Float
    objects: NDArray[np.int64]

    def __post_init__(self) -> None:
        if self.quantiles.ndim != 2 or self.quantiles.shape[1] < 2 or not (np.diff(self.quantiles) >= 0).all():
            raise ModelError("no novelty score: quantiles that do not ascend")

    def p_value(self, score: Float | float, n_views: NDArray[np.int64] | int) -> NDArray[np.float64]:
        """The share of known objects that are at least as novel after so many views, by the mean score over them.

        A conformal p-value (Vovk et al., 2005): an object of a known class falls below p in a share p of the cases.
        Beyond the number of views for which there are quantiles, the last count. Shapes are broadcast; float64.
        """
        score, n_views = np.broadcast_arrays(np.asarray(score, np.float64), n_views)
        levels = np.linspace(0, 1, self.quantiles.shape[1])
        found = np.empty(score.shape)
        for index in np.ndindex(score.shape):
            row = self.quantiles[min(int(n_views[index]), len(self.quantiles)) - 1]
            found[index] = 1 - np.interp(score[index], row, levels)
        n = int(self.objects[0])
        return np.asarray((1 + n * found) / (n + 1))

    def of_views(self, scores: Sequence[float]) -> float:
        """The p-value of one object by the scores of its views so far; 1 if there is none."""
        return float(self.p_value(float(np.mean(scores)), len(scores))) if scores else 1.0


@dataclass(frozen=True)
class Novelty(Quantiles):
    """A novelty score of views by the recogniser's features, and its distribution over objects of known classes.

    The score is the sum of two parts, each standardised over known views that the recogniser was not trained on: the
    distance to the tenth nearest of known views, of unit vectors (Sun et al., ICML 2022), and a perceptron that was
    trained to discriminate known objects and synthetic outliers (outlier exposure, Hendrycks et al., ICLR 2019). The
    score of an object is the mean over its views.

    Attributes:
        middle: of the features, (F,) float32.
        directions: on which the distances are measured, (F, D) float32.
        neighbours: known views on them, unit vectors, (R, D) float32.
        hidden, hidden_bias: first layer of the perceptron, (F, H) and (H,) float32.
        output, output_bias: its second, (H,) and (1,) float32.
        standard: mean and deviation of the distance, then of the perceptron's, over known views, (2, 2) float32.

    Raises:
        ModelError: shapes that do not fit, or numbers that are not finite.
    """

    middle: Float
    directions: Float
    neighbours: Float
    hidden: Float
    hidden_bias: Float
    output: Float
    output_bias: Float
    standard: Float

    def __post_init__(self) -> None:
        f, d, h = len(self.middle), self.directions.shape[-1], self.hidden.shape[-1]
        shapes = {"middle": (f,), "directions": (f, d), "neighbours": (len(self.neighbours), d), "hidden": (f, h)}
        shapes |= {"hidden_bias": (h,), "output": (h,), "output_bias": (1,), "standard": (2, 2), "objects": (1,)}
        shapes |= {"quantiles": (len(self.quantiles), self.quantiles.shape[-1])}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or 0 in shape or not np.isfinite(values).all():
                raise ModelError(f"no novelty score: {name} has the shape {values.shape}, or is not finite")
        if len(self.neighbours) < NEIGHBOUR or (self.standard[:, 1] <= 0).any() or self.objects[0] < 1:
            raise ModelError("no novelty score: too few known views, or a deviation that is not positive")
        super().__post_init__()

    def scores(self, features: Float) -> NDArray[np.float64]:
        """The novelty score of each view, (B,) float64, from features (B, F): the higher, the more novel."""
        return ((self.parts(features) - self.standard[:, 0]) / self.standard[:, 1]).sum(1)

    def parts(self, features: Float) -> NDArray[np.float64]:
        """Distance and perceptron of each view before they are standardised, (B, 2) float64."""
        centred = np.asarray(features, np.float32) - self.middle
        nearness = unit(centred @ self.directions) @ self.neighbours.T
        distance = -np.partition(nearness, -NEIGHBOUR, axis=1)[:, -NEIGHBOUR]
        perceptron = np.tanh(centred @ self.hidden + self.hidden_bias) @ self.output + self.output_bias
        return np.stack([distance, perceptron], 1).astype(np.float64)

    def save(self, path: Path, overwrite: bool = False) -> str:
        """Write a .safetensors file, the large tables in half precision if that holds them; returns its SHA-256."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        arrays |= {name: in_half(arrays[name]) for name in ("directions", "neighbours", "hidden")}
        content = save({name: np.ascontiguousarray(values) for name, values in arrays.items()})
        with new_file(path, overwrite) as part:
            part.write_bytes(content)
        return hashlib.sha256(content).hexdigest()


def in_half(table: Float) -> Float:
    """A table in half precision; in single precision if it holds numbers too large for that."""
    return table.astype(np.float16 if np.abs(table).max() < np.finfo(np.float16).max else np.float32)


def unit(rows: Float) -> Float:
    """Rows as unit vectors, same shape; zero stays zero."""
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)


def novelty_path(weights: Path) -> Path:
    """Where the novelty score of a recogniser lies: NAME.novelty.safetensors beside NAME.onnx."""
    return weights.with_suffix(".novelty.safetensors")


def read_novelty(path: Path, sha256: str) -> Novelty:
    """Read what ``Novelty.save`` wrote."""
    try:
        arrays = load(checked_bytes(path, sha256, "a novelty score"))
        wide: dict[str, Any] = {f.name: arrays[f.name] for f in fields(Novelty)}
    except (SafetensorError, KeyError) as error:
        raise ModelError(f"{path}: not a novelty score ({error})") from None
    return Novelty(**{k: v.astype(np.float32) if v.dtype == np.float16 else v for k, v in wide.items()})
