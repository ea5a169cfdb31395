"""How commands end: at signals, and where standard output is full or closed; and help in any width."""

import logging
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import trimesh

from nextview.cli.ending import Terminated, orderly_end
from nextview.cli.main import main
from nextview.data.store import ViewStore

COMMAND = [sys.executable, "-m", "nextview.cli.main"]


def popen(command, **options):
    """A process that Ctrl-C reaches, also where these tests run in the background of a shell, which ignores it."""
    return subprocess.Popen(
        command, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler), **options
    )


@pytest.fixture
def meshes(tmp_path):
    (tmp_path / "meshes/ball").mkdir(parents=True)
    ball = trimesh.creation.icosphere(4).export(file_type="off")
    for i in range(16):
        (tmp_path / f"meshes/ball/ball_{i}.off").write_text(ball)
    return tmp_path / "meshes"


@pytest.fixture(autouse=True)
def complaints(monkeypatch):
    """What an interrupt silences is heard again afterwards."""
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr(logging.getLogger("asyncio"), "disabled", False)


def signalled(command: list[str], number: signal.Signals, ready) -> tuple[int, str]:
    """Send a signal to a command, to all its processes as a terminal does with Ctrl-C, once it is ready."""
    running = popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    while not ready() and running.poll() is None:
        time.sleep(0.01)
    (os.killpg if number == signal.SIGINT else os.kill)(running.pid, number)
    _, said = running.communicate(timeout=60)
    assert "Traceback" not in said, said
    return running.returncode, re.split("[\r\n]", said.strip())[-1]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_rendering_in_one_line_and_it_resumes(tmp_path, meshes, number, status):
    store = tmp_path / "v.zarr"
    command = [*COMMAND, "render", str(meshes), str(store), "--size", "32", "--workers", "2"]

    def rendered() -> int:
        return len(list(store.glob("image/c/*")))

    # While the workers start, and while they work.
    for ready in (store.exists, lambda: rendered() > 2):
        assert rendered() == 0
        assert signalled(command, number, ready) == (
            status,
            "nextview: stopped; run the same command again; it resumes",
        )
    main(command[3:])
    assert ViewStore.open(store).done.all()


def test_ctrl_c_while_everything_is_imported_is_quiet(tmp_path):
    began = tmp_path / "began"
    code = f"""
import sys, pathlib, nextview_command
class Began:
    def find_spec(self, name, *rest):
        if name == "nextview":
            pathlib.Path({str(began)!r}).touch()
sys.argv = ["nextview", "models"]
sys.meta_path.insert(0, Began())
nextview_command.main()
"""
    for wait in (0, 0.05, 0.15):

        def ready(wait: float = wait) -> bool:
            return began.exists() and time.time() > began.stat().st_mtime + wait

        assert signalled([sys.executable, "-c", code], signal.SIGINT, ready) == (
            130,
            "nextview: stopped; run the same command again",
        )
        began.unlink()


def test_a_command_that_does_not_resume_says_nothing_of_it(monkeypatch, capsys):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("nextview.models.model_card.bundled_cards", interrupted)
    with pytest.raises(SystemExit, match="130"):
        main(["models"])
    assert capsys.readouterr().err == "nextview: stopped; run the same command again\n"


@pytest.mark.parametrize(("interrupt", "status"), [(KeyboardInterrupt, 130), (Terminated, 143)])
def test_an_interrupt_that_became_an_exit_is_still_one(capsys, interrupt, status):
    """As Lightning does while it trains."""

    def train():
        try:
            raise interrupt
        except KeyboardInterrupt:
            sys.exit(1)

    with pytest.raises(SystemExit) as ended, orderly_end("go on"):
        train()
    assert ended.value.code == status
    assert capsys.readouterr().err == "nextview: stopped; go on\n"
    with pytest.raises(SystemExit) as ended, orderly_end("go on"):
        sys.exit(1)
    assert (ended.value.code, capsys.readouterr().err) == (1, "")


def test_an_ignored_signal_stays_ignored():
    code = (
        "import signal, sys, os; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "import nextview.models.model_card as card; cards = card.bundled_cards\n"
        "card.bundled_cards = lambda: os.kill(os.getpid(), signal.SIGTERM) or cards()\n"
        "from nextview.cli.main import main; main(['models'])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("arguments", [["models"], ["models", "--help"]], ids=" ".join)
@pytest.mark.parametrize(("where", "reason"), [(">/dev/full", "No space left on device"), (">&-", "it is closed")])
def test_output_that_cannot_be_written_gets_one_sentence(arguments, where, reason):
    line = ["bash", "-c", f'"$@" {where}', "bash", *COMMAND, *arguments]
    done = subprocess.run(line, text=True, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (1, f"nextview: standard output or a file cannot be written ({reason})\n")


def test_nothing_is_written_into_a_file_that_got_the_place_of_closed_output(tmp_path):
    """The first file opened after ``>&-`` gets the number of standard output."""
    trimesh.creation.box([1, 2, 3]).export(tmp_path / "box.off")
    options = ["--max-views", "1", "--figure", str(tmp_path / "e.svg")]
    line = ["bash", "-c", '"$@" >&- 2>&-', "bash", *COMMAND, "recognise", str(tmp_path / "box.off"), *options]
    assert subprocess.run(line).returncode == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["box.off"]


def test_without_standard_error_a_refusal_keeps_its_status():
    for where in ("2>&-", "2>/dev/full"):
        line = ["bash", "-c", f'"$@" {where}', "bash", *COMMAND, "recognise", "none.off"]
        done = subprocess.run(line, stdout=subprocess.PIPE)
        assert (done.returncode, done.stdout) == (2, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_what_python_says_at_its_very_end_does_not_change_the_status():
    """Where standard error is full, flushing it then would end with 120."""
    code = (
        "import sys; from nextview.cli.main import main\n"
        "class Late:\n"
        "    def __del__(self, out=sys.stderr):\n"
        "        out.write('late')\n"
        "sys.late = Late()\n"
        "main(['recognise', 'none.off'])"
    )
    assert subprocess.run(["bash", "-c", '"$@" 2>/dev/full', "bash", sys.executable, "-c", code]).returncode == 2


@pytest.mark.parametrize("columns", ["1", "5", "1000000000", "0", "-3", "wide"])
def test_help_and_tables_in_any_width(columns):
    for arguments in (["recognise", "--help"], ["models"]):
        done = subprocess.run(
            [*COMMAND, *arguments],
            env=os.environ | {"COLUMNS": columns},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30)),
            timeout=60,
            capture_output=True,
        )
        assert (done.returncode, done.stderr) == (0, b"")
        assert 100 < len(done.stdout) < 100_000


def test_the_terminal_is_left_as_it_was(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "3")
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    main(["models"])
    assert (os.environ["COLUMNS"], shutil.get_terminal_size().columns) == ("3", 3)
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


@pytest.mark.parametrize(
    ("package", "arguments", "extra"),
    [
        ("torch", ["train", "recogniser", "views.zarr", "run"], "train"),
        ("pandas", ["benchmark", "p.npz"], "benchmark"),
        ("jinja2", ["report", "results"], "benchmark"),
    ],
)
def test_a_missing_extra_is_named_with_what_brings_it(package, arguments, extra):
    code = f"import sys; sys.modules[{package!r}] = None; from nextview.cli.main import main; main({arguments!r})"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 2
    assert f"pip install 'nextview[{extra}]'" in ended.stderr
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("package", "script", "extra"),
    [
        ("pandas", "benchmarks/views.py", "benchmark"),
        ("pandas", "benchmarks/replay.py", "benchmark"),
        ("pandas", "benchmarks/reproduction.py", "benchmark"),
        ("pandas", "benchmarks/unseen_classes.py", "benchmark"),
        ("pandas", "benchmarks/ablations.py", "benchmark"),
        ("torch", "benchmarks/ablations.py", "train"),
        ("onnx", "benchmarks/latency.py", "train"),
        ("jinja2", "workflow/results.py", "benchmark"),
    ],
)
def test_a_script_names_the_missing_extra_too(package, script, extra):
    path = str(Path(__file__).parents[1] / script)
    without = f"import sys, runpy; sys.modules[{package!r}] = None; sys.argv = [{path!r}, '--help']"
    code = f"{without}; runpy.run_path({path!r}, run_name='__main__')"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 2
    assert f"pip install 'nextview[{extra}]'" in ended.stderr
    assert ended.stderr.count("\n") == 1
