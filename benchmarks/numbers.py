"""The numbers of the recognition: what each means, what it was chosen on, and what it changes.

    python -m benchmarks.numbers [DATA] [--measure]

``numbers.toml`` lists them and says what each was chosen on; value and meaning are read from the
source. With ``--measure`` each number that is not measured yet is halved and doubled, in a copy of
the package, on a few frames of ``benchmarks.gate`` (DATA as there); ``numbers.json`` keeps each
result as soon as it is there. ``numbers.md`` is written from these three. A number whose value
changes counts as not measured.
"""

import ast
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from benchmarks import gate

HERE = Path(__file__).parent
PACKAGE = HERE.parent / "src/nextview"
LIST = tomllib.loads((HERE / "numbers.toml").read_text())
RESULTS = HERE / "numbers.json"
CASES = {"tables": (3, 4, 6, 7, 8, 10), "moves": (0, 1, 2, 3)}  # of the gate
FRAMES = "first frames", "later frames"
REAL_EVERY = 3  # each so manyth real frame
FIGURES = "right", "sure right", "sure wrong", "told", "false alarms"
LOUD = 40  # percent of the CPU time, from which on a change of it is no noise


class Number(NamedTuple):
    """A constant, MODULE.NAME: the line where it ends, the frames that measure it."""

    name: str
    value: Any
    meaning: str
    line: int
    chosen: str
    frames: str

    def scaled(self, factor: float) -> Any:
        """The value times a factor; of a factor, or a value near 1 and below, the distance to 1."""
        if isinstance(self.value, tuple):
            return tuple(one * factor for one in self.value)
        near = 0.5 < self.value < 1
        origin = int(near or self.meaning.startswith(("factor", "times")))
        value = origin + (self.value - origin) * (1 / factor if near else factor)
        return (
            max(1, round(value))
            if isinstance(self.value, int)
            else float(f"{value:.6g}")
        )


def numbers() -> Iterator[Number]:
    """The numbers of the list, in its order."""
    for frames, module in (
        (one, two) for one in (*FRAMES, "none") for two in LIST[one]
    ):
        text = (PACKAGE / f"{module}.py").read_text()
        lines = text.splitlines()
        found = {}
        for node in ast.parse(text).body:
            if isinstance(node, ast.Assign):
                first = node.lineno - 1
                while lines[first - 1].startswith("# "):
                    first -= 1
                own = "\n".join(lines[first : node.end_lineno])
                words = " ".join(re.findall(r"# (.*)", own))
                names = ast.unparse(node.targets[0]).strip("()").split(", ")
                parts = node.value.elts if len(names) > 1 else [node.value]
                for name, part in zip(names, parts, strict=True):
                    found[name] = part, words, node.end_lineno
        for name, chosen in LIST[frames][module].items():
            part, words, line = found[name]
            value = eval(ast.unparse(part), {"np": np})
            yield Number(f"{module}.{name}", value, words, line, chosen, frames)


class Few(gate.Bench):
    """A bench of few cases: of tables the first frame, of moves all frames."""

    taught = cache(gate.Bench.taught)

    def cases(self, part: str) -> Iterator[tuple[str, gate.Case]]:
        """The few cases of a part, each with its name."""
        for number in CASES[part]:
            seen = gate.case(part, number, self.scans, self.frames)
            frames = 1 if part == "tables" else len(seen.depth)
            yield f"{part} {number}", replace(seen, depth=seen.depth[:frames])


def answers(data: Path, frames: str) -> dict[str, Any]:
    """What the package answers on the frames, and the seconds that it takes."""
    bench = Few(data, Path("~/.cache/nextview/gate").expanduser(), REAL_EVERY)
    first = frames == "first frames"
    rows = (
        [*gate.tables(bench), *gate.real(bench)] if first else list(gate.moves(bench))
    )
    seconds = sum(sum(row.pop("seconds")) for row in rows)
    figures = {key: sum(row.get(key, 0) for row in rows) for key in ("known", *FIGURES)}
    digest = hashlib.sha256(json.dumps(rows).encode()).hexdigest()[:16]
    return {**figures, "seconds": round(seconds, 1), "answers": digest}


def answers_of(package: Path, data: Path, frames: str) -> dict[str, Any]:
    """The answers of a copy of the package, in a process of its own."""
    call = f"answers(Path({str(data)!r}), {frames!r})"
    run = subprocess.run(
        [
            sys.executable,
            "-c",
            f"from benchmarks.numbers import *; print(json.dumps({call}))",
        ],
        cwd=HERE.parent,
        env={**os.environ, "PYTHONPATH": str(package.parent), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    lines = (run.stderr if run.returncode else run.stdout).splitlines()
    return {"error": lines[-1]} if run.returncode else json.loads(lines[-1])


def measure_all(
    data: Path, only: tuple[str, ...], results: dict[str, Any]
) -> Iterator[None]:
    """Measure what is not measured yet, in the order of the list."""
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder, "nextview")
        shutil.copytree(PACKAGE, package)
        for frames in FRAMES:
            if frames not in results:
                results[frames] = answers_of(package, data, frames)
                yield
        for one in list(numbers()):  # of the source that is copied
            wanted = one.frames in FRAMES and one.name.startswith(only)
            if wanted and changes_of(one, results) is None:
                module, _, name = one.name.partition(".")
                file = package / f"{module}.py"
                text = file.read_text()
                lines = text.splitlines()
                result: dict[str, Any] = {"value": repr(one.value)}
                for change, factor in (("halved", 0.5), ("doubled", 2.0)):
                    value = f"{name} = {one.scaled(factor)!r}"
                    file.write_text(
                        "\n".join([*lines[: one.line], value, *lines[one.line :]])
                    )
                    result[change] = answers_of(package, data, one.frames)
                file.write_text(text)
                results[one.name] = result
                yield


def changes_of(number: Number, results: dict[str, Any]) -> tuple[str, str] | None:
    """What it changes to halve and to double a number, in words; None if it is not measured."""
    result = results.get(number.name, {})
    before = results.get(number.frames)
    if before is None or result.get("value") != repr(number.value):
        return None
    said = []
    for now in (result["halved"], result["doubled"]):
        if "error" in now:
            said.append("fails")
        elif now["answers"] == before["answers"]:
            said.append("=")
        else:
            keys = FIGURES if before["told"] else FIGURES[:3]
            figures = ", ".join(f"{now[key] - before[key]:+d}" for key in keys)
            cost = round(100 * (now["seconds"] / before["seconds"] - 1))
            said.append(figures + f"; CPU {cost:+d} %" * (abs(cost) >= LOUD))
    return said[0], said[1]


def page(results: dict[str, Any]) -> str:
    """The page, in Markdown."""
    first, later = results["first frames"], results["later frames"]
    lines = [LIST["introduction"].format(first=first, later=later).strip()]
    for one in numbers():
        module, _, name = one.name.partition(".")
        values = one.value if isinstance(one.value, tuple) else [one.value]
        value = ", ".join(f"{value:.6g}" for value in values)
        changes = changes_of(one, results) or (
            "not measured" * (one.frames in FRAMES),
            "",
        )
        cells = [f"`{module}` `{name}`", value, one.meaning, one.chosen, *changes]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(
    data: tyro.conf.Positional[Path] = Path(os.environ.get("NEXTVIEW_DATA", "data")),
    measure: bool = False,
    only: tuple[str, ...] = ("",),
) -> None:
    """Write numbers.md.

    Args:
        data: folder of the gate.
        measure: first measure what is not measured yet.
        only: how the names of the numbers to measure begin, such as things/score.
    """
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for _ in measure_all(data, only, results) if measure else ():
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "numbers.md").write_text(page(results))


if __name__ == "__main__":
    tyro.cli(main)
