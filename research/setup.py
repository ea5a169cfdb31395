"""Builds in a temporary folder, so that ``pip install ./research`` leaves nothing in this one."""

import atexit
import shutil
import tempfile
from typing import Any

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildModules(build_py):
    """All modules of the folder but this one."""

    def find_package_modules(self, package: str, package_dir: str) -> list[Any]:
        """Tuples of package, module and file."""
        return [
            found
            for found in super().find_package_modules(package, package_dir)
            if found[1] != "setup"
        ]


built = tempfile.mkdtemp(prefix="nextview-research-")
atexit.register(shutil.rmtree, built, ignore_errors=True)
setup(
    cmdclass={"build_py": BuildModules},
    options={"build": {"build_base": built}, "egg_info": {"egg_base": built}},
)
