"""A frozen archive of depth images, rendered by MuJoCo, for ``nextview submit``.

    python -m benchmarks.frozen SCANS nextview-bench-1.0
    python -m benchmarks.frozen SCANS part --things 4 --draws 1 --grid 3 4

Each thing lies in some of seven places (``benchmarks/places.py`` says what they are), by the
physics of ``benchmarks/staged_things.py``, and a stereo camera takes all candidate views of it:
a grid of azimuths and elevations over where a camera can stand. Nothing of nextview's own
simulation is used. docs/submit.md describes the files and how methods are compared on them.

The same scans, seed and versions of the libraries give the same archive, with the same SHA-256, on
every x86-64 processor with AVX2. A run that was stopped goes on when the same command is given
again: the manifest is written last, and a folder without it is no archive. SCANS holds NAME.ply,
metres. It runs from the folder of the repository and needs ``mujoco`` (``research[arm]``).
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tyro
from PIL import Image

from benchmarks.shared import names_to_stage
from benchmarks.staged_things import (
    CAMERA_MATRIX,
    ENOUGH_PIXELS,
    WHERE_CAMERAS_STAND,
    Float,
    Place,
    as_told,
    camera_at,
    camera_distance,
    looked,
    scan_of,
    staged,
    true_pose,
)
from nextview.benchmark.frozen import (
    EPISODE_FILE,
    EPISODES_FOLDER,
    MANIFEST,
    SCANS_FOLDER,
    THINGS_FILE,
    TRUTH_FOLDER,
    EpisodeTruth,
    FrozenEpisode,
    FrozenThing,
    as_matrix,
    seal,
)
from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError
from nextview.files import only_one, read_record, sha256_of, write_record

FROZEN_PLACES: tuple[Place, ...] = (
    "alone",
    "shelf",
    "stack",
    "bin",
    "bowl",
    "leaning",
    "held",
)
STEPS_PER_METRE = 10_000  # of the depth images: 0.1 mm
COMPRESSION = 6  # of PNG
LIBRARIES = ("mujoco", "numpy", "scipy", "trimesh")  # that decide what is shown
TERMS_FILE = ".terms.json"  # which does not belong to the archive
PARTIAL = ".partial"  # ends the folder of an episode that is not whole
LICENCE = "CC BY 4.0"
SOURCE = "YCB Object and Model Set, https://www.ycbbenchmarks.com"
CARD = """\
# {name}

{episodes} episodes: {shown} of {known} things, each in {draws} of {places} places
({names}), in {views} candidate views each. Seed {seed}.

- **What**: depth of 640 x 480 pixels in steps of 0.1 mm (`NNN.png`), the pixels of the thing
  (`NNN-mask.png`), what an arm says of the camera's pose, and which view comes first. `truth/`
  holds names, poses of the things and true poses of the cameras: only `nextview leaderboard` reads
  it. A method is not shown it; who wants to be sure moves it away.
- **How**: things fall by the physics of MuJoCo and are seen along its rays. Noise is that of a
  stereo camera with a base of 55 mm: disparities with a deviation of 0.08 pixels, correlated over
  two pixels, in steps of 1/16 pixel; mixed depths and holes at edges; holes at grazing angles and
  where the second camera sees nothing; nothing beyond {farthest:g} m. Told poses are wrong by
  {millimetres:g} mm along and {degrees:g} degrees about each axis. **All of it is simulated.**
- **First view**: drawn among those that show {enough} pixels of the thing or more. Other views may
  show little or nothing of it.
- **Made by** `python -m benchmarks.frozen` of nextview with {made_with}.
  The same scans, seed and versions give the same archive on every x86-64 processor with AVX2.
- **Licences**: `scans/` are of the {source},
  {licence}, as they were given to the script. Images and poses are derived from them, under the
  same licence.
- **Checksum**: the SHA-256 of `manifest.json`, which names every file with its own, and every image
  with that of its pixels.
"""


@dataclass(frozen=True)
class FrozenTerms:
    """What an archive depends on.

    Attributes:
        places: where the things may be.
        things: how many of them are shown, drawn by the seed; 0 for all.
        draws: in how many of the places each of them is shown.
        grid: elevations and azimuths of the candidate views.
        arm_error: standard deviations of the camera's poses along and about each axis, mm, degrees.
        farthest: metres, beyond which the camera measures nothing.
        seed: of everything random.
    """

    places: tuple[Place, ...] = FROZEN_PLACES
    things: int = 0
    draws: int = 2
    grid: tuple[int, int] = (5, 8)
    arm_error: tuple[float, float] = (3.0, 0.3)
    farthest: float = 1.5
    seed: int = 1


def candidate_poses(
    place: Place, aim: Float, distance: float, how: FrozenTerms, turn: float
) -> list[Float]:
    """True poses of the candidate views, (4, 4) each, ring by ring from the lowest."""
    left, right, low, high = WHERE_CAMERAS_STAND[place]
    rings, azimuths = how.grid
    around = right - left == 360
    steps = np.linspace(left, right, azimuths, endpoint=not around)
    return [
        camera_at(aim, turn * around + azimuth, elevation, distance)
        for elevation in np.linspace(low, high, rings)
        for azimuth in steps
    ]


def make_episode(
    folder: Path, truth: Path, scans: Path, name: str, place: Place, how: FrozenTerms
) -> bool:
    """Write an episode and its truth; whether the thing can be shown there."""
    numbers = [how.seed, FROZEN_PLACES.index(place), *name.encode()]
    rng = np.random.default_rng(numbers)
    found = staged(place, str(scans), name, rng)
    if found is None:
        return False

    (model, data), _ = found
    true = true_pose(data)
    scan = scan_of(str(scans), name)
    middle = true[:3, :3] @ scan.bounds.mean(0) + true[:3, 3]
    aim = middle + rng.normal(0, 0.005, 3)
    turn = float(rng.uniform(0, 360))
    poses = candidate_poses(place, aim, camera_distance(scan), how, turn)
    told = [as_told(pose, how.arm_error, rng) for pose in poses]

    partial = folder.with_name(folder.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    pixels = []
    for number, pose in enumerate(poses):
        depth, mask = looked(model, data, pose, rng, STEPS_PER_METRE)
        depth[depth > how.farthest * STEPS_PER_METRE] = 0
        pixels.append(int((mask & (depth > 0)).sum()))
        place_of = partial / f"{number:03d}"
        for end, image in (("", depth), ("-mask", mask)):
            Image.fromarray(image).save(
                f"{place_of}{end}.png", compress_level=COMPRESSION
            )

    enough = np.flatnonzero(np.array(pixels) >= ENOUGH_PIXELS)
    if not len(enough):
        shutil.rmtree(partial)
        return False
    episode = FrozenEpisode(
        held=place == "held",
        first=int(rng.choice(enough)),
        metres_per_unit=1 / STEPS_PER_METRE,
        intrinsics=as_matrix(CAMERA_MATRIX),
        poses=tuple(map(as_matrix, told)),
    )
    write_record(partial / EPISODE_FILE, episode)
    cameras = tuple(map(as_matrix, poses))
    shown = EpisodeTruth(name, place, as_matrix(true), cameras, tuple(pixels))
    write_record(truth, shown, overwrite=True)
    os.replace(partial, folder)
    return True


def drawn(names: list[str], how: FrozenTerms) -> list[tuple[str, Place]]:
    """Things and places in a random order, which numbers of episodes follow."""
    rng = np.random.default_rng([how.seed, len(names)])
    shown = rng.permutation(names)[: how.things or None].tolist()
    pairs = [
        (name, how.places[row])
        for name in shown
        for row in rng.permutation(len(how.places))[: how.draws]
    ]
    return [pairs[row] for row in rng.permutation(len(pairs))]


def finish(
    out: Path, scans: Path, names: list[str], pairs: list[Any], how: FrozenTerms
) -> str:
    """Write scans, things, card and manifest; the SHA-256 of the archive."""
    shown = sorted({name for name, _ in pairs})
    things = [
        FrozenThing(name, sha256_of(scans / f"{name}.ply"), LICENCE, SOURCE)
        for name in names
    ]
    write_record(out / THINGS_FILE, things, overwrite=True)
    (out / SCANS_FOLDER).mkdir(exist_ok=True)
    for name in shown:
        shutil.copyfile(scans / f"{name}.ply", out / SCANS_FOLDER / f"{name}.ply")

    made_with = {name: version(name) for name in LIBRARIES}
    card = CARD.format(
        name=out.name,
        episodes=len(pairs),
        shown=len(shown),
        known=len(names),
        draws=how.draws,
        places=len(how.places),
        names=", ".join(how.places),
        views=how.grid[0] * how.grid[1],
        seed=how.seed,
        millimetres=how.arm_error[0],
        degrees=how.arm_error[1],
        farthest=how.farthest,
        enough=ENOUGH_PIXELS,
        made_with=", ".join(f"{one} {which}" for one, which in made_with.items()),
        source=SOURCE,
        licence=LICENCE,
    )
    (out / "README.md").write_text(card, encoding="utf-8")

    return seal(out, out.name, how.seed, made_with)


def begin(out: Path, names: list[str], how: FrozenTerms) -> None:
    """Note the terms of a new archive, or compare them with those that it was begun with."""
    known = hashlib.sha256(str(names).encode()).hexdigest()
    terms = msgspec.json.decode(msgspec.json.encode({**asdict(how), "scans": known}))
    out.mkdir(parents=True, exist_ok=True)
    if not (out / TERMS_FILE).exists():
        if any(out.iterdir()):
            raise UsageError(f"{out}: is not empty")
        write_record(out / TERMS_FILE, terms)
    if read_record(out / TERMS_FILE, dict, "the terms of an archive") != terms:
        raise UsageError(f"{out}: was begun with other options")
    for folder in (EPISODES_FOLDER, TRUTH_FOLDER):
        (out / folder).mkdir(exist_ok=True)


def main(
    scans: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    how: tyro.conf.OmitArgPrefixes[FrozenTerms] = FrozenTerms(),
) -> None:
    """Make an archive, or go on with one that was stopped.

    Args:
        scans: folder of the scans of all things that may be shown, NAME.ply, in metres; with those
            of the YCB set that a stack and a bowl need.
        out: folder of the archive; its name is the archive's, such as nextview-bench-1.0.
        how: what it depends on.
    """
    names = names_to_stage(scans)
    if not 1 <= how.draws <= len(how.places):
        raise UsageError("each thing is shown in one place or more, and in each once")
    if (out / MANIFEST).exists():
        raise UsageError(f"{out}: exists, and is whole; name another folder")

    with only_one(out):
        begin(out, names, how)
        pairs = drawn(names, how)
        whole = []
        for row, (name, place) in enumerate(pairs):
            folder = out / EPISODES_FOLDER / f"{row:04d}"
            truth = out / TRUTH_FOLDER / f"{row:04d}.json"
            done = folder.exists() or make_episode(
                folder, truth, scans, name, place, how
            )
            said = "done" if done else "cannot be shown there"
            print(
                f"{row + 1} of {len(pairs)}: {name}, {place}: {said}", file=sys.stderr
            )
            if done:
                whole.append((name, place))
        print(f"{out}: {finish(out, scans, names, whole, how)}")


if __name__ == "__main__":
    with orderly_end("the episodes that were done are kept"):
        tyro.cli(main)
