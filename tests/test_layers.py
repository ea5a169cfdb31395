"""The layers of the package and of the laboratory: each imports only from layers above it in its
table in CONTRIBUTING.md, and nothing in the package imports the laboratory.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "nextview": ROOT / "src/nextview",
    "nextview_lab": ROOT / "lab/src/nextview_lab",
}
# the packages' own doors, which open onto every layer
SHELL = {"__init__", "__main__"}


def layers_of_the_table(package: str) -> list[str]:
    """The layers in the order of the table; names that share a row have the same height."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    heading = f"| layer of `{package}` | what is in it |"
    table = text.split(heading)[1].split("\n\n")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return [name for row in rows for name in re.findall(r"`(\w+)`", row)]


LAYERS = {package: layers_of_the_table(package) for package in PACKAGES}


def modules_imported(path: Path) -> set[str]:
    """Modules of both packages that a file imports, at its top or inside a function."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            module = node.module or ""
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.partition(".")[0] in PACKAGES}


def test_nothing_in_the_package_imports_the_laboratory() -> None:
    for path in PACKAGES["nextview"].rglob("*.py"):
        for module in modules_imported(path):
            assert not module.startswith("nextview_lab"), f"{path} imports {module}"


@pytest.mark.parametrize("package", PACKAGES)
def test_the_table_names_every_layer(package: str) -> None:
    entries = {
        path.stem
        for path in PACKAGES[package].iterdir()
        if path.suffix == ".py" or path.is_dir()
    }
    assert {entry for entry in entries if entry.isidentifier()} - SHELL - {
        "__pycache__"
    } == set(LAYERS[package])


@pytest.mark.parametrize(
    ("package", "layer"),
    [(package, layer) for package, layers in LAYERS.items() for layer in layers],
)
def test_a_layer_imports_from_layers_above_it(package: str, layer: str) -> None:
    folder = PACKAGES[package]
    single = folder / f"{layer}.py"
    files = [single] if single.exists() else sorted((folder / layer).rglob("*.py"))
    assert files

    layers = LAYERS[package]
    height = layers.index(layer)
    for path in files:
        for module in modules_imported(path):
            top, *rest = module.split(".")
            if top == package and rest and rest[0] in layers:
                assert layers.index(rest[0]) <= height, f"{path} imports {module}"


@pytest.mark.parametrize("package", PACKAGES)
def test_no_two_modules_import_each_other_in_a_circle(package: str) -> None:
    folder = PACKAGES[package]
    modules = {
        ".".join(path.relative_to(folder.parent).with_suffix("").parts): path
        for path in folder.rglob("*.py")
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
