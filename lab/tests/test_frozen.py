"""The script of the frozen archive: it goes on after a stop, and is the same on each processor."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from frozen_archives import ANSWERS_ALWAYS, as_command, edited
from lab_programs import refused

pytest.importorskip("mujoco")

from nextview.errors import DatasetError
from nextview.files import read_record
from nextview_lab.benchmark.frozen import FrozenArchive, SealedTruth
from nextview_lab.benchmark.standings import leaderboard_of
from nextview_lab.benchmark.submit import SubmitOptions, submit
from nextview_lab.studies import frozen as script
from nextview_lab.studies.staged_things import staged

ROOT = Path(__file__).parents[2]
OPTIONS = "--places alone --things 2 --draws 1 --grid 1 3 --seed 3"
SURROUNDINGS = {**os.environ, "OMP_NUM_THREADS": "1"}
# what OpenBLAS, NumPy and the C library do on a processor without AVX2
OLD_PROCESSOR = {
    "OPENBLAS_CORETYPE": "Prescott",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-FMA4",
}
LAST_BITS = """
import numpy as np
from math import exp
numbers = np.random.default_rng(0).random((60, 60))
print(np.linalg.svd(numbers)[2].tobytes().hex(), np.exp(numbers).tobytes().hex())
print([exp(number) for number in numbers.flat])
"""


def make(scans, out, options=OPTIONS, **surroundings):
    return subprocess.run(
        [
            sys.executable,
            "-m",
            "nextview_lab.studies.frozen",
            scans,
            out,
            *options.split(),
        ],
        cwd=ROOT,
        env=SURROUNDINGS | surroundings,
        capture_output=True,
        text=True,
    )


def content(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture
def unseen(monkeypatch):
    """The script without its images, and with each thing staged once in each place."""
    scenes = {}

    def staged_once(place, folder, name, rng):
        if (place, name) not in scenes:
            scenes[place, name] = staged(place, folder, name, np.random.default_rng(0))
        return scenes[place, name]

    def blank(*_):
        return np.full((24, 32), 4000, np.uint16), np.ones((24, 32), bool)

    monkeypatch.setattr(script, "staged", staged_once)
    monkeypatch.setattr(script, "looked", blank)


SEALED = script.FrozenTerms(("held",), things=2, draws=1, grid=(1, 3), seed=3, sealed=3)


def test_the_truth_of_sealed_episodes_is_not_in_the_archive(
    household, tmp_path, unseen
):
    out = tmp_path / "tiny-1.0"
    script.main(household, out, SEALED)
    beside = tmp_path / "tiny-1.0-truth.json"
    truth = read_record(beside, SealedTruth, "the truth")
    frozen = FrozenArchive(out)
    assert list(truth.episodes) == ["0002", "0003", "0004"]
    assert list(frozen.truths()) == ["0000", "0001"]
    assert frozen.truths(beside) == truth.episodes
    assert len(frozen.numbers) == 5
    assert not any(truth.secret.encode() in one for one in content(out).values())
    assert sorted(path.stem for path in (out / "scans").iterdir()) == sorted(
        frozen.things
    )

    # the secret makes the same archive again, another one another sealed part
    again = tmp_path / "again/tiny-1.0"
    again.parent.mkdir()
    shutil.copy(beside, again.parent)
    script.main(household, again, SEALED)
    assert content(again) == content(out)
    assert (again.parent / beside.name).read_bytes() == beside.read_bytes()
    other = tmp_path / "other/tiny-1.0"
    script.main(household, other, SEALED)
    files = FrozenArchive(other).manifest.files
    sealed = {path for path in files if files[path] != frozen.manifest.files[path]}
    assert sealed == {f"episodes/{number}/episode.json" for number in truth.episodes}


def test_a_sealed_archive_goes_on_after_a_stop(household, tmp_path, unseen):
    out = tmp_path / "tiny-1.0"
    beside = tmp_path / "tiny-1.0-truth.json"
    script.main(household, out, SEALED)
    whole = content(out) | {"truth": beside.read_bytes()}

    (out / "manifest.json").unlink()
    (out / "episodes/0003").rename(out / "episodes/0003.partial")
    edited(beside, lambda truth: truth["episodes"].pop("0003"))
    script.main(household, out, SEALED)
    assert content(out) | {"truth": beside.read_bytes()} == whole


def test_the_leaderboard_scores_sealed_episodes_by_their_truth(
    household, tmp_path, unseen, capsys
):
    out = tmp_path / "tiny-1.0"
    script.main(household, out, SEALED)
    beside = tmp_path / "tiny-1.0-truth.json"
    truth = read_record(beside, SealedTruth, "the truth").episodes
    always = as_command(
        tmp_path,
        ANSWERS_ALWAYS.replace('"mug"', repr(truth["0003"].thing)).replace("4", "3"),
    )
    (tmp_path / "results").mkdir()
    how = SubmitOptions(command=always, name="always", version="1")
    assert submit(out, tmp_path / "results/always.json", how).whole

    boards = [
        leaderboard_of(
            tmp_path / "results", out, tmp_path / f"board {one}", truth=one, samples=100
        )
        for one in (None, beside)
    ]
    rows = [board.tables[0].rows[0] for board in boards]
    names = [[one.thing for one in FrozenArchive(out).truths().values()]]
    names.append([one.thing for one in truth.values()])
    for row, shown in zip(rows, names, strict=True):
        share = shown.count(truth["0003"].thing) / len(shown)
        assert row[1].startswith(f"{share:.3f} ")
    assert boards[0].notes[-1] == "Not scored here: 3 sealed episodes of the archive."
    assert boards[1].notes[-1] == "Not scored here: 2 open episodes of the archive."

    edited(beside, lambda value: value["episodes"]["0003"].update(thing="other"))
    said = refused(
        capsys,
        "leaderboard",
        tmp_path / "results",
        out,
        tmp_path / "board",
        "--truth",
        beside,
    )
    assert "is not the truth of the sealed episodes of tiny-1.0" in said
    with pytest.raises(DatasetError, match=r"truth.json: is missing|no such file"):
        FrozenArchive(out).truths(tmp_path / "none-truth.json")


def test_the_same_seed_gives_the_same_bytes_after_a_stop_too(household, tmp_path):
    out = tmp_path / "first/tiny-1.0"
    made = make(household, out)
    assert made.returncode == 0, made.stderr
    archive = FrozenArchive(out)
    assert archive.sha256 in made.stdout
    assert archive.manifest.name == "tiny-1.0"
    assert len(archive.numbers) == 2
    assert len(archive.things) == 10
    whole = content(out)
    assert sum(path.suffix == ".png" for path in whole) == 12

    again = make(household, out)
    assert again.returncode == 2
    assert "is whole" in again.stderr

    # what a run leaves that is stopped in the second episode
    (out / "manifest.json").unlink()
    (out / "truth/0001.json").unlink()
    (out / "episodes/0001").rename(out / "episodes/0001.partial")
    assert "was begun with other options" in make(household, out, "--seed 4").stderr
    before = (out / "episodes/0000/000.png").stat().st_mtime_ns
    assert make(household, out).returncode == 0
    assert content(out) == whole
    assert (out / "episodes/0000/000.png").stat().st_mtime_ns == before

    run = submit(out, tmp_path / "out.json", SubmitOptions("fixed"))
    assert run.whole


def last_bits(**surroundings):
    ended = subprocess.run(
        [sys.executable, "-c", LAST_BITS],
        env=SURROUNDINGS | surroundings,
        capture_output=True,
        text=True,
        check=True,
    )
    return ended.stdout


def test_another_processor_makes_the_same_archive(household, tmp_path):
    one = last_bits()
    if last_bits(**OLD_PROCESSOR) == one:
        pytest.skip("the libraries do here what they do on an old processor")

    options = "--places leaning --things 1 --draws 1 --grid 1 1 --seed 11"
    sums = []
    for number, surroundings in enumerate(({}, OLD_PROCESSOR)):
        out = tmp_path / f"{number}/tiny-1.0"
        made = make(household, out, options, **surroundings)
        assert made.returncode == 0, made.stderr
        sums.append(FrozenArchive(out).sha256)
    assert sums[0] == sums[1]
