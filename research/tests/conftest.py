"""Fixtures of the tiny pipeline, and the names that an installed research package adds, as pip
would write them.
"""

import runpy
import sys
import tomllib
from pathlib import Path

import pytest

from nextview.checks import plugins

ROOT = Path(__file__).parents[2]
PIPELINE = runpy.run_path(str(ROOT / "lab/tests/conftest.py"))
views, archive = (PIPELINE[name] for name in ("views", "archive"))


@pytest.fixture(scope="package", autouse=True)
def installed(tmp_path_factory):
    project = tomllib.loads((ROOT / "research/pyproject.toml").read_text())["project"]
    folder = tmp_path_factory.mktemp("site")
    info = folder / "nextview_research-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: nextview-research\nVersion: 0\n"
    )
    with (info / "entry_points.txt").open("w") as file:
        for group, names in project["entry-points"].items():
            print(
                f"[{group}]",
                *(f"{name} = {path}" for name, path in names.items()),
                sep="\n",
                file=file,
            )
    sys.path.append(str(folder))
    plugins.cache_clear()
    yield
    sys.path.remove(str(folder))
    plugins.cache_clear()
