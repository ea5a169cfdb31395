"""The wheel: built, installed into an empty environment, and run with nothing but what it asks for.

Always: what the wheel asks for is linked from the environment of the tests, so that nothing else
can be imported. With NEXTVIEW_WHEELS=all, pip installs the wheel and each extra from an index, as a
user would.
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import Distribution, PackageNotFoundError
from pathlib import Path

import pytest
from linked_environment import asked_for, empty_environment, link
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
    "optional-dependencies"
]
EXAMPLES = {
    "": (
        "import nextview; assert nextview.recognise('samples/chair.off', start=3).answer == 'chair'"
    ),
    "benchmark": (
        "from nextview.benchmark.classes import benchmark_classes;"
        " from nextview.benchmark.report import report"
    ),
    "cluster": "from distributed import LocalCluster; import nextview.data.pool",
    "bags": "import rosbags; from nextview.captured.bag import Bag",
    "train": "import lightning, torch; from nextview.training import export, runs",
    "workflow": "import snakemake",
    "explore": "import viser; from nextview.viewers.exploration import Exploration",
    "browser": "import playwright",
    "large": "import faiss",
    "record": "import rerun; from nextview.viewers.recording import Recorder",
    "envs": (
        "import gymnasium, nextview.benchmark.environments; gymnasium.spec('nextview/Recognise-v0')"
    ),
    "docs": "import material, mkdocs, mkdocs_jupyter, mkdocstrings_handlers.python",
    "dev": "import hypothesis, mypy, pytest, ruff, skimage",
}
"""One line for each extra, and for none."""
QUICK = ("", "bags", "benchmark", "cluster", "envs", "record")
"""Those that are tried always: the others import for seconds."""
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
def wheel(tmp_path_factory):
    """Built from a copy, which setuptools may fill with what it makes; by the environment's own
    setuptools.
    """
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("src", "samples"):
        shutil.copytree(
            ROOT / name,
            folder / name,
            ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"),
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(
        *pip,
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "-w",
        folder / "dist",
        folder,
    )
    (built,) = (folder / "dist").glob("*.whl")
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


@pytest.mark.parametrize("project", ["pyproject.toml", "research/pyproject.toml"])
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
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for needed in map(
        Requirement,
        table["dependencies"] + [each for extra in EXTRAS.values() for each in extra],
    ):
        assert needed.specifier.contains(pinned[canonicalize_name(needed.name)]), needed


def test_every_extra_has_an_example():
    assert set(EXAMPLES) == {"", *EXTRAS}


@pytest.mark.parametrize(
    "extra",
    EXAMPLES if os.environ.get("NEXTVIEW_WHEELS") == "all" else QUICK,
)
def test_it_runs_with_its_declared_requirements(wheel, extra, tmp_path):
    python, packages = empty_environment(tmp_path / "venv")
    zipfile.ZipFile(wheel).extractall(packages)
    (own,) = packages.glob("nextview-*.dist-info")
    try:
        found = asked_for([(text, extra) for text in Distribution.at(own).requires])
    except PackageNotFoundError as missing:
        pytest.skip(
            f"the extra {extra} is not installed here: {missing.name} is missing"
        )
    for installed in found.values():
        link(installed, packages)
    code = f"{EXAMPLES[extra]}; import nextview; print(nextview.__file__)"
    assert f"{packages}" in run(python, "-c", code, cwd=wheel.parents[1])


def test_it_contains_only_the_package(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {re.sub(r"-.*\.dist-info", "", top) for top in tops} == {
        "nextview",
        "nextview_command.py",
    }
    source = ROOT / "src/nextview"
    data = [
        path
        for path in source.rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc", ".toml")
    ]
    assert {f"nextview/{path.relative_to(source).as_posix()}" for path in data} <= set(
        names
    )


@pytest.mark.skipif(
    os.environ.get("NEXTVIEW_WHEELS") != "all",
    reason="NEXTVIEW_WHEELS=all installs from an index",
)
@pytest.mark.parametrize("extra", EXAMPLES)
def test_pip_installs_it(wheel, extra, tmp_path):
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv/bin/python"
    wanted = f"nextview[{extra}] @ {wheel.as_uri()}" if extra else wheel
    run(
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-compile",
        "-c",
        ROOT / "constraints.txt",
        wanted,
        timeout=3000,
    )
    run(python, "-c", EXAMPLES[extra], cwd=wheel.parents[1])
    assert "nextview 0" in run(tmp_path / "venv/bin/nextview", "--version")
