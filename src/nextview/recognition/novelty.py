"""How novel an object is, and whether it is of a known class.

This is out-of-distribution detection.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save
from scipy.ndimage import binary_erosion, minimum_filter

from nextview.checks import check_array
from nextview.errors import ModelError
from nextview.files import arrays_in, checked_bytes, new_file
from nextview.sensing.observation import Observation
from nextview.types import Float, Float32, Floats, Index, Mask

# in the file of a novelty score
ARRAYS = ("quantiles", "objects", "neighbours", "standard")
NEIGHBOUR = 10  # the distance to this one of the nearest known views counts
ROUNDED = 0.01  # by how much the length of a unit vector in half precision may be off
# novelty by the share of an outline that is hidden: the least that keeps half hidden objects known
NOVELTY_OF_HIDING = 2.0
# what hides an outline is nearer by so much, object radii, in a window of so many pixels
OCCLUDER_STEP = 0.4
OCCLUDER_WINDOW = 7


@dataclass(frozen=True)
class Quantiles:
    """The distribution of a novelty score over objects of known classes.

    The score of an object is the mean over its views.

    Attributes:
        quantiles: scores of known objects after 1, 2, ... views, ascending, at even steps of
            probability from 0 to 1, (views, Q) float32.
        objects: how many known objects they are of, (1,) int64.
    """

    quantiles: Floats
    objects: Index

    def __post_init__(self) -> None:
        check_array("its quantiles", self.quantiles, np.floating, (None, None))
        if self.quantiles.shape[1] < 2:
            raise ModelError("its quantiles are too few")
        if (np.diff(self.quantiles, axis=1) < 0).any():
            raise ModelError("its quantiles do not ascend")

        check_array("its objects", self.objects, np.integer, (1,))
        if self.objects[0] < 1:
            raise ModelError(f"it is of {self.objects[0]} known objects")

    @property
    def least_p_value(self) -> float:
        """Smallest possible p-value."""
        return 1 / (1 + int(self.objects[0]))

    def p_value(self, score: Floats | float, n_views: Index | int) -> Float:
        """Return the share of known objects that are at least as novel.

        This is a conformal p-value (Vovk et al., 2005): an object of a known class falls below p in
        a share p of the cases. It cannot fall below one in all known objects and one.

        Args:
            score: mean novelty score over the views, (...).
            n_views: number of views, (...); beyond the numbers for which there are quantiles, the
                last one counts.

        Returns:
            The p-value, (...) float64.
        """
        score, n_views = np.broadcast_arrays(np.asarray(score, np.float64), n_views)
        levels = np.linspace(0, 1, self.quantiles.shape[1])
        found = np.empty(score.shape)
        n = int(self.objects[0])

        for index in np.ndindex(score.shape):
            row = self.quantiles[min(int(n_views[index]), len(self.quantiles)) - 1]
            found[index] = (1 + n * (1 - np.interp(score[index], row, levels))) / (
                n + 1
            )

        return found

    def of_views(self, scores: Sequence[float]) -> float:
        """The p-value of one object by the scores of its views so far; 1 if there is none."""
        if not scores:
            return 1.0
        return float(self.p_value(float(np.mean(scores)), len(scores)))


@dataclass(frozen=True)
class Novelty(Quantiles):
    """A novelty score by features that know no classes, and its distribution.

    The score of a view is its distance to the tenth nearest of the known views (Sun et al.,
    "Out-of-Distribution Detection with Deep Nearest Neighbors", ICML 2022), standardised over views
    of objects that are not among these. The score of an object is the mean over its views.

    Attributes:
        neighbours: embeddings of known views, unit vectors, (R, F) float32.
        standard: mean and deviation of the distance over other views of known classes, through a
            sensor, and without one's errors, (2, 2) float32.
    """

    neighbours: Floats
    standard: Floats

    def __post_init__(self) -> None:
        super().__post_init__()

        check_array("its neighbours", self.neighbours, np.floating, (None, None))
        if len(self.neighbours) < NEIGHBOUR:
            raise ModelError(
                f"its neighbours are {len(self.neighbours)}, fewer than {NEIGHBOUR}"
            )
        lengths = np.linalg.norm(self.neighbours.astype(np.float32), axis=1)
        if np.abs(lengths - 1).max() > ROUNDED:
            raise ModelError("its neighbours are not unit vectors")

        check_array("its standard", self.standard, np.floating, (2, 2))
        if (self.standard[:, 1] <= 0).any():
            raise ModelError("its standard deviations are not above zero")

    def scores(self, embeddings: Floats, exact: Mask | bool = False) -> Float:
        """Return the novelty score of each view.

        Args:
            embeddings: features of the views, (B, F).
            exact: whether each view is free of sensor errors, (B,) bool, or one value for all.

        Returns:
            Scores, (B,) float64: the higher, the more novel.

        Raises:
            ModelError: the features have another size than those that the score was fitted to.
        """
        if embeddings.shape[1] != self.neighbours.shape[1]:
            raise ModelError(
                "the novelty score was fitted to other features; run nextview-lab fit unknown again"
            )
        nearness = np.asarray(embeddings, np.float32) @ self.neighbours.T
        distance = -np.partition(nearness, -NEIGHBOUR, axis=1)[:, -NEIGHBOUR].astype(
            np.float64
        )
        middle, deviation = self.standard[
            np.broadcast_to(exact, distance.shape).astype(int)
        ].T
        return (distance - middle) / deviation

    def save(self, path: Path, overwrite: bool = False) -> str:
        """Write the score to a .safetensors file, with eight bits per number of the known views.

        Args:
            path: of the file.
            overwrite: whether to replace an existing file.

        Returns:
            SHA-256 of the file.
        """
        arrays = {name: getattr(self, name) for name in ARRAYS} | {
            "neighbours": _in_eight_bits(self.neighbours)
        }
        content = save(
            {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        )
        with new_file(path, overwrite) as part:
            part.write_bytes(content)
        return hashlib.sha256(content).hexdigest()


@dataclass(eq=False)
class ViewScore:
    """The novelty score of one view.

    Its network runs when the score is first requested, because few frames need it.

    Attributes:
        observation: the view.
        judge: computes scores of views, (B,); None if the score is known.
        value: the score; NaN until it is computed.
    """

    observation: Observation
    judge: Callable[[Sequence[Observation]], Floats] | None
    value: float = np.nan


def values_of(scores: Sequence[ViewScore], whole: bool = False) -> list[float]:
    """Return the values of novelty scores, computing those that are missing together.

    Args:
        scores: of the views of one object.
        whole: whether to correct for hidden parts of the object by their usual effect.

    Returns:
        The values, in the order of the scores.
    """
    asked = [score for score in scores if score.judge is not None]
    if asked and (judge := asked[0].judge) is not None:
        for score, value in zip(
            asked,
            judge([s.observation for s in asked]),
            strict=True,
        ):
            score.value = float(value)
            score.judge = None
    return [
        s.value - whole * NOVELTY_OF_HIDING * hidden_share(s.observation)
        for s in scores
    ]


def hidden_share(observation: Observation) -> float:
    """Return the share of an object's outline that borders on something nearer.

    The border of the picture counts as well; 0 to 1.
    """
    if observation.sighting is None:
        return 0.0
    depth = observation.whole_frame[0]
    target = observation.sighting.mask
    outline = target & ~binary_erosion(target)
    others = np.where(target | (depth == 0), np.inf, depth)
    hidden = outline & (
        minimum_filter(others, OCCLUDER_WINDOW, mode="constant", cval=0)
        < depth - OCCLUDER_STEP
    )
    return float(hidden.sum() / max(outline.sum(), 1))


def unit(rows: Floats) -> Floats:
    """Rows as unit vectors, same shape; zero stays zero."""
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)


def _in_eight_bits(rows: Floats) -> NDArray[np.int8]:
    """Unit vectors as int8, same shape: the largest number of each row becomes 127.

    ``unit`` brings them back.
    """
    largest = np.abs(rows).max(axis=-1, keepdims=True)
    return np.rint(rows / largest * np.iinfo(np.int8).max).astype(np.int8)


def as_stored(rows: Floats) -> Float32:
    """Unit vectors, (R, F), as they are read after they were saved."""
    return unit(_in_eight_bits(rows).astype(np.float32))


def novelty_path(weights: Path) -> Path:
    """Where the novelty score of a recogniser lies: NAME.novelty.safetensors beside NAME.onnx."""
    return weights.with_suffix(".novelty.safetensors")


def read_novelty(path: Path, sha256: str) -> Novelty:
    """Read a file that ``Novelty.save`` wrote.

    Args:
        path: of the file.
        sha256: that its content must have.

    Returns:
        The novelty score.

    Raises:
        ModelError: the file is missing, has another hash, or contains an invalid value.
    """
    content = checked_bytes(path, sha256, "a novelty score")
    arrays: dict[str, Any] = arrays_in(content, ARRAYS, f"{path}: not a novelty score")
    stored = arrays["neighbours"]
    if np.issubdtype(stored.dtype, np.floating):  # files of version 0.3 and before
        arrays["neighbours"] = stored.astype(np.float32)
    elif stored.dtype == np.int8 and stored.ndim == 2:
        arrays["neighbours"] = unit(stored.astype(np.float32))

    try:
        return Novelty(**arrays)
    except ModelError as error:
        raise ModelError(f"{path}: not a novelty score ({error})") from None
