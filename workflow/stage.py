"""Run the commands of one stage of the workflow; go on where an earlier run of them was cut off.

    python workflow/stage.py OUT [--needs DONE ...] [--state TEXT] --commands COMMAND ...

Beside OUT, a file or a folder, there will be two small files. OUT.begun names what the stage is
being made from: its commands, and the contents of what it needs. If an earlier run began with the
same, what it left is kept, and the commands go on from there, as those of nextview do; otherwise it
is removed first. OUT.done is written when all commands have succeeded. It holds the commands and a
SHA-256 of what they made, so that a stage that makes the same as before does not set off those that
come after it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from filelock import FileLock, Timeout

ROOT = Path(__file__).resolve().parent.parent
"""Of the repository."""


def beside(path: Path, ending: str) -> Path:
    """The file NAME.ending beside a file or folder called NAME."""
    return path.with_name(f"{path.name}.{ending}")


def content_hash(path: Path) -> str:
    """SHA-256 of what a stage made: of the file, or of what identifies a folder.

    A view store is identified by its attributes, which hold the hash of every mesh and all
    settings; a training run by its network; any other folder by all its files.
    """
    sha = hashlib.sha256()
    for file in _identifying(path):
        sha.update(str(file.relative_to(path)).encode())
        with file.open("rb") as opened:
            sha.update(hashlib.file_digest(opened, "sha256").digest())
    return sha.hexdigest()


def _identifying(path: Path) -> Iterable[Path]:
    if path.is_file():
        return [path]
    for name in ("zarr.json", "network.pt"):
        if (path / name).exists():
            return [path / name]
    return [file for file in sorted(path.rglob("*")) if file.is_file()]


# modules that run the programs
PROGRAMS = {"nextview": "nextview", "nextview-lab": "nextview_lab"}


def remove(path: Path) -> None:
    """Remove a file or a folder; of a link only the link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def runnable(command: str) -> str:
    """A command as it is printed, made to run with this interpreter and this repository,
    wherever they are.
    """
    python = shlex.quote(sys.executable)
    for program, module in PROGRAMS.items():
        if command.startswith(f"{program} "):
            return f"{python} -m {module} {command.removeprefix(f'{program} ')}"
    if command.startswith("python workflow/"):
        script, _, rest = command.removeprefix("python ").partition(" ")
        return f"{python} {shlex.quote(str(ROOT / script))} {rest}"
    if command.startswith("python "):
        return f"{python} {command.removeprefix('python ')}"
    return command


def run(out: Path, commands: list[str], needs: list[Path], state: str) -> None:
    """Make a stage, or go on making it.

    Args:
        out: file or folder that it makes.
        commands: that make it.
        needs: the .done files of the stages that it needs.
        state: of whatever else it needs.
    """
    needed = {str(path): json.loads(path.read_text())["sha256"] for path in needs}
    begun = {"commands": commands, "needs": needed, "state": state}
    note = beside(out, "begun")
    if not note.exists() or json.loads(note.read_text()) != begun:
        for path in (out, beside(out, "part")):
            remove(path)
        note.write_text(json.dumps(begun, indent=1) + "\n")
    here = os.environ | {
        "PYTHONPATH": os.pathsep.join(
            [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        )
    }
    for command in commands:
        print(f"$ {command}", flush=True)
        status = subprocess.run(
            ["bash", "-o", "pipefail", "-c", runnable(command)],
            env=here,
        ).returncode
        if status:
            sys.exit(status if status > 0 else 128 - status)
    done = beside(out, "done")
    part = beside(out, "done.part")
    part.write_text(
        json.dumps({"commands": commands, "sha256": content_hash(out)}, indent=1) + "\n"
    )
    os.replace(part, done)


def main() -> None:
    """Read the command line and run the stage."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--needs", type=Path, nargs="*", default=[])
    parser.add_argument("--state", default="")
    parser.add_argument("--commands", nargs="+", required=True)
    given = parser.parse_args()

    out: Path = given.out
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(beside(out, "begun.lock"), blocking=False):
            run(out, given.commands, given.needs, given.state)
    except Timeout:
        sys.exit(
            f"{out}: another process is at work on this stage; wait for it or stop it"
        )


if __name__ == "__main__":
    main()
