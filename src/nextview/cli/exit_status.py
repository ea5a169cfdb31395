"""How a command ends: a user's error in one sentence, a bug with its traceback."""

import io
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from nextview.checks import EXTRAS, missing_extra, needs_package
from nextview.errors import NextviewError


def printable(text: str) -> str:
    r"""The text with escapes for what cannot be printed, except for ends of lines.

    >>> print(printable("a\x1b[31mb"))
    a\x1b[31mb
    """
    return "".join(
        c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text
    )


@contextmanager
def orderly_end(after_ctrl_c: str) -> Iterator[None]:
    """End with status 2 after an error of the user's or a missing extra, with 130 after Ctrl-C."""
    _print_anything()
    try:
        yield
        sys.stdout.flush()
    except (NextviewError, ModuleNotFoundError) as error:
        sentence = str(error) if isinstance(error, NextviewError) else missing_extra(error)
        if sentence is None:
            raise
        _end(sentence, 2)
    except BrokenPipeError:  # who read the output has gone, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(1)
    except OSError as error:
        if error.filename is None:
            raise
        _end(f"{error.filename}: {error.strerror}", 2)
    except (KeyboardInterrupt, SystemExit) as ended:
        if not isinstance(
            ended.__context__ if isinstance(ended, SystemExit) else ended, KeyboardInterrupt
        ):
            raise  # an exit; Lightning makes one of a KeyboardInterrupt
        warnings.simplefilter("ignore")
        # reads that zarr has begun complain of being left
        sys.unraisablehook = lambda unraisable: None
        _end(f"stopped; {after_ctrl_c}", 130)


def _print_anything() -> None:
    """Print characters that the encoding of an output lacks as codes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _end(sentence: str, status: int) -> Any:
    print(f"nextview: {printable(sentence)}", file=sys.stderr)
    sys.exit(status)


def require(
    extra: str, packages: Mapping[str, tuple[str, ...]] = EXTRAS, project: str = "nextview"
) -> None:
    """End a script, before its imports fail, with the sentence that says what to install.

    With --help it goes on: stand-ins are imported for what is missing, and its help is shown.

    Args:
        extra: the optional part of the installation that the script needs.
        packages: those of each optional part.
        project: whose parts they are, as pip is told.
    """
    missing = [package for package in packages[extra] if find_spec(package) is None]
    if not missing:
        return

    print(f"{sys.argv[0]} {needs_package(missing[0], extra, project)}", file=sys.stderr)
    if not {"-h", "--help"} & set(sys.argv[1:]):
        sys.exit(2)
    from nextview.cli.stand_ins import import_stand_ins

    import_stand_ins(missing)
