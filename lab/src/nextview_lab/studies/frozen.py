"""A frozen archive of depth images, rendered by MuJoCo, for ``nextview-lab submit``.

    python -m nextview_lab.studies.frozen SCANS nextview-bench-1.0
    python -m nextview_lab.studies.frozen SCANS part --things 4 --draws 1 --grid 3 4

Each thing lies in some of the seven places of ``staged_things``, by its physics, and a stereo
camera takes all candidate views of it: a grid of azimuths and elevations over where a camera can
stand. Nothing of nextview's own simulation is used. docs/submit.md describes the files and how
methods are compared on them.

All that a method is told of the cameras is drawn before the scene, and without knowing the thing
(``draw_views``); the scene is then placed so that a detector would have aimed the cameras there.

The same scans, seed and versions of the libraries give the same archive, with the same SHA-256, on
every x86-64 processor with AVX2. A run that was stopped goes on when the same command is
given again: the manifest is written last, and a folder without it is no archive.

SCANS holds NAME.ply, metres. MuJoCo is needed: ``pip install './lab[arm]'``.
"""

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
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError
from nextview.files import only_one, read_record, sha256_of, write_record
from nextview_lab.benchmark.frozen import (
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
from nextview_lab.studies.shared import scans_in
from nextview_lab.studies.staged_things import (
    CAMERA_MATRIX,
    ENOUGH_PIXELS,
    PLACES,
    STEPS_PER_METRE,
    WHERE_CAMERAS_STAND,
    Float,
    Place,
    as_told,
    camera_at,
    looked,
    rounded,
    scan_of,
    staged,
    true_pose,
)

COMPRESSION = 6  # of PNG
# metres from the cameras to their aim, between which one is drawn
DISTANCES = (0.35, 0.45)
# metres along each axis, of an episode's aim, and of each view's about it
AIM_ERROR = 0.01
# metres along x, y and z that the aim is from the world's origin
WORLD_REACH = (1.0, 1.0, 0.5)
SCENES_TRIED = 12  # until the first view shows enough of the thing
LIBRARIES = ("mujoco", "numpy", "scipy", "trimesh")  # that decide what is shown
TERMS_FILE = ".terms.json"  # which does not belong to the archive
PARTIAL = ".partial"  # ends the folder of an episode that is not whole
LICENCE = "CC BY 4.0"
SOURCE = "YCB Object and Model Set, https://www.ycbbenchmarks.com"
# its words, too, are part of the SHA-256 of an archive
CARD = """\
# {name}

{episodes} episodes: {shown} of {known} things, each in {draws} of {places} places
({names}), in {views} candidate views each. Seed {seed}.

- **What**: depth of 640 x 480 pixels in steps of 0.1 mm (`NNN.png`), the pixels of the thing
  (`NNN-mask.png`), what an arm says of the camera's pose, and which view comes first. `truth/`
  holds names, poses of the things and true poses of the cameras: only `nextview-lab leaderboard`
  reads it. A method is not shown it. The truth of 0 sealed episodes is not in the archive.
- **How**: things fall by the physics of MuJoCo and are seen along its rays. Noise is that of a
  stereo camera with a base of 55 mm: disparities with a deviation of 0.08 pixels, correlated over
  two pixels, in steps of 1/16 pixel; mixed depths and holes at edges; holes at grazing angles and
  where the second camera sees nothing; nothing beyond {farthest:g} m. Told poses are wrong by
  {millimetres:g} mm along and {degrees:g} degrees about each axis. **All of it is simulated.**
- **Cameras**: their distance ({nearest:g} to {beyond:g} m), their places, the first view and the
  world's origin and heading are drawn without knowing the thing. They are aimed at the mean of what
  a first look shows of it, with errors of {aim:g} mm along each axis for the episode and for each
  view. The first view shows {enough} pixels of the thing or more; others may show little or none.
- **Made by** `python -m nextview_lab.studies.frozen` of nextview with {made_with}.
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

    places: tuple[Place, ...] = PLACES
    things: int = 0
    draws: int = 2
    grid: tuple[int, int] = (5, 8)
    arm_error: tuple[float, float] = (3.0, 0.3)
    farthest: float = 1.5
    seed: int = 1


@dataclass(frozen=True, eq=False)
class CandidateViews:
    """The candidate views of an episode, before anything is known of the thing.

    Attributes:
        poses: of the cameras about their aim, (4, 4) each, axes of the stage, ring by ring from the
            lowest.
        world: from the aim, with axes of the stage, to the world, (4, 4).
        told: what an arm says of the cameras' poses in the world, (4, 4) each.
        first: number of the first view.
    """

    poses: list[Float]
    world: Float
    told: list[Float]
    first: int


def draw_views(
    place: Place, how: FrozenTerms, rng: np.random.Generator
) -> CandidateViews:
    """Draw all that a method is told of the cameras.

    It depends on nothing but the place: neither the thing nor its scene is known here.

    Args:
        place: where the thing will be.
        how: what the archive depends on.
        rng: draws.
    """
    left, right, low, high = WHERE_CAMERAS_STAND[place]
    rings, azimuths = how.grid
    around = right - left == 360
    turn = float(rng.uniform(0, 360)) * around
    distance = float(rng.uniform(*DISTANCES))
    poses = [
        camera_at(rng.normal(0, AIM_ERROR, 3), turn + azimuth, elevation, distance)
        for elevation in np.linspace(low, high, rings)
        for azimuth in np.linspace(left, right, azimuths, endpoint=not around)
    ]

    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    world[:3, 3] = rng.uniform(-1, 1, 3) * WORLD_REACH
    world = rounded(world)
    told = [as_told(world @ pose, how.arm_error, rng) for pose in poses]
    return CandidateViews(poses, world, told, int(rng.integers(len(poses))))


def moved(pose: Float, by: Float) -> Float:
    """Move a pose along the axes of its world.

    Args:
        pose: (4, 4), metres.
        by: (3,), metres.

    Returns:
        The moved pose, (4, 4), metres.
    """
    there = pose.copy()
    there[:3, 3] += by
    return rounded(there)


def detected(depth: NDArray[np.uint16], mask: NDArray[np.bool_], pose: Float) -> Float:
    """Mean of the points that a look shows of the thing, (3,), metres, as a detector would give it.

    Args:
        depth: of the look, (H, W), steps.
        mask: pixels of the thing, (H, W).
        pose: of the camera, (4, 4).
    """
    rows, columns = np.nonzero(mask & (depth > 0))
    ahead = depth[rows, columns] / STEPS_PER_METRE
    pixels = np.stack([columns, rows, np.ones(len(rows))])
    points = np.linalg.inv(CAMERA_MATRIX) @ pixels * ahead
    return rounded(pose[:3, :3] @ points.mean(1) + pose[:3, 3])


def scene_before(
    views: CandidateViews,
    place: Place,
    scans: Path,
    name: str,
    rng: np.random.Generator,
) -> tuple[Any, Any, Float, NDArray[np.uint16], NDArray[np.bool_]] | None:
    """A scene whose thing the first of drawn views shows; None if it cannot be shown there.

    Args:
        views: of the cameras.
        place: where the thing is.
        scans: folder of the scans.
        name: of the thing.
        rng: draws.

    Returns:
        MuJoCo's model and data with all things at rest, the aim of the cameras, (3,), metres, and
        of the first view the depth, (H, W), steps, and the pixels of the thing, (H, W).
    """
    scan = scan_of(str(scans), name)
    camera = views.poses[views.first]
    for _ in range(SCENES_TRIED):
        scene = staged(place, str(scans), name, rng)
        if scene is None:
            return None

        true = true_pose(scene[1])
        pose = moved(camera, true[:3, :3] @ scan.bounds.mean(0) + true[:3, 3])
        depth, mask = looked(*scene, pose, rng)
        if shown_pixels(depth, mask) < ENOUGH_PIXELS:
            continue

        aim = detected(depth, mask, pose) + rng.normal(0, AIM_ERROR, 3)
        depth, mask = looked(*scene, moved(camera, aim), rng)
        if shown_pixels(depth, mask) >= ENOUGH_PIXELS:
            return *scene, aim, depth, mask
    return None


def shown_pixels(depth: NDArray[np.uint16], mask: NDArray[np.bool_]) -> int:
    """How many pixels of a mask have a depth.

    Args:
        depth: (H, W), 0 for holes.
        mask: (H, W).
    """
    return int((mask & (depth > 0)).sum())


def make_episode(
    folder: Path, scans: Path, name: str, place: Place, how: FrozenTerms
) -> EpisodeTruth | None:
    """Write an episode.

    Args:
        folder: of the episode.
        scans: folder of the scans.
        name: of the thing.
        place: where it is.
        how: what the archive depends on.

    Returns:
        Its truth; None if the thing cannot be shown there.
    """
    rng = np.random.default_rng([how.seed, PLACES.index(place), *name.encode()])
    views = draw_views(place, how, rng)
    scene = scene_before(views, place, scans, name, rng)
    if scene is None:
        return None
    model, data, aim, depth, mask = scene
    first = depth, mask

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)

    pixels = []
    for number, pose in enumerate(views.poses):
        depth, mask = first
        if number != views.first:
            depth, mask = looked(model, data, moved(pose, aim), rng)
        depth[depth > how.farthest * STEPS_PER_METRE] = 0
        pixels.append(shown_pixels(depth, mask))

        place_of = folder / f"{number:03d}"
        for end, image in (("", depth), ("-mask", mask)):
            Image.fromarray(image).save(
                f"{place_of}{end}.png", compress_level=COMPRESSION
            )

    episode = FrozenEpisode(
        held=place == "held",
        first=views.first,
        metres_per_unit=1 / STEPS_PER_METRE,
        intrinsics=as_matrix(CAMERA_MATRIX),
        poses=tuple(map(as_matrix, views.told)),
    )
    write_record(folder / EPISODE_FILE, episode)

    true = rounded(views.world @ moved(true_pose(data), -aim))
    cameras = tuple(as_matrix(rounded(views.world @ pose)) for pose in views.poses)
    return EpisodeTruth(name, place, as_matrix(true), cameras, tuple(pixels))


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
    out: Path,
    scans: Path,
    names: list[str],
    shown: dict[str, str],
    how: FrozenTerms,
) -> str:
    """Write scans, things, card and manifest; the SHA-256 of the archive.

    Args:
        out: folder of the archive.
        scans: folder of the scans.
        names: of the things that may be shown.
        shown: things of the episodes, by number.
        how: what the archive depends on.
    """
    things = [
        FrozenThing(name, sha256_of(scans / f"{name}.ply"), LICENCE, SOURCE)
        for name in names
    ]
    write_record(out / THINGS_FILE, things, overwrite=True)
    (out / SCANS_FOLDER).mkdir(exist_ok=True)
    for name in names:
        shutil.copyfile(scans / f"{name}.ply", out / SCANS_FOLDER / f"{name}.ply")

    made_with = {name: version(name) for name in LIBRARIES}
    card = CARD.format(
        name=out.name,
        episodes=len(shown),
        shown=len(set(shown.values())),
        known=len(names),
        draws=how.draws,
        places=len(how.places),
        names=", ".join(how.places),
        views=how.grid[0] * how.grid[1],
        seed=how.seed,
        millimetres=how.arm_error[0],
        degrees=how.arm_error[1],
        nearest=DISTANCES[0],
        beyond=DISTANCES[1],
        aim=1000 * AIM_ERROR,
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
    new = not (out / TERMS_FILE).exists()
    if new and any(out.iterdir()):
        raise UsageError(f"{out}: is not empty")

    if new:
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
    names = list(scans_in(scans, (".ply",)))
    if not 1 <= how.draws <= len(how.places):
        raise UsageError("each thing is shown in one place or more, and in each once")
    if (out / MANIFEST).exists():
        raise UsageError(f"{out}: exists, and is whole; name another folder")

    with only_one(out):
        begin(out, names, how)
        shown = {}
        pairs = drawn(names, how)
        for row, (name, place) in enumerate(pairs):
            number = f"{row:04d}"
            folder = out / EPISODES_FOLDER / number
            if not folder.exists():
                part = folder.with_name(number + PARTIAL)
                truth = make_episode(part, scans, name, place, how)
                if truth is not None:
                    file = out / TRUTH_FOLDER / f"{number}.json"
                    write_record(file, truth, overwrite=True)
                    os.replace(part, folder)

            done = folder.exists()
            said = "done" if done else "cannot be shown there"
            print(
                f"{row + 1} of {len(pairs)}: {name}, {place}: {said}", file=sys.stderr
            )
            if done:
                shown[number] = name
        print(f"{out}: {finish(out, scans, names, shown, how)}")


if __name__ == "__main__":
    with orderly_end("the episodes that were done are kept"):
        tyro.cli(main)
