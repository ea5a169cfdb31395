"""The version stands in step everywhere, and what the workflows run is there."""

import os
import re
import tomllib
from datetime import date
from pathlib import Path

import pytest
import yaml

import nextview

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


def top_of_changelog() -> tuple[str, str]:
    """The version of the newest section, and what stands in brackets behind it."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    found = re.search(r"^## (\S+) \(([^)]+)\)$", text, re.M)
    assert found, "the newest section is called '## VERSION (DATE or unreleased)'"
    return found[1], found[2]


def citation() -> dict:
    return yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


def test_version_citation_and_changelog_are_in_step():
    cited = citation()
    assert cited["version"] == nextview.__version__
    assert isinstance(cited["date-released"], date)
    assert top_of_changelog()[0] == nextview.__version__


@pytest.mark.skipif("NEXTVIEW_RELEASE" not in os.environ, reason="no release is made")
def test_a_release_has_the_tag_of_its_version_and_a_date():
    version, when = top_of_changelog()
    assert os.environ["NEXTVIEW_RELEASE"] == f"v{version}"
    assert re.fullmatch(r"\d{4}-\d{2}-\d{2}", when), "date the section before a release"
    assert citation()["date-released"].isoformat() == when


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_all_files_of_the_workflows_exist(workflow):
    """Make's targets, files of the repository and extras that a workflow names."""
    text = workflow.read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"\bmake ([\w./-]+)", text):
        assert re.search(rf"^{re.escape(target)}:", makefile, re.M), target
    for path in re.findall(
        r"(?<![\w./])(?:tests|workflow|samples|docs|\.ci)/[\w./-]+\w", text
    ):
        assert (ROOT / path).exists(), path
    for folder, names in re.findall(r"(\.|\./lab)\[([\w,-]+)\]", text):
        project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())
        extras = project["project"]["optional-dependencies"]
        assert set(names.split(",")) <= set(extras), names
