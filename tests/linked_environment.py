"""Environments with nothing but what is asked for, linked from the environment of the tests: made
in a second.

What is not asked for cannot be imported there, as after a plain ``pip install``, and nothing is
fetched.
"""

import sysconfig
import tomllib
import venv
from collections.abc import Iterable
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
OWN = ("nextview", "nextview-research")  # what is installed from this repository
COMMAND = "import sys; from nextview_command import main; sys.exit(main())"

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
    requirements: Iterable[tuple[str, str]],
    found: Found | None = None,
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
        if needed.name in OWN or (
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
    folder: Path,
    extras: Iterable[str] = (),
    research: Iterable[str] | None = None,
) -> Path:
    """Make an environment in which this clone is installed, with its command; returns its Python.

    Args:
        folder: to be made.
        extras: of nextview.
        research: extras of the package research; None if that is not installed.

    Raises:
        PackageNotFoundError: something that is asked for is not installed in the environment of the
            tests.
    """
    python, packages = empty_environment(folder)
    paths = [ROOT / "src"]
    requirements = _requirements(ROOT / "pyproject.toml", extras)
    if research is not None:
        paths.append(ROOT)  # of which research is a package
        requirements += _requirements(ROOT / "research/pyproject.toml", research)

    for installed in asked_for(requirements).values():
        link(installed, packages)
    for name in OWN[: len(paths)]:
        about = f"{name.replace('-', '_')}-{distribution(name).version}.dist-info"
        (packages / about).symlink_to(distribution(name).locate_file(about))
    (packages / "this_clone.pth").write_text(
        "".join(f"{path}\n" for path in paths),
        encoding="utf-8",
    )

    command = python.parent / "nextview"
    command.write_text(f"#!{python}\n{COMMAND}\n", encoding="utf-8")
    command.chmod(0o755)
    return python


def _requirements(project: Path, extras: Iterable[str]) -> list[tuple[str, str]]:
    """What a project asks for, and for some of its extras, those of nextview itself included."""
    table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    asked = [Requirement(text) for text in table["dependencies"]]
    for extra in extras:
        asked += map(Requirement, table["optional-dependencies"][extra])
    own = {
        extra
        for needed in asked
        if needed.name == "nextview"
        for extra in needed.extras
    }
    return [(str(needed), "") for needed in asked] + (
        _requirements(ROOT / "pyproject.toml", own) if own else []
    )
