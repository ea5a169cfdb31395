"""A small frozen archive: two things on simulated tables, by the ray caster of this package."""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
from factories import camera_over, meshes_of, view, write_scan
from PIL import Image

from nextview.files import write_record
from nextview_lab.benchmark.frozen import (
    EpisodeTruth,
    FrozenEpisode,
    FrozenThing,
    as_matrix,
    seal,
)

SHOWN = ("mug", "cracker_box")
OTHER = "banana"  # may be shown, but is not
AZIMUTHS = (10.0, 100.0, 190.0, 280.0)
STEPS_IN_METRE = 10_000

ANSWERS_ALWAYS = f"""
import json, sys
for look in map(json.loads, sys.stdin):
    assert "truth" not in look and len(look["poses"]) == {len(AZIMUTHS)}
    answer = dict(name="mug", confidence=0.7, confident=True)
    if look["free"]:
        answer["next"] = look["free"][-1]
    print(json.dumps(answer), flush=True)
"""
"""A method that calls everything a mug, and is sure of it."""


def as_command(folder: Path, code: str) -> str:
    """A command that runs some code."""
    script = folder / f"method_{hashlib.sha256(code.encode()).hexdigest()[:8]}.py"
    script.write_text(code)
    return f"{sys.executable} {script}"


def write_archive(folder: Path) -> None:
    """Write an archive of two episodes with four views each."""
    for number, (name, mesh) in enumerate(meshes_of(SHOWN).items()):
        write_episode(folder, f"{number:04d}", name, mesh)
    things = []
    for name, mesh in meshes_of((*SHOWN, OTHER)).items():
        (folder / "scans").mkdir(exist_ok=True)
        scan = write_scan(mesh, folder / "scans")
        digest = hashlib.sha256(scan.read_bytes()).hexdigest()
        things.append(FrozenThing(name, digest, "CC BY 4.0", "YCB"))
    write_record(folder / "things.json", things)
    seal(folder, "tests-1.0", 5, {})


def write_episode(folder: Path, number: str, name: str, mesh) -> None:
    episode = folder / "episodes" / number
    episode.mkdir(parents=True)
    (folder / "truth").mkdir(exist_ok=True)
    camera = camera_over([mesh])
    told, pixels = [], []
    for row, degrees in enumerate(AZIMUTHS):
        pose = view(degrees, distance=0.45)
        frame = camera.frame(pose)
        mask = (camera.owner == 0).reshape(frame.depth.shape)
        steps = np.rint(STEPS_IN_METRE * frame.depth).astype(np.uint16)
        Image.fromarray(steps).save(episode / f"{row:03d}.png")
        Image.fromarray(mask).save(episode / f"{row:03d}-mask.png")
        told.append(as_matrix(pose))
        pixels.append(int((mask & (steps > 0)).sum()))

    intrinsics = np.array(frame.intrinsics)
    intrinsics[:2, 2] -= 0.5  # to the centre of the first pixel at 0
    write_record(
        episode / "episode.json",
        FrozenEpisode(False, 0, 1 / STEPS_IN_METRE, as_matrix(intrinsics), tuple(told)),
    )
    shown = EpisodeTruth(
        name, "alone", as_matrix(camera.truth[name]), tuple(told), tuple(pixels)
    )
    write_record(folder / f"truth/{number}.json", shown)


def edited(path: Path, change) -> None:
    """Change a JSON file by a function of its value."""
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))
