"""Shell completion: asked as a shell asks."""

import shutil
import subprocess

import pytest

from nextview.cli.commands import COMMANDS
from nextview.cli.main import main

ASK = """
source {script}
COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMP_LINE="{words}"; COMP_POINT=${{#COMP_LINE}}
_tyro_nextview
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def bash(tmp_path_factory):
    from contextlib import redirect_stdout, suppress

    script = tmp_path_factory.mktemp("completion") / "nextview.bash"
    with script.open("w") as file, redirect_stdout(file), suppress(SystemExit):
        main(["completion", "bash"])

    def complete(words):
        ask = ASK.format(script=script, words=words)
        done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    return complete


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")
@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("nextview rec", {"recognise"}),
        ("nextview fit cal", {"calibration"}),
        ("nextview train gain --tr", {"--travel-weight"}),
        ("nextview train recogniser --pres", {"--preset"}),
    ],
)
def test_bash_completes(bash, words, wanted):
    assert set(bash(words)) == wanted


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")
def test_bash_offers_every_command(bash):
    assert set(COMMANDS) <= set(bash("nextview ''"))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_is_sound(shell, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["completion", shell])
    assert not end.value.code
    script = tmp_path / "script"
    script.write_text(capsys.readouterr().out)
    assert all(name in script.read_text() for name in COMMANDS)
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} here to read it")
    assert subprocess.run([shell, "-n", str(script)], timeout=60).returncode == 0
