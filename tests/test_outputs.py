"""Outputs replace nothing but what nextview wrote, and a run that is refused, killed or out of room loses nothing."""

import hashlib
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from test_predictions import some_predictions

from nextview.benchmark import results
from nextview.cli.benchmark import benchmark
from nextview.cli.main import main
from nextview.cli.report import report
from nextview.data.lock import only_one
from nextview.data.predicting import _begin, _end
from nextview.data.predictions import Predictions
from nextview.errors import DatasetError, EntryError, PredictionsError, ResultsError
from nextview.outputs import check_file, check_folder, left_by_a_cut, written_results, written_whole
from nextview.report.elements import GENERATOR


@pytest.fixture
def predictions(tmp_path):
    some_predictions(6).save(tmp_path / "p.npz")
    return tmp_path / "p.npz"


def run(predictions, out, command="benchmark"):
    quick = {"benchmark": ["--policies", "random", "--runs", "1", "--samples", "5"], "evaluate": ["--samples", "5"]}
    main([command, str(predictions), "--out", str(out), *quick[command]])


def tree(folder):
    """All that is in a folder: names, kinds, contents, and where links point."""

    def what(path):
        if path.is_symlink():
            return os.readlink(path)
        return path.read_bytes() if path.is_file() else None

    return {str(path.relative_to(folder)): what(path) for path in sorted(folder.rglob("*"))}


def refused(capsys, predictions, out, command="benchmark"):
    """The one sentence with which a command ends in status 2, having touched nothing."""
    before = tree(predictions.parent)
    with pytest.raises(SystemExit) as stopped:
        run(predictions, out, command)
    message = capsys.readouterr()
    assert stopped.value.code == 2
    assert message.out == ""
    assert message.err.count("\n") == 1
    assert tree(predictions.parent) == before
    return message.err


def write(folder, text, kind="benchmark"):
    with written_results(folder, kind) as new:
        (new / "numbers.csv").write_text(text)


def hidden(folder):
    """What runs have left beside their outputs."""
    return [path for path in folder.iterdir() if path.name.startswith(".nextview-")]


@pytest.mark.parametrize(("command", "mark"), [("benchmark", "benchmark.json"), ("evaluate", "evaluate.html")])
@pytest.mark.parametrize(
    "manifest",
    [None, "{}", "[]", "not JSON", '{"program": "nextview", "kind": "another", "files": {}}',
     '{"program": "nextview", "kind": "KIND", "files": {"../p.npz": {"size": 1, "sha256": ""}}}',
     '{"program": "nextview", "kind": "KIND", "files": {}}',
     '{"program": "nextview", "kind": "KIND", "files": {"MARK": {"size": 2, "sha256": "0"}, "src": {"size": 1, '
     '"sha256": ""}}}'],
)  # fmt: skip
def test_a_folder_of_other_things_survives(predictions, capsys, command, mark, manifest):
    mine = predictions.parent / "mine"
    (mine / "src").mkdir(parents=True)
    (mine / mark).write_text("{}")
    (mine / "src" / "thesis.py").write_text("years of work")
    if manifest is not None:
        kind = {"benchmark": "benchmark", "evaluate": "evaluation"}[command]
        (mine / "manifest.json").write_text(manifest.replace("KIND", kind).replace("MARK", mark))
    assert f"{mine}: " in refused(capsys, predictions, mine, command)


@pytest.mark.parametrize("command", ["benchmark", "evaluate"])
def test_results_are_replaced_while_they_are_as_they_were_written(predictions, capsys, command):
    out = predictions.parent / "out"
    before = os.umask(0o027)
    try:
        run(predictions, out, command)
    finally:
        os.umask(before)
    assert stat.S_IMODE(out.stat().st_mode) == 0o750
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["files"] == {
        path.name: {"size": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        for path in out.iterdir()
        if path.name != "manifest.json"
    }
    inode = out.stat().st_ino
    run(predictions, out, command)
    assert out.stat().st_ino != inode
    assert hidden(out.parent) == []
    (out / "notes.txt").write_text("mine")
    capsys.readouterr()
    assert "notes.txt" in refused(capsys, predictions, out, command)
    (out / "notes.txt").unlink()
    table = next(path for path in sorted(out.glob("*.csv")) if b"0" in path.read_bytes())
    table.write_bytes(table.read_bytes().replace(b"0", b"1"))  # as long as before
    assert f"{table.name} has changed" in refused(capsys, predictions, out, command)
    table.rename(predictions.parent / "moved.csv")
    run(predictions, out, command)  # what was taken out cannot be lost
    (out / table.name).unlink()
    (out / table.name).symlink_to(predictions.parent / "moved.csv")
    capsys.readouterr()
    assert f"{table.name} has changed" in refused(capsys, predictions, out, command)


@pytest.mark.parametrize("command", ["benchmark", "evaluate"])
def test_folders_whose_names_end_in_part_are_nobodys_leftovers(predictions, command):
    mine = predictions.parent / "out.part"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    run(predictions, predictions.parent / "out", command)
    assert tree(mine) == {"thesis.txt": b"years of work"}


def test_a_place_that_cannot_be_written_is_refused_before_any_work(predictions, capsys, monkeypatch):
    monkeypatch.setattr(Predictions, "load", lambda path: pytest.fail("the work has begun"))
    home = predictions.parent
    (home / "real").mkdir()
    (home / "link").symlink_to("real")
    (home / "dangling").symlink_to("nowhere")
    (home / "file").write_text("mine")
    for out, sentence in {
        "link": "is a link", "link/": "is a link", "dangling": "is a link", "file": "is a file",
        "file/out": "file is not a folder", "file/a/b": "file is not a folder",
        "real/" + "x" * 300: "name too long",
    }.items():  # fmt: skip
        for command in ("benchmark", "evaluate"):
            assert sentence in refused(capsys, predictions, f"{home}/{out}", command)
    monkeypatch.chdir(home / "real")
    for out in (".", "..", "../real", home / "real", home):
        assert "working folder" in refused(capsys, predictions, out)


@pytest.mark.parametrize("out", ["out", "a/b", "there"])
def test_a_folder_without_permission_to_write_is_refused_before_any_work(tmp_path, out):
    (tmp_path / "there").mkdir(mode=0o500)
    if os.access(tmp_path / "there", os.W_OK):
        pytest.skip("this user may write everywhere")
    if out != "there":
        tmp_path.chmod(0o500)
    try:
        with pytest.raises(ResultsError, match=r"cannot be written \(.*ermission"):
            check_folder(tmp_path / out, "benchmark")
    finally:
        tmp_path.chmod(0o700)


HOLDS = """
import sys
from pathlib import Path
from nextview.outputs import written_results

with written_results(Path(sys.argv[1]), "benchmark") as new:
    print("holds", flush=True)
    sys.stdin.read()
    (new / "numbers.csv").write_text("first")
"""


def test_of_two_runs_into_one_folder_the_second_is_refused(predictions, capsys):
    out = predictions.parent / "out"
    (predictions.parent / "link").symlink_to(".")
    command = [sys.executable, "-c", HOLDS, out]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "holds\n"
        for way in (out, predictions.parent / "link" / "out"):
            assert "another run" in refused(capsys, predictions, way)
        first.stdin.close()
        assert first.wait() == 0
    assert (out / "numbers.csv").read_text() == "first"
    run(predictions, out)
    assert results.load(out).settings["runs"] == 1


def test_a_lock_is_never_taken_of_what_something_else_keeps_in_a_file_of_its_name(tmp_path):
    (tmp_path / "poetry.lock").write_text("years of work")
    with pytest.raises(DatasetError, match=r"poetry\.lock: is there and is no lock"), only_one(tmp_path / "poetry"):
        pass
    (tmp_path / "other.lock").symlink_to("new")
    with pytest.raises(DatasetError, match=r"other\.lock: is there and is no lock"), only_one(tmp_path / "other"):
        pass
    assert tree(tmp_path) == {"poetry.lock": b"years of work", "other.lock": "new"}


KILLED = """
import os, signal, sys
from pathlib import Path
from nextview.outputs import written_results

out, left = Path(sys.argv[1]), int(sys.argv[2])

def count(event, arguments):
    global left
    if event in ("os.rename", "os.remove", "os.rmdir"):
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left -= 1

with written_results(out, "benchmark") as new:
    (new / "numbers.csv").write_text("new")
    sys.addaudithook(count)
"""


def test_a_run_killed_at_any_step_of_the_exchange_leaves_whole_results(tmp_path):
    found = []
    for steps in range(100):
        home = tmp_path / str(steps)
        home.mkdir()
        out = home / "out"
        write(out, "old")
        ended = subprocess.run([sys.executable, "-c", KILLED, out, str(steps)], check=False).returncode
        if ended == 0:
            break
        assert ended == -signal.SIGKILL
        left = left_by_a_cut(out, "benchmark")
        assert out.exists() == (left is None)
        at = out if left is None else left
        files = json.loads((at / "manifest.json").read_text())["files"]
        assert sorted(path.name for path in at.iterdir()) == sorted([*files, "manifest.json"])
        found.append((out.exists(), (at / "numbers.csv").read_text()))
        with pytest.raises(InterruptedError), written_results(out, "benchmark"):  # the next run fails
            raise InterruptedError
        assert (out / "numbers.csv").read_text() == found[-1][1]
        write(out, "newer")
        assert (out / "numbers.csv").read_text() == "newer"
    assert found[:3] == [(True, "old"), (False, "new"), (True, "new")]
    assert set(found[3:]) == {(True, "new")}
    assert hidden(tmp_path / "1") == []  # what the cut run left was finished


def test_results_that_a_killed_run_left_aside_are_named_and_put_back(predictions, capsys):
    out = predictions.parent / "out"
    run(predictions, out)
    aside = predictions.parent / ".nextview-out-abcd1234"
    aside.mkdir()
    shutil.copytree(out, aside / "new")
    out.rename(aside / "old")
    with pytest.raises(ResultsError, match=r"rename .*abcd1234/new to it"):
        results.load(out)
    (aside / "new" / "summary.csv").write_text("cut off")  # only the old ones are whole
    with pytest.raises(ResultsError, match=r"rename .*abcd1234/old to it"):
        report(out)
    with pytest.raises(EntryError):
        benchmark(predictions, out=out, policies=("best-99",), reference="best-99", runs=1, samples=5)
    assert results.load(out).settings["policies"] == ["random"]


def test_another_folders_leftovers_are_not_taken_for_ones_own(tmp_path):
    for name in (".nextview-out-a-abcd1234", ".nextview-out-abc"):
        for part in ("old", "new"):
            write(tmp_path / name / part, "x")
    assert left_by_a_cut(tmp_path / "out", "benchmark") is None
    assert left_by_a_cut(tmp_path / "out-a", "benchmark") == tmp_path / ".nextview-out-a-abcd1234" / "new"
    assert left_by_a_cut(tmp_path / "out-a", "evaluation") is None


def test_what_a_user_puts_there_during_a_run_survives_and_so_do_the_new_results(tmp_path):
    out = tmp_path / "out"
    write(out, "old")

    def disturbed():
        with written_results(out, "benchmark") as new:
            (new / "numbers.csv").write_text("new")
            (out / "thesis.txt").write_text("years of work")

    with pytest.raises(ResultsError, match=r"thesis\.txt.*the new results are in") as caught:
        disturbed()
    assert (out / "thesis.txt").read_text() == "years of work"
    assert (out / "numbers.csv").read_text() == "old"
    assert (Path(str(caught.value).split(" are in ")[1]) / "numbers.csv").read_text() == "new"


FULL = """
import resource, sys
from nextview.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
main(sys.argv[2:])
"""


@pytest.mark.parametrize("command", ["benchmark", "evaluate"])
def test_out_of_room_the_old_results_are_still_there(predictions, command):
    out = predictions.parent / "out"
    run(predictions, out, command)
    before = tree(predictions.parent)
    for room in (500, 2000):  # bytes that a file may have
        arguments = [command, predictions, "--out", out, "--samples", "5"]
        done = subprocess.run(
            [sys.executable, "-c", FULL, str(room), *arguments], capture_output=True, text=True, check=False,
            env=os.environ | {"MPLCONFIGDIR": str(predictions.parent)},
        )  # fmt: skip
        assert done.returncode == 2, done.stderr
        assert done.stderr.splitlines()[-1] == f"nextview: {out}: cannot be written (File too large)"
        assert {name: it for name, it in tree(predictions.parent).items() if "fontlist" not in name} == before


def test_a_report_is_one_of_the_results_and_replaces_only_itself(predictions, capsys):
    out, home = predictions.parent / "out", predictions.parent
    run(predictions, out)
    report(out)
    report(out)
    page = (out / "report.html").read_bytes()
    noted = json.loads((out / "manifest.json").read_text())["files"]["report.html"]
    assert noted == {"size": len(page), "sha256": hashlib.sha256(page).hexdigest()}
    assert hidden(home) == []
    (out / "report.html").write_bytes(page + b"<!-- my notes -->")
    with pytest.raises(ResultsError, match=r"report\.html: is there and is not as nextview wrote it"):
        report(out)
    capsys.readouterr()
    assert "report.html has changed" in refused(capsys, predictions, out)
    (out / "report.html").write_bytes(page)
    run(predictions, out)
    assert not (out / "report.html").exists()
    (out / "report.html").write_text("mine")
    with pytest.raises(ResultsError, match="not as nextview wrote it"):
        report(out)
    with pytest.raises(ResultsError, match=r"called report\.html"):
        report(out, out=out / "summary.csv")
    assert (out / "report.html").read_text() == "mine"

    (home / "page.html.part").write_text("mine")
    report(out, out=home / "page.html")
    report(out, out=home / "page.html")
    assert GENERATOR in (home / "page.html").read_text()
    (home / "thesis.tex").write_text("years of work")
    with pytest.raises(ResultsError, match=r"thesis\.tex: is there and is no page"):
        report(out, out=home / "thesis.tex")
    assert (home / "thesis.tex").read_text() == "years of work"
    assert (home / "page.html.part").read_text() == "mine"


def test_a_file_that_cannot_be_written_is_refused_before_any_work(tmp_path):
    (tmp_path / "link").symlink_to("file")
    (tmp_path / "file").write_text("mine")
    for name, sentence in {"link": "is a link", ".": "is a folder", "file/below": "file is not a folder"}.items():
        with pytest.raises(ResultsError, match=sentence):
            check_file(tmp_path / name)
    check_file(tmp_path / "file")


def test_a_file_is_replaced_when_the_new_one_is_whole(tmp_path):
    (tmp_path / "a.txt").write_text("old")

    def fails():
        with written_whole(tmp_path / "a.txt") as part:
            part.write_text("new")
            raise InterruptedError

    with pytest.raises(InterruptedError):
        fails()
    assert tree(tmp_path) == {"a.txt": b"old"}
    with written_whole(tmp_path / "a.txt") as part:
        part.write_text("new")
    assert tree(tmp_path) == {"a.txt": b"new"}


def test_saving_predictions_and_beginning_them_leaves_what_is_called_part(tmp_path):
    for name in ("p.npz.part", "p.npz.part.npz"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "thesis.txt").write_text("years of work")
    before = tree(tmp_path)
    some_predictions().save(tmp_path / "p.npz")
    with pytest.raises(PredictionsError, match="is not the unfinished work of this very run"):
        _begin(tmp_path / "p.npz.part", {"names": ("a",)}, {"logits": (1, 2, 3)})
    assert {name: it for name, it in tree(tmp_path).items() if name != "p.npz"} == before

    part = tmp_path / "q.npz.part"
    _begin(part, {"names": ("a",)}, {"logits": (1, 2, 3)})["logits"][0, 1, 2] = 4
    assert _begin(part, {"names": ("a",)}, {"logits": (1, 2, 3)})["logits"][0, 1, 2] == 4
    with pytest.raises(PredictionsError, match="is not the unfinished work"):
        _begin(part, {"names": ("b",)}, {"logits": (1, 2, 3)})
    (part / "notes.txt").write_text("mine")
    _end(part, ["logits"])
    assert tree(part) == {"notes.txt": b"mine"}
    assert hidden(tmp_path) == []


KILLED_ASIDE = """
import os, signal, sys
from pathlib import Path
from nextview.outputs import written_results, written_whole

if sys.argv[2] == "file":
    with written_whole(Path(sys.argv[1])) as part:
        part.write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)
with written_results(Path(sys.argv[1]), "benchmark") as new:
    (new / "numbers.csv").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("what", ["file", "results"])
def test_what_a_killed_run_left_is_removed_by_the_next_but_not_what_is_in_use(tmp_path, what):
    out = tmp_path / "out"
    assert subprocess.run([sys.executable, "-c", KILLED_ASIDE, out, what], check=False).returncode == -signal.SIGKILL
    (left,) = hidden(tmp_path)
    others = tmp_path / ".nextview-out-2-abcd1234"  # of the place "out-2"
    others.mkdir()
    if what == "file":
        with written_whole(out) as part:
            part.write_text("first")
            with written_whole(out) as again:
                again.write_text("second")
            assert part.read_text() == "first"
            assert not left.exists()
        assert out.read_text() == "first"
    else:
        write(out, "new")
        assert (out / "numbers.csv").read_text() == "new"
    assert hidden(tmp_path) == [others]
