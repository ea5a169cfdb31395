"""Replace missing packages with stand-ins, so that a command can still print its help.

The help of a command is generated from the parameters of its function, whose module may import
torch or pandas. Like ``autodoc_mock_imports`` of Sphinx, this module replaces missing packages by
objects that can be called, subclassed and used as annotations. The process ends after printing
the help; no other code runs with stand-ins.
"""

import sys
from abc import ABCMeta
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any


class _StandIn(ABCMeta):
    """Metaclass of the stand-ins for the contents of a package.

    Stand-ins are classes because other libraries test for subclasses of ``torch.Tensor`` once
    torch appears to be imported.
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
    if name.startswith("__"):  # Python looks up many of these and does not need them
        raise AttributeError(name)
    return _StandIn(name, (), {})


class _Finder(MetaPathFinder, Loader):
    """Finder of missing packages; it comes last, so that installed packages are preferred."""

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
        """Create a module that has every attribute."""
        module = ModuleType(spec.name)
        module.__getattr__ = _stand_in  # type: ignore[method-assign]
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: the module is empty."""


@contextmanager
def stand_ins(
    extras: Mapping[str, tuple[str, ...]],
) -> Iterator[None]:
    """Import stand-ins for missing extras; only for a process that ends afterwards.

    Args:
        extras: packages by the optional part of the installation that brings them.
    """
    named = {package for packages in extras.values() for package in packages}
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
