"""The numbers of the recognition: what each means, what it was chosen on, and what it changes.

    python -m benchmarks.numbers [DATA] [--measure]

``numbers.toml`` lists them and says what each was chosen on; value and meaning are read from the
source. With ``--measure`` each number that is not measured yet is halved and doubled, in a copy of
the package, on a few frames of ``benchmarks.gate`` (DATA as there); ``numbers.json`` keeps each
result as soon as it is there. ``numbers.md`` is written from these three. A number whose value
changes counts as not measured.
"""

from __future__ import annotations

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
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from benchmarks import gate

HERE = Path(__file__).parent
PACKAGE = HERE.parent / "src/nextview"
CASES = {"tables": (3, 4, 6, 7, 8, 10), "moves": (0, 1, 2, 3)}  # of the gate
REAL_EVERY = 3  # each so manyth real frame
CHANGES = {"halved": 0.5, "doubled": 2.0}
NOT_SCALED, LATER = "not scaled", "(later frames)"  # how entries of the list may begin
FIGURES = "known", "right", "sure right", "sure wrong", "told", "false alarms"
LOUD = 25  # percent of the CPU time, from which on a change of it is no noise
INTRODUCTION = """# The numbers

Every constant that a frame meets on [its path](../CONTRIBUTING.md#the-path-of-a-frame) through `src/nextview`, the most important modules first:
its value, its meaning (the comment in the source), and what it was chosen on. "By hand" means: one value that worked, no search.

`python -m benchmarks.numbers DATA --measure` halves and doubles each one. Of a number between 0.5 and 1, the distance to 1 is doubled and
halved instead; of a factor, what exceeds 1. The two last columns are differences in right names, confident right names and confident wrong
names, on {first[known]} known things: six tables of [the gate](gate.py) and seven real frames, one view each. As it is, {first[right]} are
right, {first[sure right]} with confidence, {first[sure wrong]} confident ones are wrong. "Later frames": on four tables on which a thing is moved or removed, {later[known]} known things
({later[right]} right, {later[sure right]} with confidence, {later[told]} of four changes noticed, {later[false alarms]} false alarms). **Two names are noise**: four of 261 are,
on all tables of the gate. "=": no name, no confidence and no pose changed, to the last digit. CPU time is given from a change by a quarter on.

| number | value | meaning | chosen on | halved | doubled |
|---|---|---|---|---|---|"""


class Number(NamedTuple):
    """A constant: its name, MODULE.NAME, its value, its comment, and the line where it ends."""

    name: str
    value: Any
    meaning: str
    line: int

    def scaled(self, factor: float) -> Any:
        """The value times a factor; of what is near 1 and below, or a factor, the distance to 1."""
        if isinstance(self.value, tuple):
            return tuple(one * factor for one in self.value)
        near = 0.5 < self.value < 1
        origin = int(near or self.meaning.startswith(("factor", "times")))
        value = origin + (self.value - origin) * (1 / factor if near else factor)
        return max(1, round(value)) if isinstance(self.value, int) else float(f"{value:.6g}")


def listed() -> dict[Number, str]:
    """The numbers of the list, with what each was chosen on."""
    choices = tomllib.loads((HERE / "numbers.toml").read_text())
    return {
        number: names[number.name.partition(".")[2]]
        for module, names in choices.items()
        for number in sorted(numbers_of(module, names), key=lambda one: list(names).index(one.name.partition(".")[2]))
    }


def numbers_of(module: str, names: Collection[str]) -> Iterator[Number]:
    """Constants of a module, such as ``things/score``."""
    lines = (PACKAGE / f"{module}.py").read_text().splitlines()
    for node in ast.parse("\n".join(lines)).body:
        if isinstance(node, ast.Assign):
            first = node.lineno - 1
            while lines[first - 1].startswith("# "):
                first -= 1
            words = re.findall(r"# (.*)", "\n".join(lines[first : node.end_lineno]))
            target, value = node.targets[0], node.value
            many = isinstance(target, ast.Tuple)
            for one, own in zip(target.elts, value.elts) if many else [(target, value)]:
                if one.id in names:
                    code = compile(ast.Expression(own), module, "eval")
                    number = eval(code, {"np": np})
                    yield Number(f"{module}.{one.id}", number, " ".join(words), node.end_lineno)


class Few(gate.Bench):
    """A bench of few cases: of tables the first frame, of moves all frames."""

    @cache
    def taught(self) -> tuple[Any, gate.Shapes]:
        """The same as of all benches, once."""
        return super().taught()

    def cases(self, part: str) -> Iterator[tuple[str, gate.Case]]:
        """The few cases of a part, each with its name."""
        for number in CASES[part]:
            seen = gate.case(part, number, self.scans, self.frames)
            first = replace(seen, depth=seen.depth[:1])
            yield f"{part} {number}", seen if part == "moves" else first


def answers(data: Path, later: bool) -> dict[str, Any]:
    """What the package answers on the frames, and the seconds that it takes."""
    bench = Few(data, Path("~/.cache/nextview/gate").expanduser(), REAL_EVERY)
    rows = [*gate.moves(bench)] if later else [*gate.tables(bench), *gate.real(bench)]
    seconds = sum(sum(row.pop("seconds")) for row in rows)
    figures = {key: sum(row.get(key, 0) for row in rows) for key in FIGURES}
    digest = hashlib.sha256(json.dumps(rows).encode()).hexdigest()[:16]
    return {**figures, "seconds": round(seconds, 1), "answers": digest}


def measured(package: Path, data: Path, later: bool) -> dict[str, Any]:
    """The answers of a copy of the package, in a process of its own."""
    call = f"answers(Path({str(data)!r}), {later})"
    run = subprocess.run(
        [sys.executable, "-c", f"from benchmarks.numbers import *; print(json.dumps({call}))"],
        cwd=HERE.parent,
        env={**os.environ, "PYTHONPATH": str(package.parent), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    lines = (run.stderr if run.returncode else run.stdout).splitlines()
    return {"error": lines[-1]} if run.returncode else json.loads(lines[-1])


def measure_all(data: Path, results: dict[str, Any]) -> Iterator[None]:
    """Measure what is not measured yet, in the order of the list."""
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder, "nextview")
        shutil.copytree(PACKAGE, package)
        for kind, later in (("first frames", False), ("later frames", True)):
            if kind not in results:
                results[kind] = measured(package, data, later)
                yield
        for number, chosen in listed().items():
            if chosen.startswith(NOT_SCALED) or is_measured(number, results):
                continue
            file = package / f"{number.name.partition('.')[0]}.py"
            text = file.read_text()
            lines = text.splitlines()
            result: dict[str, Any] = {"value": repr(number.value)}
            for change, factor in CHANGES.items():
                name, value = number.name.partition(".")[2], number.scaled(factor)
                changed = [*lines[: number.line], f"{name} = {value!r}", *lines[number.line :]]
                file.write_text("\n".join(changed))
                result[change] = measured(package, data, chosen.startswith(LATER))
            file.write_text(text)
            results[number.name] = result
            yield


def is_measured(number: Number, results: dict[str, Any]) -> bool:
    """Whether a number was measured with its present value."""
    return results.get(number.name, {}).get("value") == repr(number.value)


def changed(number: Number, change: str, chosen: str, results: dict[str, Any]) -> str:
    """What a change of a number changed, in a cell of the table."""
    if chosen.startswith(NOT_SCALED):
        return ""
    if not is_measured(number, results):
        return "not measured"
    now = results[number.name][change]
    before = results["later frames" if chosen.startswith(LATER) else "first frames"]
    if now.get("answers") == before["answers"]:
        return "="
    if "error" in now:
        return "fails"
    cost = round(100 * (now["seconds"] / before["seconds"] - 1))
    figures = ", ".join(f"{now[key] - before[key]:+d}" for key in FIGURES[1:] if before[key])
    return figures + f"; CPU {cost:+d} %" * (abs(cost) >= LOUD)


def page(results: dict[str, Any]) -> str:
    """The page, in Markdown."""
    first, later = results["first frames"], results["later frames"]
    lines = [INTRODUCTION.format(first=first, later=later)]
    for number, chosen in listed().items():
        module, _, name = number.name.partition(".")
        values = number.value if isinstance(number.value, tuple) else [number.value]
        value = ", ".join(f"{one:.6g}" for one in values)
        cells = [changed(number, change, chosen, results) for change in CHANGES]
        chosen = chosen.removeprefix(LATER).strip() + " (later frames)" * chosen.startswith(LATER)
        lines.append(" | ".join(["", f"`{module}` `{name}`", value, number.meaning, chosen, *cells, ""]))
    return "\n".join(lines).strip() + "\n"


def main(
    data: tyro.conf.Positional[Path] = Path(os.environ.get("NEXTVIEW_DATA", "data")),
    measure: bool = False,
) -> None:
    """Write numbers.md; measure before what is not measured yet."""
    file = HERE / "numbers.json"
    results = json.loads(file.read_text()) if file.exists() else {}
    for _ in measure_all(data, results) if measure else ():
        file.write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "numbers.md").write_text(page(results))


if __name__ == "__main__":
    tyro.cli(main)
