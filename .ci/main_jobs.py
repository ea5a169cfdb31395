"""The main jobs in a base installation, on small inputs made here; each has to give the right
result. The argument says whose jobs are run: nextview, teach (its extra), or nextview-lab.

Run by ``.ci/base_installation`` in an empty working folder that holds copies of ``samples`` and
``examples``.
"""

import json
import os
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import trimesh

from nextview.geometry.mesh import load_mesh
from nextview.geometry.resting import resting_poses

EXTRAS = (
    "torch",
    "pandas",
    "gymnasium",
    "viser",
    "rerun",
    "distributed",
    "pytest",
    "skimage",
)
# degrees by which a thing is turned over: to a side on which it rests
OVER = {"rod": 90, "plate": 180, "angle": 90}
MATPLOTLIB = {".cache", ".cache/matplotlib", ".config", ".config/matplotlib"}


def run(*arguments: object, status: int = 0, program: str = "nextview") -> str:
    """What a command prints; it has to end with this status and without a traceback."""
    command = [
        str(Path(sys.executable).with_name(program)),
        *map(str, arguments),
    ]
    begun = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True)
    said = done.stdout + done.stderr
    print(
        f"{time.monotonic() - begun:5.1f} s  {program} {' '.join(command[1:])}",
        flush=True,
    )
    assert done.returncode == status, said
    assert "Traceback" not in said, said
    return said


def recognised(*arguments: object) -> dict:
    """The answer of ``nextview recognise``."""
    said = run("recognise", *arguments, "--json")
    return json.loads(said[said.index("{") : said.rindex("}") + 1])


def things() -> dict[str, trimesh.Trimesh]:
    """Things of some ten centimetres, metres, which are told apart from any side, by name."""
    rod = trimesh.creation.cylinder(0.02, 0.2, sections=48)
    plate = trimesh.creation.box((0.2, 0.16, 0.012))
    foot = trimesh.creation.box((0.14, 0.03, 0.03)).apply_translation((0.05, 0, 0))
    post = trimesh.creation.box((0.03, 0.03, 0.16)).apply_translation((0, 0, 0.08))
    return {"rod": rod, "plate": plate, "angle": trimesh.util.concatenate([foot, post])}


def no_extra_is_there() -> None:
    """What an extra or the tests bring cannot be imported."""
    there = [name for name in EXTRAS if find_spec(name) is not None]
    assert not there, f"this is no base installation: {there}"


def the_laboratory_is_not_there() -> None:
    """Neither the laboratory nor what only it needs can be imported."""
    names = ("nextview_lab", "zarr", "numcodecs", "pooch", "requests")
    there = [name for name in names if find_spec(name) is not None]
    assert not there, f"nextview brings {there}"


def learning_names_its_extra() -> None:
    """What only teaching needs is not there, and is named before any work."""
    said = run("learn", "samples", "mine", "--unit", "cm", status=2)
    assert "pip install 'nextview[teach]'" in said
    assert said.count("\n") == 1


def learn_and_recognise() -> None:
    """Things are taught, shown as they fall, and known lying on another side."""
    scans = Path("scans")
    scans.mkdir()
    for (name, mesh), ending in zip(
        things().items(),
        ("ply", "stl", "obj"),
        strict=True,
    ):
        mesh.export(scans / f"{name}.{ending}")
    run("learn", scans, "mine", "--unit", "m", "--workers", 0)

    card = json.loads(Path("mine/memory.json").read_text())
    assert set(card["classes"]) == set(things()), card["classes"]
    for name in ("rod", "angle"):  # what finds the poses that things were shown in
        poses = resting_poses(load_mesh(next(scans.glob(f"{name}.*")), unit="m"))
        assert len(poses) > 1, f"a {name} rests on several sides, not on {len(poses)}"

    for name, mesh in things().items():
        turned = trimesh.transformations.rotation_matrix(
            np.radians(OVER[name]),
            (0, 1, 0),
        )
        lying = mesh.copy().apply_transform(turned)
        for how, shown in (("as taught", mesh), ("on its side", lying)):
            shown.export("shown.ply")
            found = recognised(
                "shown.ply",
                "--models",
                "mine",
                "--unit",
                "m",
                "--start",
                3,
            )
            assert found["most_like"] == name, f"{name} {how} is {found['most_like']}"


def look_at_samples() -> None:
    """Known classes, clean and through a sensor; a figure is a picture of some size."""
    for name in ("chair", "table", "monitor"):
        found = recognised(f"samples/{name}.off", "--start", 3)
        assert found["answer"] == name, found["answer"]
    said = run(
        "recognise",
        "samples/chair.off",
        "--sensor",
        "wrist",
        "--figure",
        "episode.png",
    )
    assert "chair" in said
    assert Path("episode.png").stat().st_size > 50_000
    for _ in range(2):  # the second draws over the first
        run("demo-episode")
    assert Path("nextview_demo.png").stat().st_size > 50_000
    assert "cracker_box" in run("demo")
    assert Path("nextview_demo/table.png").stat().st_size > 50_000
    assert "cracker box" in Path("nextview_demo/table.html").read_text()


def sessions_with_frames() -> None:
    """Depth frames of a camera on an arm and before a turntable, and a captured folder."""
    for example, name in (("arm_and_object", "chair"), ("turntable", "monitor")):
        command = [sys.executable, f"examples/{example}.py", f"samples/{name}.off"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert name in done.stdout.splitlines()[-1], done.stdout
    assert "DAMAGED" not in run("list", "models")
    assert "recognise" in run("completion", "bash")
    assert "nextview-lab train" in run("train", "recogniser", status=2)


def lab(*arguments: object, status: int = 0) -> str:
    """What a command of the laboratory prints."""
    return run(*arguments, status=status, program="nextview-lab")


def captures() -> None:
    """Depth images of a mesh, which nextview recognises."""
    lab(
        "capture",
        "samples/chair.off",
        "captured",
        "--unit",
        "cm",
        "--table",
        "--viewpoints",
        12,
    )
    assert recognised("captured")["answer"] == "chair"


def stores_and_predictions() -> None:
    """A store of the samples, and what the models say of every view of it."""
    for name in ("chair", "table", "monitor"):
        place = Path("shop") / name
        place.mkdir(parents=True)
        Path(f"samples/{name}.off").rename(place / f"{name}.off")
    lab("render", "shop", "views.zarr", "--size", 112, "--workers", 0)
    assert "3 objects" in lab("predict", "views.zarr", "views.npz", "--workers", 0)
    assert "all 40 1.000" in lab(
        "predict",
        "views.zarr",
        "views.npz",
        "--workers",
        0,
        "--overwrite",
    )
    said = lab("benchmark", "classes", "views.npz", "results", status=2)
    assert "pip install 'nextview-lab[benchmark]'" in said
    assert said.count("\n") == 1
    assert lab("train", "recogniser", "--help").startswith(
        "usage: nextview-lab train recogniser"
    )
    assert "leaderboard" in lab("completion", "bash")


def nothing_unasked_is_written() -> None:
    """The home folder holds what matplotlib keeps of fonts, and nothing else."""
    home = Path(os.environ["HOME"])
    found = {path.relative_to(home).as_posix() for path in home.rglob("*")}
    strange = {
        path for path in found - MATPLOTLIB if not path.startswith(".cache/matplotlib/")
    }
    assert not strange, f"in the home folder: {sorted(strange)}"


JOBS = {
    "nextview": (
        no_extra_is_there,
        the_laboratory_is_not_there,
        learning_names_its_extra,
        look_at_samples,
        sessions_with_frames,
        nothing_unasked_is_written,
    ),
    "teach": (learn_and_recognise, nothing_unasked_is_written),
    "nextview-lab": (
        no_extra_is_there,
        captures,
        stores_and_predictions,
        nothing_unasked_is_written,
    ),
}
for job in JOBS[sys.argv[1]]:
    print(job.__name__.replace("_", " "), flush=True)
    job()
