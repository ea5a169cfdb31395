"""Draw the table of ``nextview demo``, and record it as a depth camera on a wrist sees it.

    python -m benchmarks.demo_table YCB OUT [--seed 0]

YCB holds the scans of the bundled memory "ycb", in metres, by their names. Seven of them, no two of
a kind, lie on a table in a room as they fell, at true size; between them stands a toy of 14 cm that
nobody taught: a sample piece of furniture. The camera looks three times, from 0.7 m, each time a
sixth of a circle farther on. Its depth, its measured poses and the vertical have the errors of the
sensor "wrist".

The seed is not chosen by what nextview makes of the table. Seeds are tried in order from --seed,
and the first one is taken in which everything stands in view: each frame shows at least half of
every thing, and none at the border of the picture. OUT becomes a folder of depth images with poses
and intrinsics; ``truth.json`` in it has the true name, place and pose of each thing.

The recording in ``src/nextview/captured/bundled/table`` was made with --seed 0, and has seed 1. It
shows scans of the YCB object set: Calli et al., "Benchmarking in Manipulation Research", IEEE RAM
2015, CC BY 4.0.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from benchmarks.shared import mesh_of, scans_in
from nextview.cli.exit_status import orderly_end
from nextview.data.samples import SAMPLE_MESHES, sample_mesh
from nextview.errors import UsageError
from nextview.files import new_folder
from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles
from nextview.sensing.frame import Frame
from nextview.simulation.boxes import upright_boxes
from nextview.simulation.sensor import SENSORS
from nextview.types import Float
from nextview_lab.worlds.tables import (
    TABLE_HEIGHT,
    SimulatedTable,
    TableCamera,
    poses_around,
)

TAUGHT_THINGS = 7
SMALLEST = 0.05  # metres across: of a smaller thing too little is seen
TOY_RADIUS = 0.07  # metres
GAP = 0.08  # metres between neighbours, at most
FRAMES = 3
STEP = np.pi / 3  # radians from frame to frame
ELEVATION = np.radians(42.0)
DISTANCE = 0.7  # metres
CENTRE = np.array([0.0, 0.0, 0.03])
LEAST_SHOWN = 0.5  # share of a thing's pixels
DEPTH_SCALE = 0.001  # metres per step of the depth images
ATTRIBUTION = (
    "Simulated depth of scans of the YCB object set: Calli et al., Benchmarking in Manipulation"
    " Research, IEEE RAM 2015; Google 16k scans, CC BY 4.0."
)
# width, depth and height, metres; the place of the middle; the height of the lower side
ROOM = (
    ((5.0, 0.1, 2.6), (0.4, 1.3), -TABLE_HEIGHT),
    ((0.1, 4.5, 2.6), (-2.1, -0.9), -TABLE_HEIGHT),
    ((5.0, 0.1, 2.6), (0.4, -3.2), -TABLE_HEIGHT),
    ((0.1, 4.5, 2.6), (2.9, -0.9), -TABLE_HEIGHT),
    ((0.5, 1.6, 0.8), (-1.8, -0.4), -TABLE_HEIGHT),
    ((1.2, 0.4, 1.9), (1.8, 1.05), -TABLE_HEIGHT),
)
"""Four walls, a sideboard and a cupboard."""


@dataclass(frozen=True)
class Recording:
    """Frames of a table.

    Attributes:
        seed: of the table.
        frames: as the sensor gives them.
        truth: pose of each thing's file in the robot's world, (4, 4), metres, by its name.
        places: middle of each thing's bounding box in the robot's world, (3,), metres.
    """

    seed: int
    frames: tuple[Frame, ...]
    truth: dict[str, Float]
    places: dict[str, Float]


def room() -> list[Triangles]:
    """What stands around the table."""
    boxes = []
    for size, place, height in ROOM:
        mesh = upright_boxes(np.array([size]), np.zeros(1), np.array([place]), height)
        boxes.append((mesh.vertices, mesh.faces))
    return boxes


def one_of_a_kind(scans: Sequence[Path], rng: np.random.Generator) -> list[Path]:
    """One scan of each kind, in a drawn order: ``a_cups`` and ``b_cups`` are of one kind.

    Args:
        scans: files.
        rng: draws.
    """
    kinds: dict[str, Path] = {}
    for row in rng.permutation(len(scans)):
        kinds.setdefault(re.sub("^[a-z]_", "", scans[row].stem), scans[row])
    return list(kinds.values())


def draw_table(scans: Sequence[Path], rng: np.random.Generator) -> SimulatedTable:
    """Some scans and a toy on a table.

    Args:
        scans: files, in metres.
        rng: draws them, and how they lie.

    Raises:
        UsageError: they do not fit on the table.
    """
    meshes: list[Mesh] = []
    for path in one_of_a_kind(scans, rng):
        mesh = mesh_of(path)
        if 2 * mesh.radius >= SMALLEST and len(meshes) < TAUGHT_THINGS:
            meshes.append(mesh)
    name = str(rng.choice(sorted(SAMPLE_MESHES)))
    toy = replace(
        sample_mesh(name),
        name=f"toy {name}",
        radius=TOY_RADIUS,
        centre=np.zeros(3),
        unit="m",
    )
    return SimulatedTable.draw([*meshes, toy], rng, GAP)


def in_view(camera: TableCamera) -> bool:
    """Whether the last frame shows at least half of each thing, and none at the border."""
    owner = camera.owner
    border = np.concatenate([owner[0], owner[-1], owner[:, 0], owner[:, -1]])
    if (border >= 0).any():
        return False

    pose = camera.true_pose
    rays = PinholeCamera.of(camera.sensor.intrinsics, camera.sensor.shape).rays
    rays = rays.reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
    for thing, shown in zip(camera.table.things, camera.shown, strict=True):
        caster = RayCaster([(thing.placed, thing.faces)])
        alone = np.isfinite(caster.cast(pose[:3, 3], rays)[0]).sum()
        if shown < LEAST_SHOWN * max(int(alone), 1):
            return False
    return True


def record(scans: Sequence[Path], first: int) -> Recording:
    """Record the first table in which everything stands in view.

    Args:
        scans: files, in metres.
        first: seed that is tried first.
    """
    for seed in count(first):
        rng = np.random.default_rng(seed)
        try:
            table = draw_table(scans, rng)
        except UsageError:  # the things do not fit
            continue

        camera = TableCamera(table, SENSORS["wrist"], rng, room())
        azimuths = rng.uniform(0, 2 * np.pi) + STEP * np.arange(FRAMES)
        frames = []

        for pose in poses_around(azimuths, ELEVATION, DISTANCE, CENTRE):
            frames.append(camera.frame(pose))
            if not in_view(camera):
                break
        else:
            places = {
                thing.name: camera.lean[:3, :3]
                @ (thing.placed.min(0) + thing.placed.max(0))
                / 2
                for thing in table.things
            }
            return Recording(seed, tuple(frames), camera.truth, places)
    raise AssertionError


def main(
    scans: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Draw the table and write the recording.

    Args:
        scans: folder of the scans.
        out: folder of the recording.
        seed: that is tried first.
        overwrite: replace files in the folder.
    """
    found = record(list(scans_in(scans, (".ply",)).values()), seed)
    with new_folder(out, overwrite, last="intrinsics.json") as folder:
        write(found, folder)
    print(f"{out}: seed {found.seed}: {', '.join(found.truth)}")


def write(found: Recording, folder: Path) -> None:
    """Write a recording into an empty folder.

    Args:
        found: the recording.
        folder: that it is written into.
    """
    for name in ("depth", "poses"):
        (folder / name).mkdir()
    for number, frame in enumerate(found.frames):
        steps = np.rint(frame.depth / DEPTH_SCALE).astype(np.uint16)
        image = Image.fromarray(steps)
        image.save(folder / f"depth/{number:06d}.png", optimize=True)
        pose = frame.camera_to_world
        np.savetxt(folder / f"poses/{number:06d}.txt", pose, fmt="%.6f")

    height, width = found.frames[0].shape
    matrix = found.frames[0].intrinsics
    camera = {
        "width": width,
        "height": height,
        "fx": matrix[0, 0],
        "fy": matrix[1, 1],
        "ppx": matrix[0, 2] - 0.5,  # the centre of the first pixel is at 0 in files
        "ppy": matrix[1, 2] - 0.5,
        "coeffs": [0.0] * 5,
        "depth_scale": DEPTH_SCALE,
    }
    (folder / "intrinsics.json").write_text(json.dumps(camera, indent=1) + "\n")
    truth = {
        "attribution": ATTRIBUTION,
        "seed": found.seed,
        "places": {name: at.round(4).tolist() for name, at in found.places.items()},
        "poses": {name: pose.round(6).tolist() for name, pose in found.truth.items()},
    }
    (folder / "truth.json").write_text(json.dumps(truth) + "\n")


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
