"""Every command that writes: what exists is refused and unchanged, --overwrite replaces it, nothing
is left beside it.

Commands that write into what they are given (measure, fit into a card) and download are not here.
"""

import os
import shutil
from pathlib import Path

import pytest
from factories import run_python
from lab_programs import main, refused

from nextview.cli.commands import NEXTVIEW
from nextview_lab.benchmark.submit import SubmitOptions, submit
from nextview_lab.cli.commands import LABORATORY

ROOT = Path(__file__).parents[2]
SAMPLE = str(ROOT / "samples/chair.off")
COMMANDS = {**NEXTVIEW.commands, **LABORATORY.commands}
WRITES = {
    "recognise": (f"recognise {SAMPLE} --max-views 1 --figure", "e.png", ""),
    "recognise --record": (f"recognise {SAMPLE} --max-views 1 --record", "e.rrd", ""),
    "capture": (f"capture {SAMPLE}", "folder", "--radius 0.4 --viewpoints 12"),
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
    "learn": ("learn {scan}", "folder", "--unit cm --upright --workers 0"),
    "evaluate": ("evaluate {predictions}", "folder", "--split test --samples 10"),
    "benchmark classes": (
        "benchmark classes {predictions}",
        "folder",
        "--split test --runs 1 --samples 10 --policies random",
    ),
    "leaderboard": ("leaderboard {submitted} {archive}", "folder", "--samples 100"),
    "report": ("report {results}/out", "r.html", ""),
}
"""Arguments before the output, the name of the output, and arguments after it, of commands that
take seconds; all commands write by ``files.py``.
"""
OWN_ONLY = {"render"}
"""They go on with an unfinished output of their own, and replace no folder of anything else."""


@pytest.fixture(scope="session")
def made(furniture, views, models, predictions, results, archive, tmp_path_factory):
    """What the commands work on; the store is a copy."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copytree(views, folder / "views.zarr")
    (folder / "scan").mkdir()
    shutil.copy(SAMPLE, folder / "scan")
    (folder / "submitted").mkdir()
    how = SubmitOptions("fixed", max_views=1)
    submit(archive, folder / "submitted/fixed.json", how)
    return {
        "scan": folder / "scan",
        "furniture": furniture,
        "views": folder / "views.zarr",
        "models": models,
        "predictions": predictions,
        "results": results,
        "archive": archive,
        "submitted": folder / "submitted",
    }


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


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
    "evaluate": ("evaluate none.npz {}",),
    "benchmark classes": ("benchmark classes none.npz {}",),
    "benchmark things": ("benchmark things none {}",),
    "benchmark tables": ("benchmark tables none none {}",),
    "bop": ("bop none {}.csv",),
    "real": ("real none --out {}.csv",),
    "check": ("check none --figure {}.png",),
    "submit": ("submit none {}.json",),
    "leaderboard": ("leaderboard none none {}",),
    "report": ("report none {}.html",),
}
"""The outputs of each command, all of whose inputs are missing."""
WRITE_NOTHING = {"completion", "explore", "list"}


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


@pytest.mark.parametrize("name", WRITES)
def test_what_exists_is_refused_and_overwritten_on_demand_only(
    name, made, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    before, out, after = (words.format(**made) for words in WRITES[name])
    command = [*before.split(), out, *after.split()]
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
        " main(['learn', SCAN, 'mine', '--unit', 'cm', '--workers', '0'])"
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
