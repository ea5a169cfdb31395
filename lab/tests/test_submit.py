"""Methods on a frozen archive: what they are told, what is refused, and how they are compared."""

import json
import re
import shutil
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from frozen_archives import ANSWERS_ALWAYS, as_command, edited
from lab_programs import main, refused
from PIL import Image

from nextview.errors import DatasetError, ResultsError
from nextview_lab.benchmark.frozen import FrozenArchive
from nextview_lab.benchmark.methods import CommandMethod, FrozenLook, MethodAnswer
from nextview_lab.benchmark.standings import leaderboard_of
from nextview_lab.benchmark.submit import SubmitOptions, run_episode, submit
from nextview_lab.cli.benchmark_tables import print_compared

ROOT = Path(__file__).parents[2]
BLIND = SubmitOptions("fixed", max_views=2)


@pytest.fixture
def own(archive, tmp_path):
    """An archive that may be damaged."""
    return shutil.copytree(archive, tmp_path / "archive")


@pytest.fixture(scope="module")
def submitted(archive, tmp_path_factory):
    """Results of nextview, of a blind rule, and of a method that calls everything a mug."""
    folder = tmp_path_factory.mktemp("submitted")
    always = SubmitOptions(
        command=as_command(folder, ANSWERS_ALWAYS), name="mug", version="1", max_views=2
    )
    options = {"geometry": replace(BLIND, policy="geometry"), "fixed": BLIND}
    for name, how in (options | {"mug": always}).items():
        submit(archive, folder / f"{name}.json", how)
    return folder


def answering(folder, **answer):
    """Options of a method that always says the same."""
    code = (
        "import json, sys\n"
        f"for line in sys.stdin: print(json.dumps({answer!r}), flush=True)"
    )
    return SubmitOptions(
        command=as_command(folder, code), name="m", version="1", max_views=2
    )


def test_nextview_names_what_it_sees(submitted):
    found = json.loads((submitted / "geometry.json").read_text())
    names = [[said["name"] for said in one["said"]] for one in found["episodes"]]
    assert names == [["mug"] * 2, ["cracker_box"] * 2]
    assert found["method"] == "nextview geometry"
    assert not found["blind"]


def test_the_leaderboard_compares_with_the_best_blind_method(
    archive, submitted, tmp_path, capsys
):
    out = tmp_path / "board"
    main(["leaderboard", str(submitted), str(archive), str(out), "--samples", "100"])
    shown = capsys.readouterr().out
    assert "Too few to tell" in shown
    assert "The reference, nextview fixed, is the best blind method" in shown
    made = json.loads((out / "benchmark.json").read_text())
    assert made["archive_sha256"] == FrozenArchive(archive).sha256
    text = (out / "tables.md").read_text()
    rows = {
        line.split(" | ")[0].strip("| "): line.strip("| ").split(" | ")[1:]
        for line in text.split("### Differences")[0].splitlines()
    }
    assert rows["nextview geometry"][:5] == ["1.000"] * 3 + ["0.000"] * 2
    assert rows["mug"][:5] == ["0.500"] * 4 + ["0.000"]
    assert float(rows["nextview geometry"][5]) < 10  # mm
    assert "### Differences to nextview fixed" in text
    assert "| mug | right after 2 | -0.500 |" in text


def test_an_interrupted_run_goes_on(own, tmp_path):
    out = tmp_path / "out.json"

    def stopped(done, total, what):
        next(iter(done))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        submit(own, out, BLIND, track=stopped)
    assert not out.exists()

    (own / "episodes/0000/000.png").unlink()
    assert len(submit(own, out, BLIND).episodes) == 2
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"name": "mugg", "confidence": 1.0, "confident": True}, "did you mean 'mug'"),
        ({"name": "mug", "confidence": 2.0, "confident": True}, "between 0 and 1"),
        ({"name": "mug", "confidence": 1.0}, "confident"),
        (
            {"name": None, "confidence": 0.0, "confident": False},
            "one of free, not None",
        ),
        (
            {"name": None, "confidence": 0.0, "confident": False, "next": 0},
            "one of free, not 0",
        ),
        (
            {
                "name": "mug",
                "confidence": 1.0,
                "confident": True,
                "next": 1,
                "pose": np.diag([2.0, 2, 2, 1]).tolist(),
            },
            "scaled by 2",
        ),
    ],
)
def test_what_is_no_answer_is_refused(archive, tmp_path, answer, said):
    with pytest.raises(ResultsError, match=said) as raised:
        submit(archive, tmp_path / "out.json", answering(tmp_path, **answer))
    assert "episode 0000, view 1" in str(raised.value)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("for _ in range(2): print('yes', flush=True)", "'yes' was written unasked"),
        ("read(); os.write(1, b'gr\\xfc\\xdf\\n')", r"'gr\\xfc\\xdf' is not an answer"),
        ("read(); os.write(1, b'{\"name'); os._exit(7)", "is not an answer"),
        ("read(); os.kill(os.getpid(), 9)", "the process has ended"),
        ("os.close(0); os.close(1)", "the process has ended, or closed its output"),
    ],
)
def test_a_process_that_breaks_the_protocol_is_noticed(archive, tmp_path, code, said):
    code = f"import os, sys, time\nread = sys.stdin.buffer.readline\n{code}\n"
    method = CommandMethod(as_command(tmp_path, code), "m", "1")
    time.sleep(0.5)
    with closing(method), pytest.raises(ResultsError, match=said) as raised:
        run_episode(FrozenArchive(archive), "0000", method, 2)
    assert "\n" not in str(raised.value)


def test_a_method_that_does_not_answer_is_ended(archive, tmp_path, monkeypatch):
    monkeypatch.setattr("nextview_lab.benchmark.methods.ANSWER_LIMIT", 0.5)
    command = as_command(tmp_path, "import time\ntime.sleep(60)")
    how = SubmitOptions(command=command, name="sleeper", version="1")
    with pytest.raises(ResultsError, match=r"sleeper has not answered within 0\.5 s"):
        submit(archive, tmp_path / "out.json", how)


def test_a_changed_image_is_found(own, tmp_path, capsys):
    path = own / "episodes/0000/000.png"
    with Image.open(path) as image:
        pixels = np.array(image)
    pixels[0, 0] += 1
    Image.fromarray(pixels).save(path)
    said = refused(capsys, "submit", own, tmp_path / "out.json", "--policy", "fixed")
    assert "000.png: is missing, or not the file that the manifest names" in said

    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(DatasetError):
        FrozenArchive(own).view("0000", 0)
    path.unlink()
    with pytest.raises(DatasetError):
        FrozenArchive(own).view("0000", 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: v["episodes"].pop(), "episode 0001 0 times"),
        (lambda v: v.update(archive_sha256="0" * 64), "is of another archive"),
        (lambda v: v["episodes"][0]["said"].pop(), "has 1 view, not 2"),
        (lambda v: v["episodes"][0]["said"][0].update(view=1), "do not begin with 0"),
        (lambda v: v["episodes"][0]["said"][0].update(name="x"), "no thing called 'x'"),
        (
            lambda v: v["episodes"][0]["said"][0].update(pose=[[1.0] * 4] * 4),
            "episode 0000: ",
        ),
        (
            lambda v: v["episodes"][0]["said"][0].update(pose=[[0.0] * 10**6] * 4),
            "].pose[0]",
        ),
        (lambda v: v.update(method="nextview geometry"), "another file has the method"),
    ],
)
def test_a_file_of_results_that_is_not_valid_is_refused(
    archive, submitted, tmp_path, capsys, change, said
):
    folder = shutil.copytree(submitted, tmp_path / "submitted")
    edited(folder / "mug.json", change)
    heard = refused(capsys, "leaderboard", folder, archive, tmp_path / "board")
    assert "mug.json" in heard
    assert said in heard
    assert not (tmp_path / "board").exists()


NASTY = (
    "<script>alert('a')</script> \x1b[31m|`rm` \u202e_*~$\\x$ [l](https://a.b)\n# two"
)


def test_names_are_text_in_tables_and_terminals(archive, submitted, tmp_path, capsys):
    folder = shutil.copytree(submitted, tmp_path / "submitted")
    edited(folder / "fixed.json", lambda v: v.update(method=NASTY, version="<b>|"))
    print_compared(leaderboard_of(folder, archive, tmp_path / "board", samples=100))
    in_terminal = capsys.readouterr()
    tables = (tmp_path / "board/tables.md").read_text(encoding="utf-8")
    for text in (in_terminal.out, in_terminal.err, tables):
        assert not set(text) & {"\x1b", "\u202e"}
        assert "# two" not in text.splitlines()
    assert "<script" not in tables


def test_a_policy_that_does_not_exist_is_refused_with_those_that_do(
    archive, tmp_path, capsys
):
    out = tmp_path / "out.json"
    said = refused(capsys, "submit", archive, out, "--policy", "geometri")
    assert all(name in said for name in ("'geometri'", "geometry", "ring", "MODULE"))


def test_the_page_names_all_that_a_method_reads_and_writes():
    page = (ROOT / "docs/submit.md").read_text(encoding="utf-8")
    cells = [row.split("|")[1] for row in page.splitlines() if row.startswith("| `")]
    named = set(re.findall(r"`(\w+)`", " ".join(cells)))
    for record in (FrozenLook, MethodAnswer):
        assert set(record.__struct_fields__) <= named


def test_the_method_of_the_page_runs(archive, tmp_path):
    page = (ROOT / "docs/submit.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.S)
    (tmp_path / "results").mkdir()
    how = SubmitOptions(
        command=as_command(tmp_path, code), name="all mugs", version="1"
    )
    submit(archive, tmp_path / "results/mugs.json", how)
    board = leaderboard_of(
        tmp_path / "results", archive, tmp_path / "board", samples=100
    )
    right = board.measures.query("measure == 'right'")
    assert right["value"].tolist() == [0.5] * 3
