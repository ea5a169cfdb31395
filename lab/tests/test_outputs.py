"""Every command that writes: what exists is refused and unchanged, --overwrite replaces it, nothing
is left beside it.

Commands that write into what they are given (measure, fit into a card) and download are not here.
"""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from factories import camera_over, meshes_of, refused, run_python, view
from PIL import Image
from programs import main

from nextview.cli.commands import NEXTVIEW
from nextview.geometry.mesh import load_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview_lab.benchmark.submit import SubmitOptions, submit
from nextview_lab.cli.commands import LABORATORY
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.writing import write_capture

ROOT = Path(__file__).parents[2]
SAMPLE = str(ROOT / "samples/chair.off")
COMMANDS = {**NEXTVIEW.commands, **LABORATORY.commands}
FITS = {name for name in COMMANDS if name.startswith("fit ")}
GAIN = "--episodes 1 --networks-per-fold 1 --inputs belief view"
SMALL = "--size 32 --epochs 1 --views-per-object 2 --batch 8 --validation-share 0.3"
WRITES = {
    "recognise": (f"recognise {SAMPLE} --max-views 1 --figure", "e.png"),
    "recognise --record": (f"recognise {SAMPLE} --max-views 1 --record", "e.rrd"),
    "look": (
        "look {capture} --models {knobs_memory} --frames 1 --figure",
        "t.png",
    ),
    "demo": ("demo --out", "folder"),
    "demo-episode": ("demo-episode --figure", "demo.svg"),
    "capture": (f"capture {SAMPLE}", "folder", "--radius 0.4 --viewpoints 12"),
    "scenes": (
        "scenes {furniture}",
        "folder",
        "--scenes 1 --levels light --split test --workers 0",
    ),
    "render": (
        "render {furniture}",
        "v.zarr",
        "--viewpoints 12 --size 16 --split test --workers 0",
    ),
    "predict": (
        "predict {views}",
        "p.npz",
        "--models {models} --maps lem --split test --workers 0",
    ),
    "learn": ("learn {scan}", "folder", "--upright --workers 0"),
    "evaluate": ("evaluate {predictions}", "folder", "--split test --samples 10"),
    "benchmark classes": (
        "benchmark classes {predictions}",
        "folder",
        "--split test --runs 1 --samples 10 --policies random",
    ),
    "benchmark things": (
        "benchmark things {knobs}",
        "folder",
        "--models {knobs_memory} --policies random --repeats 1 --views 1 2 --workers 0",
    ),
    "benchmark tables": (
        "benchmark tables {household} {scan}",
        "folder",
        "--tables 1 --seed 11 --views 1 --policies random --samples 100 --workers 0",
    ),
    "bop": (
        "bop {bop}",
        "b.csv",
        "--models ycb --ids cracker_box=2 mug=14 --frames 1",
    ),
    "submit": ("submit {archive}", "s.json", "--policy fixed --max-views 1"),
    "leaderboard": ("leaderboard {submitted} {archive}", "folder", "--samples 100"),
    "report": ("report {results}/out", "r.html"),
    "train gain": ("train gain {training}", "g.json", f"{GAIN} --folds 2 --epochs 1"),
    "train recogniser": ("train recogniser {views}", "folder", SMALL),
    "train map": ("train map {views}", "folder", SMALL),
    "train segmentation": (
        "train segmentation",
        "folder",
        "--frames 16 --width 8 --epochs 1 --batch 4 --validation-share 0.3 --workers 0",
    ),
}
"""Arguments before the output, the name of the output, and arguments after it."""
OWN_ONLY = {
    "benchmark tables",
    "benchmark things",
    "render",
    "scenes",
    "train map",
    "train recogniser",
    "train segmentation",
}
"""They go on with an unfinished output of their own, and replace no folder of anything else."""


def write_frame(folder):
    """One frame of a mug, in the layout of the bundled table."""
    frame = camera_over(list(meshes_of(["mug"]).values())).frame(view(20))
    for kind in ("depth", "poses"):
        (folder / kind).mkdir(parents=True)
    steps = np.rint(1000 * frame.depth).astype(np.uint16)
    Image.fromarray(steps).save(folder / "depth/000000.png")
    np.savetxt(folder / "poses/000000.txt", frame.pose)
    k = frame.intrinsics
    camera = {"fx": k[0, 0], "fy": k[1, 1], "depth_scale": 0.001}
    camera |= {"ppx": k[0, 2] - 0.5, "ppy": k[1, 2] - 0.5}
    (folder / "intrinsics.json").write_text(json.dumps(camera))


@pytest.fixture(scope="session")
def made(
    furniture,
    views,
    models,
    predictions,
    results,
    knobs,
    knobs_memory,
    household,
    bop,
    archive,
    tmp_path_factory,
):
    """What the commands work on; the store is a copy."""
    folder = tmp_path_factory.mktemp("made")
    training, own = folder / "p.npz", folder / "views.zarr"
    Predictions.load(predictions).of_split("train").save(training)
    shutil.copytree(views, own)
    can = load_mesh(knobs / "can.ply", unit="m")
    list(
        write_capture(can, folder / "capture", ViewSphere((40.0,), 3), 0.07, table=True)
    )
    (folder / "scan").mkdir()
    (folder / "submitted").mkdir()
    submit(
        archive, folder / "submitted/fixed.json", SubmitOptions("fixed", max_views=1)
    )
    shutil.copy(SAMPLE, folder / "scan")
    write_frame(folder / "mug_frame")
    return {
        "mug_frame": folder / "mug_frame",
        "capture": folder / "capture",
        "scan": folder / "scan",
        "furniture": furniture,
        "views": own,
        "models": models,
        "predictions": predictions,
        "results": results,
        "training": training,
        "knobs": knobs,
        "knobs_memory": knobs_memory,
        "household": household,
        "bop": bop,
        "archive": archive,
        "submitted": folder / "submitted",
    }


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_no_command_is_forgotten():
    others = {
        "measure",
        "check",
        "completion",
        "explore",
        "list",
        "download",
        "export recogniser",
        "export map",
        "export segmentation",
    }
    assert {
        name.partition(" --")[0] for name in WRITES
    } == COMMANDS.keys() - FITS - others


NOWHERE = {
    "recognise": (
        "recognise none.off --figure {}.png",
        "recognise none.off --record {}.rrd",
    ),
    "look": (
        "look none --figure {}.png",
        "look none --explorer {}.html",
        "look none --record {}.rrd",
    ),
    "demo": ("demo --out {}",),
    "demo-episode": ("demo-episode --figure {}.svg",),
    "learn": ("learn none {}",),
    "capture": ("capture none.off {}",),
    "download": ("download modelnet10 {}",),
    "scenes": ("scenes none {}",),
    "render": ("render none {}.zarr",),
    "measure": ("measure {}.zarr",),
    "train recogniser": ("train recogniser none {}",),
    "train map": ("train map none {}",),
    "train segmentation": ("train segmentation {}",),
    "train gain": ("train gain none.npz {}.json",),
    "export recogniser": ("export recogniser none none {}",),
    "export map": ("export map none none {}",),
    "export segmentation": ("export segmentation none {}",),
    "predict": ("predict none {}.npz",),
    "fit calibration": ("fit calibration none.npz {}.json",),
    "fit size": ("fit size none none.npz {}.json",),
    "fit unknown": ("fit unknown none {}.json",),
    "fit valleys": ("fit valleys none.npz {}.json",),
    "evaluate": ("evaluate none.npz {}", "evaluate none.npz good --figures {}"),
    "benchmark classes": ("benchmark classes none.npz {}",),
    "benchmark things": ("benchmark things none {}",),
    "benchmark tables": ("benchmark tables none none {}",),
    "bop": ("bop none {}.csv",),
    "submit": ("submit none {}.json",),
    "leaderboard": ("leaderboard none none {}",),
    "report": ("report none {}.html", "report none good.html --figures {}"),
}
"""The outputs of each command, all of whose inputs are missing."""
WRITE_NOTHING = {"check", "completion", "explore", "list"}


def test_every_output_of_every_command_is_in_the_table():
    assert NOWHERE.keys() == COMMANDS.keys() - WRITE_NOTHING


@pytest.mark.parametrize("line", [line for lines in NOWHERE.values() for line in lines])
def test_an_output_that_cannot_be_written_is_refused_before_an_input_is_read(
    line, tmp_path, monkeypatch, capsys
):
    """In a file; in a folder that takes no files, whatever one's rights are; by too long a name."""
    if line.startswith(("train", "export", "fit unknown")):
        pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    places = ["/proc/out"]
    if line.startswith("look"):
        places += ["file/out", "x" * 300]
    for place in places:
        said = refused(capsys, *line.format(place).split())
        assert f"{place[:100]}" in said
        assert "cannot be written (" in said
    assert contents(tmp_path) == {tmp_path / "file": b"mine"}
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("line", "package"),
    [
        ("recognise none.off --record e.rrd", "rerun"),
        ("look none --record e.rrd", "rerun"),
        ("look none --explorer e.html", "viser"),
    ],
)
def test_a_package_that_an_output_needs_is_missed_before_an_input_is_read(
    line, package, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    assert f"needs the package {package}" in refused(capsys, *line.split())


@pytest.mark.parametrize("name", WRITES)
def test_what_exists_is_refused_and_overwritten_on_demand_only(
    name,
    made,
    tmp_path,
    monkeypatch,
    capsys,
):
    if name.startswith("train"):
        pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("nextview.cli.demo.BUNDLED_TABLE", made["mug_frame"])
    before, out, *after = WRITES[name]
    command = [
        *before.format(**made).split(),
        out,
        *" ".join(after).format(**made).split(),
    ]
    main(command)
    written = contents(tmp_path)
    assert written
    tops = {path.relative_to(tmp_path).parts[0] for path in tmp_path.iterdir()}
    # nothing else is left, no lock either
    assert all(top.startswith(Path(out).stem) for top in tops), tops

    folder = (tmp_path / out).is_dir()
    mine = (
        dict.fromkeys(written, b"mine")
        if not folder
        else {tmp_path / out / "mine.txt": b"mine"}
    )
    for path in tmp_path.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for path, content in mine.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    with pytest.raises(SystemExit) as end:
        main(command)
    assert end.value.code == 2
    assert (
        capsys.readouterr()
        .err.strip()
        .splitlines()[-1]
        .startswith(("nextview: ", "nextview-lab: "))
    )
    assert contents(tmp_path) == mine

    if name in OWN_ONLY:
        return
    main([*command, "--overwrite"])
    now = contents(tmp_path)
    assert {path.relative_to(tmp_path).parts[0] for path in tmp_path.iterdir()} == tops
    if folder:
        assert now.pop(tmp_path / out / "mine.txt") == b"mine"
        assert now
    else:
        assert not [path for path, content in now.items() if content == b"mine"]


# The home folder

HOMELY = {
    "a recognition": (
        "import nextview; from nextview.cli.main import main;"
        " nextview.recognise(SAMPLE); main(['recognise', SAMPLE, '--max-views', '1'])"
    ),
    "pictures": (
        "import nextview; from nextview.cli.main import main;"
        " nextview.recognise(SAMPLE).plot('e.png');"
        " main(['learn', SCAN, 'mine', '--upright', '--workers', '0'])"
    ),
}


@pytest.mark.parametrize("job", HOMELY)
def test_a_run_writes_nothing_in_the_home_folder(job, made, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    code = f"SAMPLE, SCAN = {SAMPLE!r}, {str(made['scan'])!r}\n{HOMELY[job]}"
    hidden = (
        "ORT_DISABLE_TELEMETRY",
        "MPLCONFIGDIR",
        "XDG_CACHE_HOME",
        "XDG_CONFIG_HOME",
    )
    environment = {
        name: value for name, value in os.environ.items() if name not in hidden
    } | {"HOME": str(home)}
    done = run_python(code, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    written = {
        path.relative_to(home).parts[:2] for path in home.rglob("*") if path.is_file()
    }
    # its list of fonts
    assert written <= ({(".cache", "matplotlib")} if job == "pictures" else set())


def test_who_wants_telemetry_keeps_it():
    code = "import os, nextview; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    environment = {
        name: value
        for name, value in os.environ.items()
        if name != "ORT_DISABLE_TELEMETRY"
    }
    assert run_python(code, env=environment).stdout.strip() == "1"
    tops = ("src", "lab", "benchmarks", "research", "examples", "docs", "workflow")
    sources = [path for top in tops for path in (ROOT / top).rglob("*.py")]
    with_it = {
        path.name
        for path in sources
        if re.search(r"^\s*(import|from) onnxruntime", path.read_text(), re.M)
    }
    assert with_it == {"runtime.py"}  # all others take it from there
