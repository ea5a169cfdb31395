"""End a command: user errors print one sentence, bugs keep their traceback."""

import errno
import io
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import NoReturn, TextIO

from nextview.checks import EXTRAS, missing_extra, needs_packages
from nextview.errors import NextviewError
from nextview.errors import printable as on_one_line


def printable(text: str) -> str:
    r"""Escape unprintable characters, except line breaks.

    >>> print(printable("a\x1b[31mb"))
    a\x1b[31mb
    """
    return "\n".join(map(on_one_line, text.split("\n")))


@contextmanager
def orderly_end(after_stop: str, program: str = "nextview") -> Iterator[None]:
    """Turn the exceptions of a command into one sentence and an exit status.

    The status is 1 if the output cannot be written, 2 after a user error or if an extra is
    missing, and 130 after Ctrl-C or SIGTERM. A bug keeps its traceback.

    Args:
        after_stop: advice that is printed after Ctrl-C.
        program: its name begins each sentence.
    """
    _prepare_outputs()
    try:
        yield
        sys.stdout.flush()
    except (NextviewError, ModuleNotFoundError) as error:
        sentence = (
            str(error) if isinstance(error, NextviewError) else missing_extra(error)
        )
        if sentence is None:
            raise
        _end(program, sentence, 2)
    except BrokenPipeError:  # the reader, such as head, has closed the pipe
        _discard(sys.stdout)
        sys.exit(1)
    except OSError as error:
        if error.filename is not None:
            _end(program, f"{error.filename}: {error.strerror}", 2)
        if error.errno != errno.ENOSPC:
            raise
        _discard(sys.stdout)
        _end(program, f"standard output cannot be written ({error.strerror})", 1)
    except (KeyboardInterrupt, SystemExit) as ended:
        stop = ended.__context__ if isinstance(ended, SystemExit) else ended
        if not isinstance(stop, KeyboardInterrupt):
            raise  # an ordinary exit; Lightning turns a KeyboardInterrupt into one
        warnings.simplefilter("ignore")
        # unfinished reads of zarr would print errors
        sys.unraisablehook = lambda unraisable: None
        _end(program, f"stopped; {after_stop}", 130)


def _prepare_outputs() -> None:
    """Escape characters that the encoding lacks, and redirect closed streams to the null device."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115  # open until the process ends
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _end(program: str, sentence: str, status: int) -> NoReturn:
    try:
        print(f"{program}: {printable(sentence)}", file=sys.stderr)
    except OSError:  # standard error is full; the exit status still reports the error
        _discard(sys.stderr)
    sys.exit(status)


def _discard(stream: TextIO) -> None:
    """Discard all further output of a stream, including the flush when the process ends."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def require(
    extra: str,
    packages: Mapping[str, tuple[str, ...]] = EXTRAS,
    project: str = "nextview",
) -> None:
    """End a script with installation advice if an optional dependency is missing.

    Call it before the imports that would fail. With --help the script continues: stand-ins are
    imported for the missing packages, and the help is shown.

    Args:
        extra: that the script needs.
        packages: of each extra.
        project: name of the project that defines the extras, as pip knows it.
    """
    missing = [package for package in packages[extra] if find_spec(package) is None]
    if not missing:
        return

    print(sys.argv[0], needs_packages(missing, [extra], project), file=sys.stderr)
    if not {"-h", "--help"} & set(sys.argv[1:]):
        sys.exit(2)
    from nextview.cli.stand_ins import import_stand_ins

    import_stand_ins(missing)
