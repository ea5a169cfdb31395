"""The layers of the package: each imports only from layers above it in CONTRIBUTING.md's table."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "nextview"
SHELL = {"__init__", "__main__"}  # the package's own doors, which open onto every layer


def layers_of_the_table() -> list[str]:
    """The layers in the order of the table; names that share a row have the same height."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.split("| layer | what is in it |")[1].split("\n\n")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return [name for row in rows for name in re.findall(r"`(\w+)`", row)]


LAYERS = layers_of_the_table()


def modules_imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, at its top or inside a function."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            module = node.module or ""
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("nextview.")}


def room_of(module: str) -> str:
    return module.split(".")[1]


def test_the_table_names_every_layer() -> None:
    entries = {
        path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()
    }
    assert {entry for entry in entries if entry.isidentifier()} - SHELL - {
        "__pycache__"
    } == set(LAYERS)


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_imports_from_layers_above_it(layer: str) -> None:
    single = PACKAGE / f"{layer}.py"
    files = [single] if single.exists() else sorted((PACKAGE / layer).rglob("*.py"))
    assert files

    height = LAYERS.index(layer)
    for path in files:
        for module in modules_imported(path):
            other = room_of(module)
            if other in LAYERS:
                assert LAYERS.index(other) <= height, f"{path} imports {module}"


def test_no_two_modules_import_each_other_in_a_circle() -> None:
    modules = {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path
        for path in PACKAGE.rglob("*.py")
    }
    arrows = {
        name: {
            target
            for found in modules_imported(path)
            for target in (found, found.rsplit(".", 1)[0])
            if target in modules and target != name
        }
        for name, path in modules.items()
        if path.stem not in SHELL
    }

    done: set[str] = set()
    while len(done) < len(arrows):
        free = {name for name in arrows if name not in done and arrows[name] <= done}
        assert free, f"a circle among {sorted(set(arrows) - done)}"
        done |= free


def names_bound_at_the_top(path: Path) -> set[str]:
    """Constants, types and classes of a module; those with an underscore are its own."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [name for target in targets for name in ast.walk(target)]
            found |= {name.id for name in names if isinstance(name, ast.Name)}
    return {name for name in found if not name.startswith("_") and name != "log"}


def test_a_constant_or_class_has_one_meaning_in_the_whole_package() -> None:
    modules: dict[str, list[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for name in names_bound_at_the_top(path):
            modules.setdefault(name, []).append(str(path.relative_to(PACKAGE)))

    assert {name: where for name, where in modules.items() if len(where) > 1} == {}
