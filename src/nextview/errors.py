"""Everything that can be wrong with what a user handed in, asked for or has installed.

Each message is one sentence: what is wrong, in which file, what to do. The command line prints it
and ends with status 2. Any other exception is a bug of nextview and keeps its traceback.
"""

import struct
import zipfile
import zlib

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


class NextviewError(ValueError):
    """The base of all errors that nextview raises on purpose."""


class UsageError(NextviewError):
    """An argument or an option that makes no sense."""


class MissingExtraError(NextviewError, ModuleNotFoundError):
    """A package that an optional part of nextview needs is not installed."""


class MeshError(NextviewError):
    """A mesh file that cannot be used."""


class ObservationError(NextviewError):
    """What a camera gave cannot be taken for a view of an object."""


class NoViewLeftError(ObservationError):
    """A camera that cannot go everywhere has no view left to offer."""


class SessionError(NextviewError):
    """A session is asked for what it cannot do: it has ended, has not ended yet, or lacks what
    its policy needs.
    """


class ModelError(NextviewError):
    """A network, or the card of one, that cannot be used."""


class RiskError(NextviewError):
    """An error rate that cannot be promised."""


class PolicyError(NextviewError):
    """A policy that cannot be made, or that failed, in an episode that may be known."""

    def __init__(self, message: str, episode: int | None = None) -> None:
        super().__init__(message)
        self.episode = episode


class OtherUseError(PolicyError):
    """A policy that was learned for other viewpoints or classes."""


class DatasetError(NextviewError):
    """A dataset folder or a view store that cannot be used."""


class MeasureError(NextviewError):
    """A view measure that is not known, cannot be computed of these views, or failed."""


class PredictionsError(NextviewError):
    """Predictions that cannot be used."""


class EntryError(NextviewError):
    """An entry of the benchmark that cannot be run to its end."""


class ResultsError(NextviewError):
    """Results that are not there, cannot be written, or must not be replaced."""
