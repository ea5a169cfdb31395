"""The API reference: one page for each room of the package, filled from its docstrings by
mkdocstrings.
"""

from __future__ import annotations

import inspect
from functools import cache
from pathlib import Path

import nextview
import nextview_lab

SOURCES = {
    "nextview": Path(nextview.__file__).parent,
    "nextview_lab": Path(nextview_lab.__file__).parent,
}
ROOMS = {
    "Front door": ["nextview.session", "nextview.scene", "nextview.errors"],
    "Geometry": ["nextview.geometry"],
    "Sensing": ["nextview.sensing"],
    "Recognition": ["nextview.recognition"],
    "Simulation": ["nextview.simulation"],
    "Policies": ["nextview.policies"],
    "Data": ["nextview.data", "nextview_lab.data", "nextview_lab.worlds"],
    "Things": ["nextview.things"],
    "Captured frames": ["nextview.captured"],
    "Teaching": ["nextview.teaching"],
    "Training": ["nextview_lab.training"],
    "Benchmark": ["nextview_lab.benchmark", "nextview_lab.errors"],
    "Viewers": ["nextview.viewers"],
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
    package, _, name = room.partition(".")
    folder = SOURCES[package]
    path = folder / name
    files = (
        [path.with_suffix(".py")] if not path.is_dir() else sorted(path.rglob("*.py"))
    )
    names = [
        ".".join((package, *file.relative_to(folder).with_suffix("").parts))
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
