"""Simulated frames with labels for the segmentation network: drawn into files, and read again.

Each file holds frames of worlds with things of its own. Which they are depends on the seed, the
number of the file and the meshes alone, so whoever is killed goes on with the files that are
missing.
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
from nextview.data.room_drawing import LIFE_SIZES, life_radius
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
from nextview.simulation.solids import Solid
from nextview.simulation.worlds import (
    BACKGROUND,
    HOLE,
    LARGEST_SHAPE,
    SURFACE,
    LabelledFrame,
    draw_shapes,
    draw_world,
    photograph,
)
from nextview.types import Float, Float32, Index, Mask

FRAME_SHAPE = (160, 213)  # rows and columns
FRAMES_OF_A_FILE = 400  # at most
VIEWS_OF_A_WORLD = 2
FEW_PIXELS = 0.06  # of things; most frames with fewer teach little and are dropped
FEW_KEPT = 0.35  # share of these that are kept
# of each frame: solids that its file draws things from, and meshes among them
SHAPES_PER_FRAME = 0.35
TOYS_PER_FRAME = 0.15
FURNITURE_PER_FRAME = 0.075
FEWEST_SHAPES = 6
FARTHEST_LEARNED = 6.5  # metres
STORED_DEPTH_STEP = 1e-4  # metres, of the depth in files
UNKNOWN_CLASS = -1  # of a pixel without depth
SMALLEST_TAUGHT = 8  # pixels of a thing that weighs most for each of them
UP_NOISE = 0.03  # of a direction against gravity that an arm reports
CLASS_OF = {  # by label; things have labels from 0 on
    HOLE: UNKNOWN_CLASS,
    BACKGROUND: OUTPUT_CLASSES.index("background"),
    SURFACE: OUTPUT_CLASSES.index("surface"),
}


@dataclass(frozen=True)
class WorldMeshes:
    """Meshes that worlds are drawn of, beside generated solids.

    Attributes:
        toys: of things, of any size.
        furniture: as large as its class is in life.
    """

    toys: tuple[Entry, ...] = ()
    furniture: tuple[Entry, ...] = ()

    @classmethod
    def of(cls, toys: Path | None, furniture: Path | None) -> WorldMeshes:
        """List the meshes of folders, without those of other splits than that to train on.

        Args:
            toys: folder of things of any size; None for none.
            furniture: folder of furniture, of ModelNet10's classes; None for none.

        Raises:
            DatasetError: a folder is missing or holds no mesh to train on.
            UsageError: furniture is of a class whose size is not known.
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
        """Their names."""
        return tuple(entry.name for entry in (*self.toys, *self.furniture))

    def divided(self, share: float, seed: int) -> tuple[WorldMeshes, WorldMeshes]:
        """Return those to learn from and those to validate on.

        Args:
            share: of the meshes that is held out for validation, about.
            seed: of the draw.
        """
        rng = np.random.default_rng([seed, 2])
        parts = []
        for entries in (self.toys, self.furniture):
            out = rng.random(len(entries)) < share
            parts.append([tuple(compress(entries, side)) for side in (~out, out)])
        toys, furniture = parts
        return WorldMeshes(toys[0], furniture[0]), WorldMeshes(toys[1], furniture[1])


def _entries(folder: Path | None) -> tuple[Entry, ...]:
    """The meshes of a folder that are to train on."""
    if folder is None:
        return ()
    entries = [entry for entry in list_dataset(folder) if entry.split in ("train", "")]
    if not entries:
        raise DatasetError(f"{folder}: holds no mesh of a training split")
    return tuple(entries)


@dataclass(frozen=True)
class FrameFile:
    """A file of frames that is to be drawn.

    Attributes:
        path: of the file.
        seed: what its random numbers begin with.
        frames: how many it holds.
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
    """Plan files of equally many frames.

    Args:
        folder: of the files.
        frames: in all of them, at least.
        seed: of all draws.
        most: frames of a file.
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
    """Draw the files that are not there yet.

    Args:
        files: see ``frame_files``.
        meshes: that the worlds are drawn of, beside generated solids.
        workers: number of processes; None for one on each core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.

    Yields:
        Number of files done so far, and of all files.

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
    """Draw worlds, photograph each, and write the frames, all or none.

    Args:
        meshes: that the worlds are drawn of, beside generated solids.
        file: what to write.
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
    """Load some meshes, upright on z = 0; furniture is as large as in life.

    Those that are too fine or damaged are passed over.

    Args:
        entries: to draw from, each once.
        count: how many, at most.
        rng: draws them and their sizes.
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
    """Frames with labels, as files hold them.

    Attributes:
        depth: (N, H, W) uint16, tenths of a millimetre; 0 where nothing was measured.
        labels: see ``simulation.worlds.LabelledFrame``, (N, H, W) int16.
        pinhole: focal lengths and principal point, (N, 4) float64, pixels.
        up: direction against gravity in the camera's axes, (N, 3) float64.
    """

    depth: NDArray[np.uint16]
    labels: NDArray[np.int16]
    pinhole: Float
    up: Float

    def __len__(self) -> int:
        return len(self.depth)

    @classmethod
    def of(cls, frames: Sequence[LabelledFrame]) -> LabelledFrames:
        """Round the depth of frames, and forget what is too far."""
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
        """Write them to a file, whole or not at all."""
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
        """Return what the network learns from one frame.

        Args:
            index: of the frame.
            rng: mirrors it or not, and tilts or hides gravity; None for the frame as it is.
        """
        depth = self.depth[index].astype(np.float32) * np.float32(STORED_DEPTH_STEP)
        labels = self.labels[index]
        camera = PinholeCamera(*self.pinhole[index], *depth.shape[::-1])
        x, y = camera.image_slopes
        up = self.up[index]
        told = True
        if rng is not None:
            if rng.random() < 0.5:  # a mirrored world is as good
                depth, labels, x = depth[:, ::-1].copy(), labels[:, ::-1], -x[::-1]
                up = up * [-1, 1, 1]
            told = rng.random() < 0.5
            up = up + rng.normal(0, UP_NOISE, 3)
            up /= np.linalg.norm(up)
        rays = x.astype(np.float32), y.astype(np.float32)
        return Example.of(SmallPicture(depth, rays, 1), labels, up if told else None)


def _arrays(path: Path) -> list[NDArray]:
    """The arrays of a file, in the order of ``LabelledFrames``."""
    try:
        # opened here, as numpy would leave a damaged file open
        with path.open("rb") as file, np.load(file) as arrays:
            return [arrays[field.name] for field in fields(LabelledFrames)]
    except DAMAGED:
        raise DatasetError(
            f"{path}: is missing or damaged; delete it and give the command of the training again"
        ) from None


@dataclass(frozen=True, eq=False)
class Example:
    """What the network learns from a frame; its sides are multiples of SIDE_MULTIPLE.

    Attributes:
        features: input, see ``segmentation.features``, (C, h, w) float32.
        classes: index in OUTPUT_CLASSES, UNKNOWN_CLASS without depth, (h, w) int64.
        same: for each of AFFINITY_STEPS, whether the other pixel is of the same thing, (12, h, w)
            float32.
        compared: weight of what is learned of each pair, 0 unless both are of things, (12, h, w)
            float32.
    """

    features: Float32
    classes: Index
    same: Float32
    compared: Float32

    @classmethod
    def of(cls, picture: SmallPicture, labels: NDArray, up: Float | None) -> Example:
        """Compute what is learned from a picture.

        Args:
            picture: the picture.
            labels: of its pixels, see ``simulation.worlds.LabelledFrame``, (h, w).
            up: direction against gravity in the camera's axes, (3,); None if it is not given.
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
    """Rows and columns added below and on the right."""
    added = [(0, -size % SIDE_MULTIPLE) for size in values.shape[-2:]]
    sides = [(0, 0)] * (values.ndim - 2) + added
    return np.pad(values, sides, constant_values=value)


def pair_weights(labels: NDArray) -> Float32:
    """Weights of the pixels of things, (h, w); those of a small thing weigh more.

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
    """Whether each pixel and one farther on are of one thing, and how much that counts."""
    first, second = pair_slices(labels.shape, down, right)
    same = np.zeros(labels.shape, bool)
    compared = np.zeros(labels.shape, np.float32)
    same[first] = (labels[first] == labels[second]) & (labels[first] >= 0)
    both = (labels[first] >= 0) & (labels[second] >= 0)
    compared[first] = np.where(both, np.maximum(weights[first], weights[second]), 0)
    return same, compared


def output_scores(outputs: Float32, examples: Sequence[Example]) -> dict[str, float]:
    """Judge a network's outputs.

    Args:
        outputs: for the frames, (N, 15, h, w).
        examples: the frames.

    Returns:
        ``class_accuracy``, the share of pixels whose class is right, mean of the classes;
        ``thing_iou``, the intersection over union of the pixels of things; ``pair_accuracy``, the
        share of pairs that are rightly called of one thing or not, mean of both and of the steps.
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
