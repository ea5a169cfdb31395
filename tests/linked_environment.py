"""Environments with nothing but what is asked for, linked from the environment of the tests: made
in a second.

What is not asked for cannot be imported there, as after a plain ``pip install``, and nothing is
fetched.
"""

import sysconfig
import tomllib
import venv
from collections.abc import Iterable, Mapping
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
# what is installed from this repository: the folder of each project, and that of its modules
PROJECTS = {"nextview": (".", "src"), "nextview-lab": ("lab", "lab/src")}
COMMANDS = {"nextview": "nextview_command", "nextview-lab": "nextview_lab_command"}

# by the name, in lower case, and the extra of it that is asked for
Found = dict[tuple[str, str], Distribution]


def empty_environment(folder: Path) -> tuple[Path, Path]:
    """Make an environment without anything; its Python, and where its packages go."""
    venv.create(folder, with_pip=False)
    base = {"base": str(folder), "platbase": str(folder)}
    python = Path(sysconfig.get_path("scripts", "venv", base)) / "python"
    packages = Path(sysconfig.get_path("purelib", "venv", base))
    return python, packages


def asked_for(
    requirements: Iterable[tuple[str, str]], found: Found | None = None
) -> Found:
    """The installed distributions that requirements need, theirs included.

    Args:
        requirements: each with the extra for which it is asked for, "" for none.
        found: those that are found already; it grows.

    Raises:
        PackageNotFoundError: one is not installed.
    """
    found = {} if found is None else found
    for text, extra in requirements:
        needed = Requirement(text)
        if needed.name in PROJECTS or (
            needed.marker and not needed.marker.evaluate({"extra": extra})
        ):
            continue
        installed = distribution(needed.name)
        for wanted in ("", *needed.extras):
            if (needed.name.lower(), wanted) not in found:
                found[needed.name.lower(), wanted] = installed
                asked_for([(each, wanted) for each in installed.requires or ()], found)
    return found


def link(installed: Distribution, packages: Path) -> None:
    """Link what a distribution has at the top of its packages' folder into another one."""
    home = Path(installed.locate_file(""))
    tops = {file.parts[0] for file in installed.files or ()} - {"..", "__pycache__"}
    for name in tops:
        place = packages / name
        if place.is_dir() and not place.is_symlink():
            for inner in (home / name).iterdir():
                if not (place / inner.name).exists():
                    (place / inner.name).symlink_to(inner)
        elif not place.exists() and (home / name).exists():
            if (
                (home / name).is_dir()
                and not (home / name / "__init__.py").exists()
                and "-" not in name
            ):
                place.mkdir()  # several distributions may share a namespace
                link(installed, packages)
            else:
                place.symlink_to(home / name)


def installation(
    folder: Path, projects: Mapping[str, Iterable[str]] = {"nextview": ()}
) -> Path:
    """Make an environment in which this clone is installed, with its commands; returns its Python.

    Args:
        folder: to be made.
        projects: extras by the name of the project, as in PROJECTS. What a project asks for of
            the others is installed, too.

    Raises:
        PackageNotFoundError: something that is asked for is not installed in the environment of the
            tests.
    """
    python, packages = empty_environment(folder)
    requirements = requirements_of(projects)
    others = [(text, "") for texts in requirements.values() for text in texts]
    for installed in asked_for(others).values():
        link(installed, packages)

    for name in requirements:
        about = f"{name.replace('-', '_')}-{distribution(name).version}.dist-info"
        (packages / about).symlink_to(distribution(name).locate_file(about))
        if name in COMMANDS:
            command = python.parent / name
            run = f"import sys; from {COMMANDS[name]} import main; sys.exit(main())"
            command.write_text(f"#!{python}\n{run}\n", encoding="utf-8")
            command.chmod(0o755)
    (packages / "this_clone.pth").write_text(
        "".join(f"{ROOT / PROJECTS[name][1]}\n" for name in requirements),
        encoding="utf-8",
    )
    return python


def requirements_of(projects: Mapping[str, Iterable[str]]) -> dict[str, set[str]]:
    """What projects of this repository and their extras ask for, those that they need included.

    Args:
        projects: extras by the name of the project.

    Returns:
        Requirements of other distributions, by the name of the project that asks for them.
    """
    found: dict[str, set[str]] = {}
    waiting = [
        (name, extra) for name, extras in projects.items() for extra in ("", *extras)
    ]
    done = set()
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in done:
            continue
        done.add((name, extra))
        file = ROOT / PROJECTS[name][0] / "pyproject.toml"
        table = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        texts = (
            table["optional-dependencies"][extra] if extra else table["dependencies"]
        )
        found.setdefault(name, set())
        for text in texts:
            needed = Requirement(text)
            if needed.name in PROJECTS:
                waiting += [(needed.name, each) for each in ("", *needed.extras)]
            else:
                found[name].add(text)
    return found
