"""How a command ends: in one sentence, whether at an error, at a signal, or where its output goes nowhere."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TextIO

from nextview.cli.columns import sensible_columns

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF)


class Terminated(KeyboardInterrupt):
    """SIGTERM: ends a command as Ctrl-C does, with another status."""


def printable(text: str) -> str:
    r"""The same text with what cannot be printed as escapes, but for the ends of lines.

    >>> print(printable("a\x1b[31mb"))
    a\x1b[31mb
    """
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def say(sentence: str) -> None:
    """A sentence on standard error, where that can be written."""
    try:
        print(f"nextview: {printable(sentence)}", file=sys.stderr, flush=True)
    except OSError:  # Python would try again at its end, fail again, and end with status 120 instead of ours
        _forget(sys.stderr)


@contextmanager
def orderly_end(advice: str) -> Iterator[None]:
    """Let a command end in one sentence.

    A ``NextviewError``, and an OSError that names its file, end with status 2; an output that cannot be written with 1;
    Ctrl-C with 130 and SIGTERM with 143, as shells do. Anything else is a bug and keeps its traceback.

    Args:
        advice: after a signal, what to do to go on.
    """
    from nextview.cli.extra import missing_extra
    from nextview.errors import NextviewError

    _open_what_is_closed()
    with sensible_columns(), _sigterm():
        try:
            try:
                yield
            finally:
                sys.stdout.flush()  # here and not at the interpreter's end, also after --help, which exits by itself
        except (NextviewError, ModuleNotFoundError) as error:
            sentence = missing_extra(error) if isinstance(error, ModuleNotFoundError) else error
            if sentence is None:
                raise
            say(str(sentence))
            sys.exit(2)
        except BrokenPipeError:  # whoever read this has gone, as head does
            _forget(sys.stdout)
            sys.exit(1)
        except OSError as error:
            if error.filename is not None:
                say(f"{error.filename}: {error.strerror}")
                sys.exit(2)
            if error.errno not in FULL and sys.stdout.writable():
                raise
            say(f"standard output or a file cannot be written ({error.strerror or 'it is closed'})")
            _forget(sys.stdout)
            sys.exit(1)
        except (KeyboardInterrupt, SystemExit) as ended:  # Lightning makes one of the other
            interrupt = ended.__context__ if isinstance(ended, SystemExit) else ended
            if not isinstance(interrupt, KeyboardInterrupt):
                raise
            warnings.simplefilter("ignore")  # the reads that zarr has begun would complain, at length, of being left
            logging.getLogger("asyncio").disabled = True
            sys.unraisablehook = lambda unraisable: None
            say(f"stopped; {advice}")
            sys.exit(143 if isinstance(interrupt, Terminated) else 130)


def _forget(stream: TextIO) -> None:
    """Let what a standard file still holds, and all that comes, go nowhere."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _open_what_is_closed() -> None:
    """Keep the places of closed standard files, or the next file opened would get them and what is printed too."""
    for name, mode in (("stdin", "r"), ("stdout", "r"), ("stderr", "w")):  # writing to the second fails, as it should
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115


@contextmanager
def _sigterm() -> Iterator[None]:
    """Let SIGTERM raise ``Terminated``."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Terminated

    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:  # whoever started us wants it ignored
        yield
        return
    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
