"""The wheels: what they ask for and hold.

With NEXTVIEW_WHEELS=all, pip installs them and each extra from an index, as a user would.
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECTS = {"nextview": ROOT, "nextview-lab": ROOT / "lab"}


def asked(name: str) -> dict:
    """The table ``project`` of a project."""
    return tomllib.loads((PROJECTS[name] / "pyproject.toml").read_text())["project"]


EXAMPLES = {
    ("nextview", ""): (
        "import nextview; assert nextview.recognise('samples/chair.off', start=3).answer == 'chair'"
    ),
    ("nextview", "cluster"): (
        "from distributed import LocalCluster; import nextview.data.pool"
    ),
    ("nextview", "bags"): "import rosbags; from nextview.captured.bag import Bag",
    ("nextview", "workflow"): "import snakemake",
    ("nextview", "explore"): (
        "import viser; from nextview.viewers.exploration import Exploration"
    ),
    ("nextview", "browser"): "import playwright",
    ("nextview", "large"): "import faiss",
    ("nextview", "record"): (
        "import rerun; from nextview.viewers.recording import Recorder"
    ),
    ("nextview", "docs"): (
        "import material, mkdocs, mkdocs_jupyter, mkdocstrings_handlers.python"
    ),
    ("nextview", "dev"): "import hypothesis, mypy, pytest, ruff, skimage",
    ("nextview-lab", ""): "import nextview_lab.data.rendering, nextview_lab.data.store",
    ("nextview-lab", "arm"): (
        "from nextview_lab.studies.staged_things import physics; physics();"
        " import gymnasium_robotics, mink"
    ),
    ("nextview-lab", "benchmark"): (
        "from nextview_lab.benchmark.classes import benchmark_classes;"
        " from nextview_lab.benchmark.report import report"
    ),
    ("nextview-lab", "train"): (
        "import lightning, torch; from nextview_lab.training import export, runs"
    ),
    ("nextview-lab", "envs"): (
        "import gymnasium, nextview_lab.benchmark.environments;"
        " gymnasium.spec('nextview/Recognise-v0')"
    ),
}
"""One line for each extra of each project, and for none."""
EMPTY_ENVIRONMENT = {
    name: value
    for name, value in os.environ.items()
    if not name.startswith(("PYTHON", "PIP_TARGET"))
}


def run(*command, cwd=ROOT, timeout=600):
    done = subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        env=EMPTY_ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """The wheel of each project, built from a copy, which setuptools may fill with what it makes;
    by the environment's own setuptools.
    """
    folder = tmp_path_factory.mktemp("wheels")
    unwanted = shutil.ignore_patterns("*.egg-info", "__pycache__")
    for name in ("src", "samples", "lab"):
        shutil.copytree(ROOT / name, folder / name, ignore=unwanted)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    built = {}
    for project, source in PROJECTS.items():
        dist = folder / "dist" / project
        run(
            *pip,
            "wheel",
            "--quiet",
            "--no-deps",
            "--no-index",
            "--no-build-isolation",
            "-w",
            dist,
            folder / source.relative_to(ROOT),
        )
        (built[project],) = dist.glob("*.whl")
    return built


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


ALL = pytest.mark.skipif(
    os.environ.get("NEXTVIEW_WHEELS") != "all",
    reason="NEXTVIEW_WHEELS=all builds them and installs from an index",
)


@ALL
@pytest.mark.parametrize("project", PROJECTS)
def test_it_contains_only_the_package(wheels, project):
    names = zipfile.ZipFile(wheels[project]).namelist()
    module = project.replace("-", "_")
    tops = {name.split("/")[0] for name in names}
    assert {re.sub(r"-.*\.dist-info", "", top) for top in tops} == {
        module,
        f"{module}_command.py",
    }
    source = PROJECTS[project] / "src" / module
    data = [
        path
        for path in source.rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc", ".toml")
    ]
    assert {f"{module}/{path.relative_to(source).as_posix()}" for path in data} <= set(
        names
    )


@ALL
@pytest.mark.parametrize(("project", "extra"), EXAMPLES)
def test_pip_installs_it(wheels, project, extra, tmp_path):
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv/bin/python"
    part = f"[{extra}]" if extra else ""
    wanted = [f"{project}{part} @ {wheels[project].as_uri()}"]
    if project != "nextview":
        wanted.append(f"nextview @ {wheels['nextview'].as_uri()}")
    run(
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-compile",
        "-c",
        ROOT / "constraints.txt",
        *wanted,
        timeout=3000,
    )
    run(python, "-c", EXAMPLES[project, extra], cwd=wheels[project].parents[2])
    assert "nextview 0" in run(tmp_path / "venv/bin/nextview", "--version")
