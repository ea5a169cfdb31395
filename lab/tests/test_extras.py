"""What is imported is a dependency, or belongs to an extra that an error names; help needs none."""

import ast
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from linked_environment import ROOT, installation
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from nextview.checks import EXTRAS
from nextview_lab.extras import EXTRAS as EXTRAS_OF_LAB

SOURCES = sorted([*(ROOT / "src").rglob("*.py"), *(ROOT / "lab/src").rglob("*.py")])


def project(folder: str) -> dict:
    return tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]


def names(requirements) -> set[str]:
    return {canonicalize_name(Requirement(text).name) for text in requirements}


def imported(tree: ast.AST, in_extras: bool = False):
    """The packages that code imports, not for types alone, and whether that stands in ``with
    extras()``.
    """
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (
                (alias.name.partition(".")[0], in_extras) for alias in node.names
            )
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module.partition(".")[0], in_extras
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from imported(ast.Module(node.orelse, []), in_extras)
        else:
            here = isinstance(node, ast.With) and any(
                ast.unparse(i.context_expr) == "extras()" for i in node.items
            )
            yield from imported(node, in_extras or here)


@cache
def brought_by() -> dict[str, set[str]]:
    """The distributions that bring each package which is installed here."""
    return {
        package: set(map(canonicalize_name, names))
        for package, names in packages_distributions().items()
    }


def faults(code: str, folder: str = ".") -> list[str]:
    """What is wrong with the imports of some code of a project, a phrase each."""
    table = project(folder)
    base = names(table["dependencies"])
    by_extra = {
        extra: names(asked) for extra, asked in table["optional-dependencies"].items()
    }
    declared = EXTRAS if folder == "." else EXTRAS_OF_LAB
    own = ("nextview", "nextview_command")
    if folder == "lab":
        own += ("nextview_lab", "nextview_lab_command")
    found = []
    for package, in_extras in sorted(set(imported(ast.parse(code)))):
        if package in sys.stdlib_module_names or package in own:
            continue
        distributions = brought_by().get(package, set())
        if distributions & base:
            continue
        extras = [extra for extra, packages in declared.items() if package in packages]
        if not any(distributions & by_extra[extra] for extra in extras):
            found.append(f"{package}: neither a dependency nor of an extra in EXTRAS")
        elif not in_extras:
            found.append(f"{package}: imported outside of extras()")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_all_imports_are_declared_dependencies(path):
    folder = "lab" if path.is_relative_to(ROOT / "lab") else "."
    assert faults(path.read_text(encoding="utf-8"), folder) == []


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    """The Python of an installation of package and laboratory without any extra."""
    return installation(tmp_path_factory.mktemp("base") / "venv", {"nextview-lab": ()})


def in_base(base: Path, code: str, *arguments: str) -> str:
    done = subprocess.run(
        [str(base), "-c", code, *arguments],
        cwd=ROOT,
        env={},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


IMPORT_ALL = """
import pkgutil, sys
from importlib import import_module
import nextview, nextview_lab

for package in (nextview, nextview_lab):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if module.name.endswith(".__main__"):
            continue
        try:
            import_module(module.name)
        except nextview.MissingExtraError as error:
            print(module.name, error)
print("torch" in sys.modules)
"""


def test_every_module_imports_in_the_base_installation_or_names_its_extra(base):
    *missing, torch_is_there = in_base(base, IMPORT_ALL).splitlines()
    assert torch_is_there == "False"
    assert any(line.startswith("nextview_lab.training.export ") for line in missing)
    for line in missing:
        named = [
            extra
            for project, declared in (
                ("nextview", EXTRAS),
                ("nextview-lab", EXTRAS_OF_LAB),
            )
            for extra in declared
            if line.endswith(f": pip install '{project}[{extra}]'")
        ]
        assert len(named) == 1, line
