"""The API reference: one page for each room of the package, filled from its docstrings by
mkdocstrings.
"""

from __future__ import annotations

import inspect
from functools import cache
from pathlib import Path

import nextview

PACKAGE = Path(nextview.__file__).parent
ROOMS = {
    "Front door": ["session", "scene", "errors"],
    "Geometry": ["geometry"],
    "Sensing": ["sensing"],
    "Recognition": ["recognition"],
    "Simulation": ["simulation"],
    "Policies": ["policies"],
    "Data": ["data"],
    "Things": ["things"],
    "Captured frames": ["captured"],
    "Teaching": ["teaching"],
    "Training": ["training"],
    "Benchmark": ["benchmark"],
    "Viewers": ["viewers"],
}
"""Pages, and the modules and packages that each shows."""


@cache
def api_pages() -> dict[str, str]:
    """Markdown of each page by its place in the site; the first lists the names of ``import
    nextview``.
    """
    rows = [
        f"| {_link(name)} | {_first_sentence(getattr(nextview, name))} |"
        for name in nextview.__all__
    ]
    top = (
        "# API\n\nWhat `import nextview` offers:\n\n| name | |\n|---|---|\n"
        + "\n".join(rows)
        + "\n"
    )
    pages = {"api/index.md": top}
    for title, rooms in ROOMS.items():
        modules = [name for room in rooms for name in _modules(room)]
        blocks = "\n".join(
            f"::: {name}\n    options: {{heading_level: 2}}\n" for name in modules
        )
        pages[f"api/{title.lower().replace(' ', '_')}.md"] = f"# {title}\n\n{blocks}"
    return pages


def _modules(room: str) -> list[str]:
    """A module, or those of a package, that have something public to show."""
    path = PACKAGE / room
    files = (
        [path.with_suffix(".py")] if not path.is_dir() else sorted(path.rglob("*.py"))
    )
    names = [
        ".".join(("nextview", *file.relative_to(PACKAGE).with_suffix("").parts))
        for file in files
    ]
    return [name for name in names if not name.endswith("__init__")]


def _link(name: str) -> str:
    found = getattr(nextview, name)
    where = (
        f"{found.__module__}.{found.__qualname__}"
        if inspect.isroutine(found) or inspect.isclass(found)
        else ""
    )
    return f"[`nextview.{name}`][{where}]" if where else f"`nextview.{name}`"


def _first_sentence(found: object) -> str:
    text = " ".join((inspect.getdoc(found) or "").split("\n\n")[0].split())
    return text.partition(". ")[0].rstrip(".") + "."
