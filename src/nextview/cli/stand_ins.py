"""Import modules whose packages are missing with stand-ins, for the help of a command.

A command's help is made from the parameters of its function, and the module of that function
imports torch or pandas. As Sphinx does for its pages (``autodoc_mock_imports``), what is missing is
replaced by objects that can be called, subclassed and annotated with. The process ends once the
help is shown: nothing is ever run with them.
"""

import sys
from abc import ABCMeta
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from nextview.checks import EXTRAS


class _StandIn(ABCMeta):
    """The kind of all classes that stand for what a package would hold.

    They are classes, because other libraries ask for subclasses of ``torch.Tensor`` once torch
    seems to be there.
    """

    def __getattr__(cls, name: str) -> type:
        return _stand_in(name)

    def __call__(cls, *arguments: Any, **options: Any) -> Any:
        return cls

    def __getitem__(cls, key: Any) -> Any:
        return cls

    def __or__(cls, other: Any) -> Any:
        return cls

    __ror__ = __or__


def _stand_in(name: str) -> type:
    if name.startswith("__"):  # Python asks for many of these, and goes on without
        raise AttributeError(name)
    return _StandIn(name, (), {})


class _Finder(MetaPathFinder, Loader):
    """Finds missing packages; it comes last, so that installed ones are used."""

    def __init__(self, missing: Iterable[str]) -> None:
        self.missing = frozenset(missing)

    def find_spec(
        self,
        fullname: str,
        path: Any,
        target: Any = None,
    ) -> ModuleSpec | None:
        """Return a spec for a missing package and everything below it.

        Args:
            fullname: of the module.
            path: see ``importlib.abc.MetaPathFinder``.
            target: see ``importlib.abc.MetaPathFinder``.

        Returns:
            The spec; None for packages that are installed.
        """
        package = fullname.partition(".")[0]
        return (
            ModuleSpec(fullname, self, is_package=True)
            if package in self.missing
            else None
        )

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """A module from which anything can be taken."""
        module = ModuleType(spec.name)
        module.__getattr__ = _stand_in  # type: ignore[method-assign]
        return module

    def exec_module(self, module: ModuleType) -> None:
        """There is nothing in it."""


@contextmanager
def stand_ins() -> Iterator[None]:
    """Import with stand-ins for missing extras; only for a process that ends afterwards."""
    named = {package for packages in EXTRAS.values() for package in packages}
    finder = import_stand_ins(
        package for package in named if find_spec(package) is None
    )
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


def import_stand_ins(missing: Iterable[str]) -> MetaPathFinder:
    """Install stand-ins for missing packages; only for a process that prints its help."""
    finder = _Finder(missing)
    sys.meta_path.append(finder)
    return finder
