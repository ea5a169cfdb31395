"""Errors that a user can cause.

Each message is one sentence: what is wrong, in which file, and what to do. The command line prints
it and exits with status 2. Any other exception is a bug and keeps its traceback.
"""

import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

# What the readers of NumPy, zarr, Pillow and others raise for a damaged file, which may lead them
# anywhere. A package that is missing, memory that runs out, and a bug in this package's own names
# are not among them.
DAMAGED = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


# an environment variable, which worker processes inherit: a command of the shell is running
IN_SHELL = "NEXTVIEW_IN_SHELL"


@contextmanager
def shell_words() -> Iterator[None]:
    """Name options in messages as they are typed in a shell; see ``option``."""
    before = os.environ.get(IN_SHELL)
    os.environ[IN_SHELL] = "1"
    try:
        yield
    finally:
        os.environ.pop(IN_SHELL)
        if before is not None:
            os.environ[IN_SHELL] = before


def option(name: str, value: str | bool | None = None) -> str:
    """Name an option for a message: --max-faces in a shell, max_faces in Python.

    >>> option("max_faces"), option("unit", "mm"), option("overwrite", True)
    ('max_faces', "unit='mm'", 'overwrite=True')
    >>> with shell_words():
    ...     option("max_faces"), option("unit", "mm"), option("overwrite", True)
    ('--max-faces', '--unit mm', '--overwrite')

    Args:
        name: of the argument in Python.
        value: that is recommended; None to name the option alone.
    """
    if IN_SHELL not in os.environ:
        return name if value is None else f"{name}={value!r}"
    typed = f"--{name.replace('_', '-')}"
    return typed if value is None or value is True else f"{typed} {value}"


def printable(text: str) -> str:
    r"""A text in which line breaks and whatever else cannot be printed are escaped.

    Names in files come from elsewhere: a terminal would obey what they hold.

    >>> print(printable("a\x1b[31m"))
    a\x1b[31m

    Args:
        text: anything.
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text
    )


class NextviewError(ValueError):
    """The base class of all errors that nextview raises on purpose.

    Attributes:
        kind: name of the mistake that a frame, or the frames of a capture, were read with, such as
            "inverse pose"; "" where the class says it all.

    Example:
        >>> issubclass(nextview.MeshError, nextview.NextviewError)
        True
    """

    def __init__(self, message: str = "", kind: str = "") -> None:
        super().__init__(printable(message))
        self.kind = kind


class UsageError(NextviewError):
    """An argument or an option is not valid.

    Example:
        >>> nextview.load(threshold=2)
        Traceback (most recent call last):
        nextview.errors.UsageError: the threshold is a probability between 0 and 1, not 2
    """


class MissingExtraError(NextviewError, ModuleNotFoundError):
    """A package that an optional part of nextview needs is not installed.

    Example:
        >>> issubclass(nextview.MissingExtraError, ModuleNotFoundError)
        True
    """


class MeshError(NextviewError):
    """A mesh file cannot be used.

    Example:
        >>> nextview.load_mesh("missing.off")
        Traceback (most recent call last):
        nextview.errors.MeshError: missing.off: no such file
    """


class ObservationError(NextviewError):
    """The output of a camera is not a valid view of an object.

    Example:
        >>> nextview.load().session().update("a picture")
        Traceback (most recent call last):
        nextview.errors.ObservationError: ...
    """


class NoViewLeftError(ObservationError):
    """A camera with a limited set of views has no view left.

    Example:
        >>> issubclass(nextview.NoViewLeftError, nextview.ObservationError)
        True
    """


class SessionError(NextviewError):
    """A session cannot do what it was asked to do.

    It has ended, it has not ended yet, or its models lack what its policy needs.

    Example:
        >>> session = nextview.load(max_views=1).session()
        >>> camera = nextview.SimulatedCamera(sample_mesh("chair"))
        >>> view = session.update(camera.observe(session.pose))
        >>> session.failed()
        Traceback (most recent call last):
        nextview.errors.SessionError: this session has ended; begin another one
    """


class ModelError(NextviewError):
    """A network or its card cannot be used.

    Example:
        >>> nextview.load("missing")
        Traceback (most recent call last):
        nextview.errors.ModelError: missing: is neither a folder with models nor ...
    """


class RiskError(NextviewError):
    """An error rate cannot be guaranteed.

    Example:
        >>> nextview.load(risk=1e-9)
        Traceback (most recent call last):
        nextview.errors.RiskError: this recogniser cannot promise an error rate of 1e-09...
    """


class PolicyError(NextviewError):
    """A policy cannot be created, or failed.

    Attributes:
        episode: number of the episode in which it failed; None if it is not known.

    Example:
        >>> nextview.load(policy="missing")
        Traceback (most recent call last):
        nextview.errors.PolicyError: no policy is called 'missing'; there are random, ...
    """

    def __init__(self, message: str, episode: int | None = None) -> None:
        super().__init__(message)
        self.episode = episode


class OtherUseError(PolicyError):
    """A policy was learned for other viewpoints or classes.

    Example:
        >>> nextview.load("ycb", policy="gain")
        Traceback (most recent call last):
        nextview.errors.OtherUseError: ...gain.json: was learned for other classes ...
    """


class DatasetError(NextviewError):
    """A dataset folder or a view store cannot be used.

    Example:
        >>> nextview.learn("missing", "out")
        Traceback (most recent call last):
        nextview.errors.DatasetError: missing: ...
    """


class ResultsError(NextviewError):
    """Results are missing, cannot be written, or must not be replaced.

    Example:
        >>> with nextview.files.new_file(Path(".")) as part:
        ...     pass
        Traceback (most recent call last):
        nextview.errors.ResultsError: .: is a folder; give another name
    """
