"""The command line: its table of commands, how they end, and what they show."""

import ast
import inspect
import io
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from dataclasses import fields, is_dataclass, replace
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from factories import run_python
from pipeline import some_predictions
from programs import COMMANDS, called, main

from nextview import errors
from nextview.checks import EXTRAS, extras
from nextview.cli import progress
from nextview.cli.call_with_arguments import call, entry, find
from nextview.cli.commands import NEXTVIEW
from nextview.cli.option_names import option_names
from nextview.cli.option_values import value_word
from nextview.data import pool
from nextview.errors import MissingExtraError, NextviewError, shell_words
from nextview.files import check_new
from nextview_lab.cli.predict import summed_up
from nextview_lab.data.store import ViewStore
from nextview_lab.extras import EXTRAS as EXTRAS_OF_LAB

ROOT = Path(__file__).parents[1]
COMMAND = [sys.executable, "-m", "nextview"]
LAB_COMMAND = [sys.executable, "-m", "nextview_lab"]


def ended(capsys, *arguments):
    """The status with which a command ends, and what it says on standard error."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code, capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name, capsys):
    pytest.importorskip("torch")
    with pytest.raises(SystemExit) as end:
        called(f"{name} --help")
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"usage: {name} ")
    without = ("nextview demo", "nextview demo-episode", "nextview explore")
    assert "(required)" in shown or name in without
    rows = [row.replace("│", " ").rstrip() for row in shown.splitlines()]
    for row, following in pairwise(rows):  # each option has a help, beside it or below
        beside = re.search(r"\S {2,}(\S)", row) or re.match(r" +(\S)", following)
        if re.match(r"  --[a-z]", row):
            assert beside, row
            assert beside[1] not in "-(", row
    assert not re.search(r"\{|\bNone\b|FLOAT|\bSTR\b|\(default: \)", shown)
    explained = {row.split()[0] for row in rows if re.match(r"  --[a-z]", row)}
    assert explained == option_names(entry(COMMANDS[name])[0])
    assert shown.splitlines()[-1] == f"example: {example_of(name)}"


def example_of(name):
    """The command line in the help of a command, with its program."""
    return f"{name.partition(' ')[0]} {COMMANDS[name].example}"


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_of_a_help_is_a_command_line(name, monkeypatch):
    pytest.importorskip("torch")
    command = COMMANDS[name]
    module, _, function = command.function.partition(":")
    called = []

    @wraps(find(command.function))
    def run(*arguments, **options):
        called.append((arguments, options))

    monkeypatch.setattr(f"{module}.{function}", run)
    words = example_of(name).split()
    assert " ".join(words[: len(name.split())]) == name
    call(name, command, words[len(name.split()) :], None)
    assert len(called) == 1


@pytest.mark.parametrize(
    "name",
    [
        "nextview completion",
        "nextview list",
        "nextview demo-episode",
        "nextview-lab list",
        "nextview-lab capture",
    ],
)
def test_the_example_of_a_quick_command_runs(name, monkeypatch, tmp_path):
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    monkeypatch.chdir(tmp_path)
    with suppress(SystemExit):
        called(example_of(name))
    assert {path.name for path in tmp_path.iterdir()} - {"samples"} == {
        "nextview-lab capture": {"captured"},
        "nextview demo-episode": {"chair.png"},
    }.get(name, set())


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        (float | None, "NUMBER"),
        (tuple[float, float, float] | Literal["up", "down"] | None, "X Y Z|up|down"),
        (str | tuple[str, ...], "TEXT ..."),
        (tuple[int, ...], "INT ..."),
        (tuple[int, Path], "INT PATH"),
    ],
)
def test_the_placeholder_of_a_value(kind, word):
    assert value_word(kind) == word


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "recognise a.off --up 0 1",
            "Error parsing --up: y|z|X Y Z is expected, not 0 1",
        ),
        ("capture a.off out --radius wide", "--radius: NUMBER is expected, not wide"),
        (
            "learn a b --remove",
            "Error parsing --remove: its value is missing: TEXT ...",
        ),
        (
            "check a --intrinsics",
            "--intrinsics: its value is missing: FX FY CX CY|PATH",
        ),
        ("predict no-store a.npz --maps", "no-store: there is no view store"),
        ("learn a b --turntable left", "Expected one of ('ccw', 'cw')."),
        (
            "check a --intrinsic 2",
            "no option --intrinsic; did you mean '--intrinsics'?",
        ),
        (
            "learn --tabletop=no a b",
            "no option --tabletop; did you mean '--turntable'?",
        ),
        ("list models --xyz", "no option --xyz; nextview list --help lists those"),
        ("explore --no_browse", "no option --no-browse; did you mean '--no-browser'?"),
    ],
)
def test_a_wrong_option_or_value_is_explained(words, said, capsys):
    status, shown = ended(capsys, *words.split())
    assert status == 2
    assert said in " ".join(shown.replace("│", " ").split())


@pytest.mark.parametrize("words", ["help look", "look -h"])
def test_help_is_a_word_too(words, capsys):
    with pytest.raises(SystemExit):
        main(words.split())
    assert capsys.readouterr().out.startswith("usage: nextview look ")


@pytest.mark.parametrize("program", ids=lambda program: program.name)
def test_the_list_of_commands_imports_no_command(program):
    module = program.name.replace("-", "_")
    code = (
        f"import sys; from {module}.cli.main import main; main(['--help'])\nslow = {{'torch',"
        " 'pandas', 'matplotlib', 'zarr', 'tyro', 'rich'} & set(sys.modules); assert not slow, slow"
    )
    listed = run_python(code)
    assert listed.returncode == 0, listed.stderr
    for name, command in program.commands.items():
        assert f"  {name} " in listed.stdout
        assert command.line in listed.stdout
    assert max(map(len, listed.stdout.splitlines())) <= 80


@pytest.mark.parametrize("name", COMMANDS)
def test_suggested_next_commands_exist(name):
    named = re.findall(r"nextview(?:-lab)? \w+(?: \w+)?", COMMANDS[name].then)
    known = {*COMMANDS, *(" ".join(each.split()[:2]) for each in COMMANDS)}
    assert all(words in known or words.rpartition(" ")[0] in known for words in named)


@pytest.mark.parametrize("word", NEXTVIEW.elsewhere[0])
def test_a_command_of_the_laboratory_says_where_it_is(word, capsys):
    with pytest.raises(SystemExit) as end:
        called(f"nextview {word} x")
    assert end.value.code == 2
    said = f"nextview {word} is now nextview-lab {word}: pip install ./lab"
    assert said in capsys.readouterr().err
    assert any(name.startswith(f"nextview-lab {word}") for name in COMMANDS)


def kinds(hint):
    """What an option takes: numbers, texts or a switch; and whether several."""
    if is_dataclass(hint) or get_origin(hint) is Callable:
        return set()
    if get_origin(hint) is tuple:
        return {("several", kind) for part in get_args(hint) for kind in kinds(part)}
    if get_origin(hint) is Literal:
        return {type(value) for value in get_args(hint)}
    parts = [part for part in get_args(hint) if part is not type(None)]
    return set().union(*map(kinds, parts)) if parts else {str if hint is Path else hint}


def options(name):
    """The options of a command, and of its dataclasses, with what they take."""
    function = find(COMMANDS[name].function)
    hints, found = get_type_hints(function), {}
    for each in inspect.signature(function).parameters.values():
        hint = hints[each.name]
        if is_dataclass(hint):
            found |= {f.name: kinds(get_type_hints(hint)[f.name]) for f in fields(hint)}
        elif each.default is not each.empty and each.kind is not each.POSITIONAL_ONLY:
            found[each.name] = kinds(hint)
    return found


def test_an_option_has_the_same_type_in_every_command():
    pytest.importorskip("torch")
    taken = {}
    for name in COMMANDS:
        for option, kind in options(name).items():
            assert not kind or taken.setdefault(option, kind) & kind, (
                option,
                name,
                kind,
                taken[option],
            )
    assert {"held_out", "validation", "views", "seed"} <= taken.keys()


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("nextview recognize", "recognise"),
        ("nextview-lab train recognizer", "train recogniser"),
        ("nextview-lab benchmark thing", "benchmark things"),
        ("nextview-lab exprot map", "export"),
    ],
)
def test_a_misspelt_command_is_guessed(words, meant, capsys):
    with pytest.raises(SystemExit) as end:
        called(words)
    program, _, command = words.partition(" ")
    assert end.value.code == 2
    assert capsys.readouterr().err == (
        f"{program}: there is no command {command.replace(' map', '')!r}; did you mean"
        f" {meant!r}?\n"
    )


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("localise", ["look"]),
        ("Detect", ["look"]),
        ("serach", ["look"]),
        ("teach", ["learn"]),
        ("train-on", ["learn"]),
        ("classify", ["recognise"]),
        ("scan", ["look", "learn"]),
        ("visualize", ["explore"]),
        ("quickstart", ["demo"]),
    ],
)
def test_what_a_newcomer_calls_a_command_leads_to_it(word, meant, capsys):
    status, said = ended(capsys, *word.split())
    named = [f"{name!r} ({NEXTVIEW.commands[name].line})" for name in meant]
    assert status == 2
    assert f"did you mean {' or '.join(named)}?\n" in said


@pytest.mark.parametrize("program", ids=lambda program: program.name)
def test_other_words_are_of_commands_and_no_command_themselves(program):
    assert program.commands.keys() >= program.other_words.keys()
    for words in program.other_words.values():
        assert not program.commands.keys() & set(words.split())


def test_messages_name_an_option_as_it_is_typed_where_they_are_read(tmp_path, capsys):
    """In a shell, in Python, and in a worker process of a command."""
    (tmp_path / "out").mkdir()
    for name in ("a", "b"):
        (tmp_path / name).with_suffix(".off").write_text("OFF\n")
    with pytest.raises(
        NextviewError, match="another name, or overwrite=True to"
    ) as python:
        check_new(tmp_path / "a.off")
    said = ended(capsys, "demo-episode", "--figure", tmp_path / "a.off")[1]
    assert "another name, or --overwrite to" in said
    assert "--" not in str(python.value)

    with shell_words():
        assert dict(pool.each(errors.option, ["depth_scale"], 1)) == {
            "depth_scale": "--depth-scale"
        }
    assert dict(pool.each(errors.option, ["depth_scale"], 1)) == {
        "depth_scale": "depth_scale"
    }


def test_no_message_names_a_python_argument_to_a_shell():
    """They are named by ``errors.option``, which knows where a message is read."""
    named = "|".join({one for name in COMMANDS for one in options(name)})
    python = re.compile(rf"(?<![-\w])({named})=(True|False|None|['\"\n])|in a shell")
    only_python = ["environments.py"]
    for path in sorted((ROOT / "src/nextview").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        bodies = [
            n.body for n in ast.walk(tree) if isinstance(getattr(n, "body", 0), list)
        ]
        docs = {id(body[0].value) for body in bodies if isinstance(body[0], ast.Expr)}
        for node in ast.walk(tree):
            text = ""
            if isinstance(node, ast.JoinedStr):
                text = "".join(
                    str(v.value) if isinstance(v, ast.Constant) else "\n"
                    for v in node.values
                )
            elif isinstance(node, ast.Constant) and id(node) not in docs:
                text = str(node.value)
            if path.name not in only_python and " " in text and "<" not in text:
                assert not python.search(text), (path, text)


@pytest.mark.parametrize("preset", [None, "thesis"])
def test_a_preset_sets_defaults_that_options_change(preset, monkeypatch):
    stage = pytest.importorskip("nextview_lab.training.recogniser_training")
    kind, called = stage.RecogniserRecipe, []
    recipe = (
        find("nextview_lab.training.recipes:THESIS_RECOGNISER") if preset else kind()
    )

    def train(store: str, out: str, recipe: kind = kind()) -> list[str]:
        called.append(recipe)
        return []

    monkeypatch.setattr(stage, "train_recogniser", train)
    main(
        [
            "train",
            "recogniser",
            "s",
            "none",
            *(["--preset", preset] if preset else []),
            "--epochs",
            "1",
        ]
    )
    assert called == [replace(recipe, epochs=1)]


def interrupted(command, ready):
    """Ctrl-C for a command, once it is ready."""
    running = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while not ready() and running.poll() is None:
        time.sleep(0.01)
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=60)
    return (
        running.returncode,
        [
            line
            for line in said.splitlines()
            if line.startswith(("nextview: ", "nextview-lab: "))
        ][-1],
    )


def test_ctrl_c_ends_rendering_in_one_line_and_it_resumes(tmp_path, furniture):
    store = tmp_path / "v.zarr"
    command = ["render", str(furniture), str(store), "--size", "32", "--workers", "1"]

    def begun():
        return len(list(store.glob("image/c/*"))) > 1

    again = "nextview-lab: stopped; run the same command again; it resumes"
    assert interrupted([*LAB_COMMAND, *command], begun) == (130, again)
    main(command)
    assert ViewStore.open(store).done.all()


def test_ctrl_c_ends_other_commands_in_one_line(monkeypatch, capsys):
    def stop(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("nextview.cli.listing.bundled_cards", stop)
    assert ended(capsys, "list", "models") == (
        130,
        "nextview: stopped; nothing was written\n",
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize(
    ("where", "words", "status", "said"),
    [
        (
            ">/dev/full",
            "list models",
            1,
            "standard output cannot be written (No space left on",
        ),
        (">&-", "list models", 0, ""),
        (">&-", "recognise none.off", 2, "none.off: no such file"),
        ("2>&-", "recognise none.off", 2, ""),
        ("2>/dev/full", "recognise none.off", 2, ""),
    ],
)
def test_the_exit_status_is_right_if_an_output_is_full_or_closed(
    where,
    words,
    status,
    said,
):
    line = ["bash", "-c", f'"$@" {where}', "bash", *COMMAND, *words.split()]
    done = subprocess.run(line, capture_output=True, text=True)
    assert (done.returncode, done.stdout, said in done.stderr) == (status, "", True)
    assert done.stderr.count("\n") == (said != "")


@pytest.mark.parametrize("columns", ["1", "1000000000", "-3", "wide"])
def test_help_in_any_width(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    status, said = ended(capsys, "recognise", "--help")
    assert (status, said) == (0, "")


def test_a_bug_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("nextview.cli.listing.bundled_cards", lambda: {}["bug"])
    with pytest.raises(KeyError):
        main(["list", "models"])


@pytest.mark.parametrize(
    ("package", "arguments", "extra"),
    [
        ("torch", ["train", "recogniser", "s", "run"], "train"),
        ("pandas", ["benchmark", "classes", "p.npz"], "benchmark"),
    ],
)
def test_a_missing_extra_is_named_with_its_install_command(package, arguments, extra):
    code = (
        f"import sys; sys.modules[{package!r}] = None; from nextview_lab.cli.main import main;"
        f" main({arguments!r})"
    )
    done = run_python(code)
    assert done.returncode == 2
    assert f"pip install 'nextview-lab[{extra}]'" in done.stderr
    assert done.stderr.count("\n") == 1


MISSING = [
    package
    for packages in (*EXTRAS.values(), *EXTRAS_OF_LAB.values())
    for package in packages
]
HIDDEN = f"""
from importlib.machinery import PathFinder
missing, plain = {MISSING!r}, PathFinder.find_spec
find = lambda name, *more: None if name.partition('.')[0] in missing else plain(name, *more)
PathFinder.find_spec = staticmethod(find)
"""
"""Code that hides packages from the search of installed ones."""


NEED_EXTRAS = {
    "from nextview.viewers.recording import Recorder": "nextview[record]",
    "import nextview_lab.benchmark.environments": "nextview-lab[envs]",
    "from nextview_lab.benchmark.classes import benchmark_classes": "nextview-lab[benchmark]",
    "from nextview_lab.benchmark.report import report": "nextview-lab[benchmark]",
    "import nextview_lab.benchmark.evaluation_page": "nextview-lab[benchmark]",
    "from nextview.viewers.page import Page": "nextview[explore]",
    "from nextview_lab.training.recogniser_training import train_recogniser": "nextview-lab[train]",
    "from nextview_lab.training.export import export_map": "nextview-lab[train]",
    "from nextview_lab.training.gain_training import train_gain": "nextview-lab[train]",
    (
        "from nextview.data.pool import each;"
        " list(each(print, [1], None, 'tcp://localhost:1'))"
    ): "nextview[cluster]",
}
WITHOUT_EXTRAS = f"""
import json
import nextview

errors = {{}}
for code in {list(NEED_EXTRAS)!r}:
    try:
        exec(code, {{}})
    except nextview.MissingExtraError as error:
        errors[code] = str(error)
print(json.dumps(errors))
"""


@pytest.fixture(scope="module")
def without_extras():
    """What each of ``NEED_EXTRAS`` says where no extra is installed."""
    done = run_python(HIDDEN + WITHOUT_EXTRAS)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("code", NEED_EXTRAS)
def test_python_without_an_extra_names_it_too(code, without_extras):
    assert f"pip install '{NEED_EXTRAS[code]}'" in without_extras[code]
    assert "\n" not in without_extras[code]


def test_an_unknown_module_is_not_reported_as_a_missing_extra():
    with pytest.raises(ModuleNotFoundError) as raised, extras():
        import no_such_package_at_all  # noqa: F401
    assert not isinstance(raised.value, MissingExtraError)


HELPS = [
    "train recogniser",
    "train gain",
    "export map",
    "evaluate",
    "benchmark classes",
    "report",
]
ALL_HELPS = f"""
from contextlib import suppress
from nextview_lab.cli.main import main
for name in {HELPS!r}:
    with suppress(SystemExit):
        main([*name.split(), "--help"])
    print(end="\\f")
"""


@pytest.fixture(scope="module")
def helps():
    """The help of each of ``HELPS`` where all extras are installed."""
    return dict(zip(HELPS, run_python(ALL_HELPS).stdout.split("\f"), strict=False))


@pytest.mark.parametrize("name", HELPS)
def test_help_needs_no_extra(name, helps):
    """The packages are hidden from the search of installed ones."""
    done = run_python(
        HIDDEN
        + f"from nextview_lab.cli.main import main; main({[*name.split(), '--help']!r})"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"usage: nextview-lab {name} ")
    assert "pip install 'nextview-lab[" in done.stderr
    assert done.stdout == helps[name]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
@pytest.mark.parametrize("program", ids=lambda program: program.name)
def test_a_shell_completes_the_whole_command(program, shell, capsys):
    pytest.importorskip("torch")
    with pytest.raises(SystemExit) as end:
        called(f"{program.name} completion {shell}")
    assert end.value.code in (0, None)
    script = capsys.readouterr().out
    assert all(word in script for name in program.commands for word in name.split())
    assert "--models" in script


@pytest.fixture(scope="module")
def completions_for_bash(tmp_path_factory):
    pytest.importorskip("torch")
    path = tmp_path_factory.mktemp("bash") / "nextview-lab.sh"
    said = io.StringIO()
    with redirect_stdout(said), suppress(SystemExit):
        called("nextview-lab completion bash")
    path.write_text(said.getvalue())
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("re", {"render", "report"}),
        ("fit s", {"size"}),
        ("train recogniser --lay", {"--layers"}),
    ],
)
def test_bash_completes_commands_and_options(words, offered, completions_for_bash):
    ask = (
        f"source {completions_for_bash}; f=$(complete -p nextview-lab | sed 's/.*-F \\([^"
        f" ]*\\).*/\\1/'); COMP_WORDS=(nextview-lab {words});"
        " COMP_CWORD=$((${#COMP_WORDS[@]}-1)); $f; echo ${COMPREPLY[@]}"
    )
    done = subprocess.run(
        ["bash", "-c", ask],
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(done.stdout.split()) == offered


def test_a_resumed_stage_reports_its_progress(views, tmp_path, capsys, monkeypatch):
    store = tmp_path / "views.zarr"
    shutil.copytree(views, store)
    (tmp_path / "ones.py").write_text("def one(view):\n    return 1.0\n")
    monkeypatch.chdir(tmp_path)
    for said in (
        "18 of 18 objects measured now",
        "nothing was left to do; all 18 objects were measured before",
    ):
        main(["measure", str(store), "--measures", "ones:one", "--workers", "0"])
        assert said in " ".join(capsys.readouterr().err.split())


def test_without_a_terminal_progress_is_printed_as_lines(
    monkeypatch,
    capsys,
):
    seconds = 0
    monkeypatch.setattr("nextview.data.progress.time.monotonic", lambda: seconds)

    def steps():
        nonlocal seconds
        assert capsys.readouterr().err == "rendering v.zarr: 100 to do\n"
        while seconds < 100:
            seconds += 1
            yield seconds

    progress.track(steps(), 100, "rendering v.zarr")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        f"rendering v.zarr: {n} of 100 after {n} s" for n in (6, 17, 38, 69, 100)
    ]


def test_render_warns_early_about_image_sizes_that_the_networks_reject(
    furniture, tmp_path, capsys
):
    for size, said in (("48", True), ("112", False)):
        command = [
            "render",
            str(furniture),
            str(tmp_path / f"{size}.zarr"),
            "--size",
            size,
            "--viewpoints",
            "12",
        ]
        main([*command, "--split", "test", "--workers", "0"])
        words = " ".join(capsys.readouterr().err.split())
        assert (
            "networks take images whose side is a multiple of 112 pixels, such as 224"
            in words
        ) == said


def test_predictions_are_summed_up():
    p = some_predictions(12, seed=0)
    n, v, c = p.logits.shape
    truth = np.eye(c, dtype=np.float32)[p.labels]
    logits = np.repeat(truth[:, None], v, 1)
    # a quarter of the views names another class
    logits[:, : v // 4] = 1.5 * np.roll(truth, 1, axis=1)[:, None]
    p = replace(
        p,
        logits=logits,
        splits=np.array(["test"] * n),
        models={"recogniser": ("tiny", "0" * 64)},
    )
    assert summed_up(p) == [
        f"{n} test objects: right from one view 0.750, from all {v} 1.000"
    ]
