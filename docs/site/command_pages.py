"""One page for each command: its own help, and the lines of the documentation that use it."""

from __future__ import annotations

import io
import os
import re
from contextlib import redirect_stdout, suppress
from functools import cache
from pathlib import Path
from unittest.mock import patch

from nextview.cli.commands import NEXTVIEW, Program
from nextview.cli.main import run
from nextview_lab.cli.commands import LABORATORY

ROOT = Path(__file__).parents[2]
GUIDES = ("your_camera", "dataset", "training", "add_a_policy", "results")
SOURCES = ["README.md", *(f"docs/{name}.md" for name in GUIDES)]
"""Where examples are looked for, the best first; the research notes tell what was run once."""
COLUMNS = "96"
PROGRAMS = (NEXTVIEW, LABORATORY)


@cache
def command_pages() -> dict[str, str]:
    """Markdown of each page by its place in the site; the first lists them all."""
    examples, pages, rows = _examples(), {}, []
    for program in PROGRAMS:
        for words, command in program.commands.items():
            called = f"{program.name} {words}"
            uri = f"commands/{called.replace(' ', '-')}.md"
            rows.append(f"| [`{called}`](../{uri}) | {command.line} |")
            pages[uri] = (
                f"# {called}\n\n```text\n{help_of(program, words)}```\n\n"
                f"{_used(examples.get(called, {}))}"
            )
    table = "\n".join(["| command | |", "|---|---|", *rows])
    top = (
        "# Commands\n\nEach page is the command's own help, which `--help` prints."
        " `nextview-lab` is the laboratory: data sets, training, benchmarks."
        f"\n\n{table}\n"
    )
    return {"commands/index.md": top} | pages


def help_of(program: Program, words: str) -> str:
    """What ``PROGRAM WORDS --help`` prints, without trailing spaces."""
    printed = io.StringIO()
    plain = {"COLUMNS": COLUMNS, "NO_COLOR": "1"}
    with patch.dict(os.environ, plain), redirect_stdout(printed), suppress(SystemExit):
        run(program, [*words.split(), "--help"])
    return (
        "\n".join(line.rstrip() for line in printed.getvalue().strip().splitlines())
        + "\n"
    )


def _examples() -> dict[str, dict[str, str]]:
    """Of each command, the lines that use it and the page where each stands first."""
    names = [
        f"{program.name} {words}" for program in PROGRAMS for words in program.commands
    ]
    names.sort(key=len, reverse=True)
    found: dict[str, dict[str, str]] = {}
    for source in SOURCES:
        for line in re.findall(
            r"^ {0,4}(nextview(?:-lab)? [a-z].*?)\s*(?:  #.*)?$",
            (ROOT / source).read_text(),
            re.M,
        ):
            words = next(
                (name for name in names if f"{line} ".startswith(f"{name} ")),
                None,
            )
            if words:
                found.setdefault(words, {}).setdefault(line, source)
    return found


def _used(lines: dict[str, str]) -> str:
    if not lines:
        return ""
    by_page: dict[str, list[str]] = {}
    for line, source in lines.items():
        by_page.setdefault(source, []).append(line)
    parts = ["## In use\n"]
    for source, each in by_page.items():
        commands = "\n".join(each)
        title = Path(source).stem.replace("_", " ")
        parts.append(f"In [{title}](../../{source}):\n\n```sh\n{commands}\n```\n")
    return "\n".join(parts)
