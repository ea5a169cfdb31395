"""The command line: its table of commands, how they end, and what they show."""

import re
import subprocess
import sys
from functools import wraps
from pathlib import Path

import pytest
from factories import run_python
from programs import COMMANDS, UNTIDY, called, example_of, help_of, main

from nextview.checks import check_extras, extras
from nextview.cli.call_with_arguments import call, entry, find
from nextview.cli.commands import NEXTVIEW
from nextview.cli.option_names import option_names
from nextview.errors import MissingExtraError

WITHOUT_ARGUMENTS = ("nextview demo", "nextview demo-episode", "nextview explore")
COMMAND = [sys.executable, "-m", "nextview"]


def ended(capsys, *arguments):
    """The status with which a command ends, and what it says on standard error."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code, capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name, capsys):
    shown, explained = help_of(name, called, capsys)
    assert shown.startswith(f"usage: {name} ")
    assert "(required)" in shown or name in WITHOUT_ARGUMENTS
    assert explained.keys() == option_names(entry(COMMANDS[name])[0])
    for option, text in explained.items():
        assert re.match(r"[^-(]", text), f"{option} has no explanation"
    assert not re.search(UNTIDY, shown)
    assert shown.splitlines()[-1] == f"example: {example_of(name, COMMANDS[name])}"


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_of_a_help_is_a_command_line(name, monkeypatch):
    command = COMMANDS[name]
    module, _, function = command.function.partition(":")
    called = []

    @wraps(find(command.function))
    def run(*arguments, **options):
        called.append((arguments, options))

    monkeypatch.setattr(f"{module}.{function}", run)
    words = example_of(name, COMMANDS[name]).split()
    assert " ".join(words[: len(name.split())]) == name
    call(name, command, words[len(name.split()) :], None)
    assert len(called) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "recognise a.off --up 0 1",
            "Error parsing --up: y|z|X Y Z is expected, not 0 1",
        ),
        (
            "learn a b --remove",
            "Error parsing --remove: its value is missing: TEXT ...",
        ),
        ("learn a b --turntable left", "Expected one of ('ccw', 'cw')."),
        (
            "check a --intrinsic 2",
            "no option --intrinsic; did you mean '--intrinsics'?",
        ),
        ("list models --xyz", "no option --xyz; nextview list --help lists those"),
        ("explore --no_browse", "no option --no-browse; did you mean '--no-browser'?"),
    ],
)
def test_a_wrong_option_or_value_is_explained(words, said, capsys):
    status, shown = ended(capsys, *words.split())
    assert status == 2
    assert said in " ".join(shown.replace("│", " ").split())


def test_the_import_and_the_list_of_commands_load_nothing_heavy():
    heavy = (
        "; import sys; heavy = {'embreex', 'matplotlib', 'onnxruntime', 'pandas', 'PIL', 'rich',"
        " 'scipy', 'torch', 'trimesh', 'tyro', 'zarr'} & set(sys.modules); assert not heavy, heavy"
    )
    run_python(f"import nextview{heavy}; assert 'numpy' not in sys.modules", check=True)
    code = f"from nextview.cli.main import main; main(['--help']){heavy}"
    listed = run_python(code, check=True)
    for name, command in NEXTVIEW.commands.items():
        assert f"  {name} " in listed.stdout
        assert command.line in listed.stdout
    assert max(map(len, listed.stdout.splitlines())) <= 80


def test_every_name_is_offered_before_it_is_imported():
    code = "import nextview; print({*nextview.__all__} - {*dir(nextview)})"
    assert run_python(code, check=True).stdout.strip() == "set()"


@pytest.mark.parametrize("word", NEXTVIEW.elsewhere[0])
def test_a_command_of_the_laboratory_says_where_it_is(word, capsys):
    with pytest.raises(SystemExit) as end:
        called(f"nextview {word} x")
    assert end.value.code == 2
    said = f"nextview {word} is now nextview-lab {word}: pip install ./lab"
    assert said in capsys.readouterr().err


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
        ("2>&-", "recognise none.off", 2, ""),
    ],
)
def test_the_exit_status_is_right_if_an_output_is_full_or_closed(
    where, words, status, said
):
    line = ["bash", "-c", f'"$@" {where}', "bash", *COMMAND, *words.split()]
    done = subprocess.run(line, capture_output=True, text=True)
    assert (done.returncode, done.stdout, said in done.stderr) == (status, "", True)
    assert done.stderr.count("\n") == (said != "")


def test_a_bug_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("nextview.cli.listing.bundled_cards", lambda: {}["bug"])
    with pytest.raises(KeyError):
        main(["list", "models"])


def test_an_unknown_module_is_not_reported_as_a_missing_extra():
    with pytest.raises(ModuleNotFoundError) as raised, extras():
        import no_such_package_at_all  # noqa: F401
    assert not isinstance(raised.value, MissingExtraError)


def test_all_missing_extras_are_named_at_once(monkeypatch):
    for package in ("viser", "websockets", "rerun"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError) as raised:
        check_extras("explore", "record")
    assert "viser, websockets, rerun" in str(raised.value)
    assert "nextview[explore,record]" in str(raised.value)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_the_whole_command(shell, capsys):
    with pytest.raises(SystemExit) as end:
        called(f"nextview completion {shell}")
    assert end.value.code in (0, None)
    script = capsys.readouterr().out
    assert all(word in script for name in NEXTVIEW.commands for word in name.split())
    assert "--models" in script
