"""Generate simulated frames with labels for the segmentation network, and read them again.

Each file contains frames of its own worlds. They depend only on the seed, the number of the file
and the meshes, so an interrupted run continues with the missing files.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from nextview.checks import one_line
from nextview.data import pool
from nextview.data.folders import Entry, list_dataset
from nextview.errors import DAMAGED, DatasetError, MeshError, UsageError
from nextview.files import new_file
from nextview.geometry.mesh import load_mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.segmentation.features import SIDE_MULTIPLE, SmallPicture, features
from nextview.segmentation.network import (
    AFFINITY_OUTPUTS,
    AFFINITY_STEPS,
    OUTPUT_CLASSES,
)
from nextview.segmentation.parting import pair_slices
from nextview.types import Float, Float32, Index, Mask
from nextview_lab.worlds.life_sizes import LIFE_SIZES, life_radius
from nextview_lab.worlds.solids import Solid
from nextview_lab.worlds.worlds import (
    BACKGROUND,
    HOLE,
    LARGEST_SHAPE,
    SURFACE,
    LabelledFrame,
    draw_shapes,
    draw_world,
    photograph,
)

FRAME_SHAPE = (160, 213)  # rows and columns
FRAMES_OF_A_FILE = 400  # largest number of frames in a file
VIEWS_OF_A_WORLD = 2
FEW_PIXELS = 0.06  # share of object pixels; most frames with fewer are dropped
FEW_KEPT = 0.25  # share of these that are kept
# per frame: number of solids from which a file draws objects, and of meshes among them
SHAPES_PER_FRAME = 0.35
TOYS_PER_FRAME = 0.15
FURNITURE_PER_FRAME = 0.075
FEWEST_SHAPES = 6
FARTHEST_LEARNED = 6.5  # metres
STORED_DEPTH_STEP = 1e-4  # metres, unit of the depth in files
UNKNOWN_CLASS = -1  # class of a pixel without depth
SMALLEST_TAUGHT = 8  # pixels; smaller objects get no larger weight per pixel
UP_NOISE = 0.03  # error of the up direction reported by an arm
CLASS_OF = {  # by label; objects have labels from 0
    HOLE: UNKNOWN_CLASS,
    BACKGROUND: OUTPUT_CLASSES.index("background"),
    SURFACE: OUTPUT_CLASSES.index("surface"),
}


@dataclass(frozen=True)
class WorldMeshes:
    """Meshes used in worlds, in addition to generated solids.

    Attributes:
        toys: of objects, of any size.
        furniture: of life-size furniture.
    """

    toys: tuple[Entry, ...] = ()
    furniture: tuple[Entry, ...] = ()

    @classmethod
    def of(cls, toys: Path | None, furniture: Path | None) -> WorldMeshes:
        """List the training meshes of folders.

        Args:
            toys: folder of objects of any size; None for none.
            furniture: folder of furniture with ModelNet10 classes; None for none.

        Raises:
            DatasetError: a folder is missing or contains no training mesh.
            UsageError: the size of a furniture class is not known.
        """
        large = _entries(furniture)
        for entry in large:
            if entry.label not in LIFE_SIZES:
                raise UsageError(
                    f"{furniture}: how large is a {one_line(entry.label)}? Furniture is of the"
                    f" classes {', '.join(LIFE_SIZES)}; other meshes are for --meshes"
                )
        return cls(_entries(toys), large)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the meshes."""
        return tuple(entry.name for entry in (*self.toys, *self.furniture))

    def divided(self, share: float, seed: int) -> tuple[WorldMeshes, WorldMeshes]:
        """Divide the meshes into a training and a validation part.

        Args:
            share: approximate share for validation.
            seed: of the random division.
        """
        rng = np.random.default_rng([seed, 2])
        parts = []
        for entries in (self.toys, self.furniture):
            out = rng.random(len(entries)) < share
            parts.append([tuple(compress(entries, side)) for side in (~out, out)])
        toys, furniture = parts
        return WorldMeshes(toys[0], furniture[0]), WorldMeshes(toys[1], furniture[1])


def _entries(folder: Path | None) -> tuple[Entry, ...]:
    """Return the training meshes of a folder."""
    if folder is None:
        return ()
    entries = [entry for entry in list_dataset(folder) if entry.split in ("train", "")]
    if not entries:
        raise DatasetError(f"{folder}: holds no mesh of a training split")
    return tuple(entries)


@dataclass(frozen=True)
class FrameFile:
    """A file of frames to be generated.

    Attributes:
        path: of the file.
        seed: of its random numbers.
        frames: number of frames.
    """

    path: Path
    seed: tuple[int, ...]
    frames: int


def frame_files(
    folder: Path,
    frames: int,
    seed: Sequence[int],
    most: int = FRAMES_OF_A_FILE,
) -> list[FrameFile]:
    """Plan files with equal numbers of frames.

    Args:
        folder: of the files.
        frames: least total number.
        seed: of all random numbers.
        most: largest number of frames per file.
    """
    count = -(-frames // most)
    return [
        FrameFile(folder / f"{number:05}.npz", (*seed, number), -(-frames // count))
        for number in range(count)
    ]


def draw_frames(
    files: Sequence[FrameFile],
    meshes: WorldMeshes = WorldMeshes(),
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, int]]:
    """Generate the missing files.

    Args:
        files: see ``frame_files``.
        meshes: used in the worlds, in addition to generated solids.
        workers: number of processes; None for one per core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.

    Yields:
        Number of finished files, and of all files.

    Raises:
        DatasetError: a process died.
    """
    missing = [file for file in files if not file.path.exists()]
    yield from pool.counted(
        partial(draw_file, meshes),
        missing,
        len(files),
        lambda file: str(file.path),
        workers,
        scheduler,
    )


def draw_file(meshes: WorldMeshes, file: FrameFile) -> None:
    """Draw worlds, capture each, and write the frames, all or none.

    Args:
        meshes: used in the worlds, in addition to generated solids.
        file: to write.
    """
    rng = np.random.default_rng(file.seed)
    toys = solids_of(meshes.toys, max(1, round(TOYS_PER_FRAME * file.frames)), rng)
    furniture = solids_of(
        meshes.furniture, max(1, round(FURNITURE_PER_FRAME * file.frames)), rng
    )
    count = max(FEWEST_SHAPES, round(SHAPES_PER_FRAME * file.frames))
    shapes = draw_shapes(rng, count, toys)

    frames: list[LabelledFrame] = []
    while len(frames) < file.frames:
        world = draw_world(shapes, furniture, rng)
        if world.things:
            frames += [
                frame
                for frame in photograph(world, rng, FRAME_SHAPE, VIEWS_OF_A_WORLD)
                if (frame.labels >= 0).mean() > FEW_PIXELS or rng.random() < FEW_KEPT
            ]
    LabelledFrames.of(frames[: file.frames]).save(file.path)


def solids_of(entries: Sequence[Entry], count: int, rng: Generator) -> list[Solid]:
    """Load some meshes, upright on z = 0; furniture is life-size.

    Meshes that are too large or damaged are skipped.

    Args:
        entries: available meshes, each used once.
        count: largest number.
        rng: for the selection and the sizes.
    """
    solids: list[Solid] = []
    for index in rng.permutation(len(entries)):
        if len(solids) == count:
            break
        entry = entries[index]
        try:
            mesh = load_mesh(entry.path, max_faces=LARGEST_SHAPE)
        except MeshError:
            continue

        size = life_radius(mesh, entry.label, rng) if entry.label in LIFE_SIZES else 1.0
        vertices = mesh.vertices * size
        low = vertices.min(0)
        high = vertices.max(0)
        foot = np.append((low + high)[:2] / 2, low[2])
        solids.append((vertices - foot, mesh.faces))
    return solids


@dataclass(frozen=True, eq=False)
class LabelledFrames:
    """Frames with labels, as stored in files.

    Attributes:
        depth: (N, H, W) uint16, tenths of a millimetre; 0 without valid depth.
        labels: see ``simulation.worlds.LabelledFrame``, (N, H, W) int16.
        pinhole: focal lengths and principal point, (N, 4) float64, pixels.
        up: direction against gravity in camera axes, (N, 3) float64.
    """

    depth: NDArray[np.uint16]
    labels: NDArray[np.int16]
    pinhole: Float
    up: Float

    def __len__(self) -> int:
        return len(self.depth)

    @classmethod
    def of(cls, frames: Sequence[LabelledFrame]) -> LabelledFrames:
        """Quantise the depth of frames, and remove depth that is too large."""
        depth = np.stack([frame.depth for frame in frames])
        depth = np.where(depth > FARTHEST_LEARNED, 0, depth)
        steps = np.rint(depth / STORED_DEPTH_STEP).astype(np.uint16)
        labels = np.stack([frame.labels for frame in frames])
        matrices = np.stack([frame.intrinsics for frame in frames])
        return cls(
            steps,
            np.where(steps > 0, labels, HOLE).astype(np.int16),
            matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]],
            np.stack([frame.up for frame in frames]),
        )

    def save(self, path: Path) -> None:
        """Write the frames to a file, completely or not at all."""
        with new_file(path) as part:
            np.savez_compressed(part, **vars(self))

    @classmethod
    def load(cls, paths: Sequence[Path]) -> LabelledFrames:
        """Read the frames of some files.

        Args:
            paths: of the files.

        Raises:
            DatasetError: one is missing or damaged.
        """
        read = [_arrays(path) for path in paths]
        return cls(*(np.concatenate(parts) for parts in zip(*read, strict=True)))

    def example(self, index: int, rng: Generator | None) -> Example:
        """Return the training example of one frame.

        Args:
            index: of the frame.
            rng: for augmentation: mirroring, and tilting or hiding the up direction; None for no
                augmentation.
        """
        depth = self.depth[index].astype(np.float32) * np.float32(STORED_DEPTH_STEP)
        labels = self.labels[index]
        camera = PinholeCamera(*self.pinhole[index], *depth.shape[::-1])
        x, y = camera.image_slopes
        up = self.up[index]
        told = True
        if rng is not None:
            if rng.random() < 0.5:  # mirror the frame
                depth, labels, x = depth[:, ::-1].copy(), labels[:, ::-1], -x[::-1]
                up = up * [-1, 1, 1]
            told = rng.random() < 0.5
            up = up + rng.normal(0, UP_NOISE, 3)
            up /= np.linalg.norm(up)
        rays = x.astype(np.float32), y.astype(np.float32)
        return Example.of(SmallPicture(depth, rays, 1), labels, up if told else None)


def _arrays(path: Path) -> list[NDArray]:
    """Return the arrays of a file, in the order of ``LabelledFrames``."""
    try:
        # opened here, because numpy would leave a damaged file open
        with path.open("rb") as file, np.load(file) as arrays:
            return [arrays[field.name] for field in fields(LabelledFrames)]
    except DAMAGED:
        raise DatasetError(
            f"{path}: is missing or damaged; delete it and give the command of the training again"
        ) from None


@dataclass(frozen=True, eq=False)
class Example:
    """A training example; its sides are multiples of SIDE_MULTIPLE.

    Attributes:
        features: input, see ``segmentation.features``, (C, h, w) float32.
        classes: index in OUTPUT_CLASSES, UNKNOWN_CLASS without depth, (h, w) int64.
        same: for each of AFFINITY_STEPS, whether the other pixel belongs to the same object,
            (12, h, w) float32.
        compared: weight of each pair in the loss, 0 unless both pixels belong to objects,
            (12, h, w) float32.
    """

    features: Float32
    classes: Index
    same: Float32
    compared: Float32

    @classmethod
    def of(cls, picture: SmallPicture, labels: NDArray, up: Float | None) -> Example:
        """Create the example of a downscaled frame.

        Args:
            picture: the frame.
            labels: of its pixels, see ``simulation.worlds.LabelledFrame``, (h, w).
            up: direction against gravity in camera axes, (3,); None if not given.
        """
        classes = np.full(labels.shape, OUTPUT_CLASSES.index("thing"))
        for label, number in CLASS_OF.items():
            classes[labels == label] = number
        weights = pair_weights(labels)
        pairs = [_pairs(labels, weights, *step) for step in AFFINITY_STEPS]
        same, compared = np.stack(pairs, 1).astype(np.float32)
        whole = features(picture, up), classes, same, compared
        return cls(
            *(
                _padded(values, UNKNOWN_CLASS if values is classes else 0)
                for values in whole
            )
        )


def _padded(values: NDArray, value: int) -> NDArray:
    """Pad rows and columns at the bottom and on the right."""
    added = [(0, -size % SIDE_MULTIPLE) for size in values.shape[-2:]]
    sides = [(0, 0)] * (values.ndim - 2) + added
    return np.pad(values, sides, constant_values=value)


def pair_weights(labels: NDArray) -> Float32:
    """Return weights of object pixels, (h, w), which are larger for small objects.

    Args:
        labels: see ``simulation.worlds.LabelledFrame``, (h, w).
    """
    weights = np.zeros(labels.shape, np.float32)
    inside = labels >= 0
    if inside.any():
        own = labels[inside]
        weights[inside] = np.maximum(np.bincount(own)[own], SMALLEST_TAUGHT) ** -0.5
    return weights


def _pairs(
    labels: NDArray, weights: Float32, down: int, right: int
) -> tuple[Mask, Float32]:
    """Return whether pairs of pixels belong to the same object, and their weights."""
    first, second = pair_slices(labels.shape, down, right)
    same = np.zeros(labels.shape, bool)
    compared = np.zeros(labels.shape, np.float32)
    same[first] = (labels[first] == labels[second]) & (labels[first] >= 0)
    both = (labels[first] >= 0) & (labels[second] >= 0)
    compared[first] = np.where(both, np.maximum(weights[first], weights[second]), 0)
    return same, compared


def output_scores(outputs: Float32, examples: Sequence[Example]) -> dict[str, float]:
    """Evaluate the outputs of a network.

    Args:
        outputs: for the frames, (N, 15, h, w).
        examples: the frames.

    Returns:
        ``class_accuracy``, the share of correctly classified pixels, averaged over the classes;
        ``thing_iou``, the intersection over union of object pixels; ``pair_accuracy``, the share of
        correctly classified pairs, averaged over same and different objects and over the steps.
    """
    classes = np.stack([example.classes for example in examples])
    taken = outputs[:, : len(OUTPUT_CLASSES)].argmax(1)
    known = range(len(OUTPUT_CLASSES))
    right = [(taken == k)[classes == k].mean() for k in known if (classes == k).any()]
    thing = OUTPUT_CLASSES.index("thing")
    both = (taken == thing) & (classes == thing)
    either = ((taken == thing) & (classes != UNKNOWN_CLASS)) | (classes == thing)

    same = np.stack([example.same for example in examples]) > 0
    compared = np.stack([example.compared for example in examples]) > 0
    joined = outputs[:, AFFINITY_OUTPUTS] > 0
    pairs = []
    for step in range(len(AFFINITY_STEPS)):
        for side in (True, False):
            judged = compared[:, step] & (same[:, step] == side)
            pairs += [(joined[:, step] == side)[judged].mean()] if judged.any() else []
    return {
        "class_accuracy": round(float(np.mean(right)), 4),
        "thing_iou": round(float(both.sum() / max(either.sum(), 1)), 4),
        "pair_accuracy": round(float(np.mean(pairs)) if pairs else 0.0, 4),
    }
