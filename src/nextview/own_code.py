"""Code of a user's own, imported by name: whatever it raises becomes one sentence that says where it was raised."""

from __future__ import annotations

import importlib
import os
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nextview.arguments import in_one_line
from nextview.errors import NextviewError

WHOLE = "NEXTVIEW_TRACEBACK"
"""Set in the environment, it has the whole traceback of what users' code raises shown too."""
LONGEST = 300
"""Letters of a message; a sentence is not the place for an array."""
_OTHERS = (f"{Path(__file__).parent}{os.sep}", "<frozen ", *(sysconfig.get_path(of) for of in ("stdlib", "purelib")))
"""How the files begin that are no user's own."""


@contextmanager
def own_code(error: Callable[[str], NextviewError]) -> Iterator[None]:
    """Run code of a user's own.

    What it raises is the cause of the error that is raised instead: there its traceback is. A Ctrl-C passes, for it may
    come at any moment. An exit does not: no part of a run may end it as if it were done.

    Args:
        error: makes the error of what is said of the exception, see ``said_of``.

    Raises:
        NextviewError: what ``error`` makes.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as raised:
        if os.environ.get(WHOLE):
            traceback.print_exception(raised)
        raise error(said_of(raised)) from raised


def said_of(raised: BaseException) -> str:
    """The kind of an exception, its message in one line, and the last line of the user's own that it came through."""
    try:
        message = in_one_line(str(raised), LONGEST)
    except Exception:  # its __str__ is the user's own, too
        message = ""
    said = f"{type(raised).__name__}: {message}" if message else type(raised).__name__
    frames = [f for f in traceback.extract_tb(raised.__traceback__) if not f.filename.startswith(_OTHERS)]
    return f"{said}, at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else said


def fails(call: Callable[[], object]) -> bool:
    """Whether a call of a user's own code raises anything."""
    try:
        call()
    except KeyboardInterrupt:
        raise
    except BaseException:
        return True
    return False


def import_own(path: str) -> Any:
    """What MODULE:NAME means, seen from the working folder; raises whatever importing it raises."""
    module, _, name = path.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    return getattr(importlib.import_module(module), name)
