"""View measures: their input, custom measures by import path, and their computation for a store."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from nextview.checks import plugin, plugin_errors, plugins
from nextview.data.pool import counted
from nextview.geometry.camera import depth_image
from nextview.geometry.depth import object_depth
from nextview.recognition.map_names import Good
from nextview.types import Float, Float32, Floats, Index, Mask
from nextview_lab.data.store import DEPTH_UNIT, ViewStore, opened, writing
from nextview_lab.errors import MeasureError

QUANTUM = 1e-3  # depth values closer than this count as equal, object radii


@dataclass(frozen=True)
class MeasuredView:
    """One view of an object, as the input of measures.

    Intermediate results that several measures need are computed once, on demand.

    Attributes:
        depth: along the optical axis, (H, W) float, object radii, 0 for the background.
        pose: camera-to-world, (4, 4), OpenCV axes; the world is the object frame, z up.
        intrinsics: pinhole matrix, (3, 3), pixels, the first pixel's centre at 0.5.
    """

    depth: Floats
    pose: Float
    intrinsics: Float

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth", object_depth(depth_image(self.depth)))

    @cached_property
    def box(self) -> tuple[slice, ...]:
        """Rows and columns that contain the object, (H', W'); empty if it is not visible."""
        found = find_objects((self.depth > 0).astype(np.int8))
        return found[0] if found else (slice(0, 0), slice(0, 0))

    @cached_property
    def near(self) -> Floats:
        """Depth in the bounding box, (H', W')."""
        return self.depth[self.box]

    @cached_property
    def seen(self) -> Mask:
        """Object pixels in the bounding box, (H', W')."""
        return self.near > 0

    @cached_property
    def depths(self) -> Floats:
        """Depth of the object pixels, (n,), row by row."""
        return self.near[self.seen]


# returns all views of an object in a store
MeasuredViews = Callable[[ViewStore, int], Iterator[MeasuredView]]


@dataclass(frozen=True)
class Measure:
    """A measure of a view, and its required input.

    Attributes:
        function: computes the measure of one ``MeasuredView``.
        needs: "depth" if the depth image is enough, or "mesh".
        good: whether high values (peak) or low values (valley) mark the better views.
    """

    function: Callable[[Any], float]
    needs: Literal["depth", "mesh"] = "depth"
    good: Good = "peak"

    def __call__(self, view: MeasuredView) -> float:
        """Compute the measure of a view."""
        return self.function(view)


MEASURES: dict[
    str,
    Measure,
] = {  # the others are entry points MEASURE_ENTRY_POINTS of installed packages
    "depth_entropy": Measure(lambda view: depth_entropy(view.depth))
}
MEASURE_ENTRY_POINTS = "nextview.measures"


def all_measures() -> dict[str, Measure]:
    """Return all named measures: MEASURES, and those of installed packages."""
    return MEASURES | {
        name: find_measure(name) for name in plugins(MEASURE_ENTRY_POINTS)
    }


def find_measure(name: str) -> Measure:
    """Return a measure by its name or as "MODULE:FUNCTION".

    The latter is a custom function or ``Measure``.
    """
    if name in MEASURES:
        return MEASURES[name]
    path = plugins(MEASURE_ENTRY_POINTS).get(name, name)
    if ":" not in path:
        known = ", ".join([*MEASURES, *plugins(MEASURE_ENTRY_POINTS)])
        raise MeasureError(
            f"no measure is called {name!r}; there are {known}, or MODULE:FUNCTION"
        )

    with plugin_errors(
        lambda said: MeasureError(f"measure {name} cannot be imported ({said})")
    ):
        found = plugin(path)

    if not callable(found):
        raise MeasureError(f"measure {name} is not a function of a view")
    return found if isinstance(found, Measure) else Measure(found)


def names_of(names: Sequence[str], meshes: bool) -> tuple[str, ...]:
    """Return the measures that a user requests.

    Args:
        names: of measures, or "all"; empty for all that can be computed.
        meshes: whether the meshes are available.

    Returns:
        Names of the measures, each once.

    Raises:
        MeasureError: a name is unknown, or a measure needs the meshes.
    """
    if not names:
        return tuple(
            name
            for name, measure in all_measures().items()
            if meshes or measure.needs == "depth"
        )

    names = tuple(
        dict.fromkeys(
            each
            for name in names
            for each in (all_measures() if name == "all" else (name,))
        )
    )

    for name in names:
        if find_measure(name).needs == "mesh" and not meshes:
            raise MeasureError(
                f"the measure {name} needs the meshes, not the depth alone (docs/add_a_measure.md)"
            )
    return names


def depth_entropy(depth: Floats) -> float:
    """Return the Shannon entropy of the values of a depth image, bits.

    The image is (H, W), object radii, 0 for the background.
    """
    depth = object_depth(depth_image(depth).astype(np.float64, copy=False))
    seen = depth[depth > 0]
    counts = np.bincount(np.rint(seen / QUANTUM).astype(np.int64), minlength=1)
    counts[0] += depth.size - seen.size
    share = counts[counts > 0] / depth.size
    return float((share * np.log2(1 / share)).sum())


def normalise_per_object(values: Floats) -> Float32:
    """Scale values, (..., V), to [0, 1] over each object's views, float32.

    They are all 0 if the views do not differ.
    """
    values = np.asarray(values)
    low = values.min(-1, keepdims=True)
    span = values.max(-1, keepdims=True) - low
    return np.where(span > 0, (values - low) / np.where(span > 0, span, 1), 0).astype(
        np.float32
    )


def confidence_maps(logits: Floats, labels: NDArray[np.integer]) -> Float32:
    """Return the confidence in the true class of each single view.

    It is the highest probability if the most likely class, the first one in case of ties, is the
    true one, else 0.

    Args:
        logits: (N, V, C).
        labels: true classes, (N,).

    Returns:
        Confidence, (N, V) float32.
    """
    from scipy.special import softmax

    logits = np.asarray(logits, np.float64)
    right = logits.argmax(2) == labels[:, None]
    return np.where(right, softmax(logits, axis=2).max(2), 0).astype(np.float32)


def depth_views(store: ViewStore, i: int) -> Iterator[MeasuredView]:
    """Iterate over the views of a stored object as input of measures.

    Args:
        store: the view store.
        i: row of the object.

    Yields:
        Each view.
    """
    for depth, pose in zip(store.read("depth", i), store.sphere.poses, strict=True):
        # float64, as when it was rendered
        yield MeasuredView(depth * DEPTH_UNIT, pose, store.intrinsics)


def measure(
    path: Path,
    names: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    objects: Index | None = None,
    overwrite: bool = False,
    views: MeasuredViews = depth_views,
) -> Iterator[tuple[int, int]]:
    """Compute measures of rendered views and add them to their store.

    They are written to ``measures/NAME``, (N, V) float32.

    Args:
        path: of the store.
        names: of the measures, see ``find_measure``, or "all"; empty for all that ``views`` allows.
        workers: number of processes; None for one per core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.
        objects: rows of the objects, (n,) int64; None for all.
        overwrite: whether to recompute existing values.
        views: returns the views of an object.

    Yields:
        Number of finished objects, and the total.
    """
    names = names_of(names, views is not depth_views)
    # raises an error if it is missing, before any work is done
    ViewStore.open(path).array("depth")
    arrays = [f"measures/{name}" for name in names]
    with writing(path):
        store = ViewStore.open(Path(path).absolute())
        wanted = store.done & (
            True if objects is None else np.isin(np.arange(len(store)), objects)
        )
        for array in arrays:
            if overwrite:
                store.remove(array)
            store.add(array)

        held = np.all([store.held(array) for array in arrays], axis=0)
        try:
            yield from counted(
                partial(_measure, names, views, store.path),
                np.flatnonzero(wanted & ~held).tolist(),
                int(wanted.sum()),
                lambda i: f"{path}: {store.names[i]}",
                workers,
                scheduler,
            )
        finally:  # remove arrays without any values
            for array in arrays:
                if not store.held(array).any():
                    store.remove(array)


def _measure(names: tuple[str, ...], views: MeasuredViews, path: Path, i: int) -> None:
    """Compute measures of the views of an object, and write them to its store."""
    store = opened(path)
    object_name = store.names[i]
    functions = {name: find_measure(name) for name in names}
    values = {name: np.empty(len(store.sphere), np.float32) for name in names}

    def failed(name: str, said: str) -> MeasureError:
        return MeasureError(f"measure {name} of {object_name}: {said}")

    for k, view in enumerate(views(store, i)):
        for name, function in functions.items():
            guard = (
                nullcontext()
                if name in MEASURES
                else plugin_errors(partial(failed, name))
            )
            with (
                guard,
                np.errstate(over="ignore"),
            ):  # overflow of float32 is reported below
                values[name][k] = function(view)
    for name, found in values.items():
        if not np.isfinite(found).all():
            raise MeasureError(
                f"measure {name} of {object_name}, view {np.isfinite(found).argmin()}, is not"
                " finite"
            )
    store.write(i, {f"measures/{name}": found for name, found in values.items()})
