"""The wheels: what they ask for and hold."""

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECTS = {"nextview": ROOT, "nextview-lab": ROOT / "lab"}


def asked(name: str) -> dict:
    """The table ``project`` of a project."""
    return tomllib.loads((PROJECTS[name] / "pyproject.toml").read_text())["project"]


HOLES = {
    "distributed": ["2025.12.0"],  # CVE-2026-23528
    "filelock": [
        "3.20.2"
    ],  # CVE-2025-68146, CVE-2026-22701: links put in the place of locks
    "jinja2": ["3.1.5"],  # CVE-2025-27516
    "lightning": ["2.6.2", "2.6.3"],  # uploaded by someone else than its makers
    "onnx": ["1.20.1"],
    "pillow": ["11.3.0", "12.1.1"],
    "pyarrow": ["23.0.0"],  # CVE-2026-25087
    "pytest": ["9.0.2"],  # CVE-2025-71176
    "requests": ["2.32.5"],  # CVE-2026-25645
    "setuptools": ["78.1.0"],  # CVE-2025-47273
    "torch": ["2.9.1"],  # CVE-2026-24747: weights_only did not hold
}
"""Versions with known holes, the last before each was mended."""


@pytest.mark.parametrize("project", ["pyproject.toml", "lab/pyproject.toml"])
def test_no_version_with_a_known_hole_is_asked_for(project):
    table = tomllib.loads((ROOT / project).read_text())
    parts = table["project"].get("optional-dependencies", {}).values()
    asked = [
        *table["project"]["dependencies"],
        *table["build-system"]["requires"],
        *(each for p in parts for each in p),
    ]
    admitted = [
        f"{needed} admits {bad}"
        for needed in map(Requirement, asked)
        for bad in HOLES.get(needed.name, ())
        if needed.specifier.contains(bad)
    ]
    assert not admitted


def test_the_constraints_satisfy_the_requirements():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {
        canonicalize_name(name): version
        for name, _, version in (line.partition("==") for line in lines)
        if version
    }
    texts = [
        text
        for table in map(asked, PROJECTS)
        for texts in (table["dependencies"], *table["optional-dependencies"].values())
        for text in texts
    ]
    for needed in map(Requirement, texts):
        if needed.name not in PROJECTS:
            version = pinned[canonicalize_name(needed.name)]
            assert needed.specifier.contains(version), needed
