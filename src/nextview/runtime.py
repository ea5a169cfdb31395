"""ONNX Runtime: opens, checks and runs the files of networks.

It is imported without its telemetry: import ``ort`` from here, never the package itself.

Since version 1.29 the import alone writes a device number and a queue of events into the home
folder, and a process that lives long enough sends them to the maker. The variable must be set
before the import. Who wants the telemetry sets ``ORT_DISABLE_TELEMETRY=0``: what is set is kept.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.checks import one_line
from nextview.cores import cores
from nextview.errors import DAMAGED, ModelError
from nextview.files import checked_bytes

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as _state

_found = vars(_state).values()
RUNTIME_FAILURES: tuple[type[Exception], ...] = tuple(
    kind for kind in _found if isinstance(kind, type) and issubclass(kind, Exception)
)
"""The runtime has a class of exception for every reason, without a common one."""

LONGEST_MESSAGE = 300  # letters of what the runtime says
# of a network that is no usable one
RUNTIME_ERRORS: tuple[type[Exception], ...] = (*DAMAGED, *RUNTIME_FAILURES)
InputShape = tuple[int | None, ...]  # without the batch; None for a size that is free


class OnnxFile(ort.InferenceSession):
    """A network that ``open_onnx`` opened; pickled as its file, which is opened again.

    It never changes.
    """

    def __init__(
        self,
        content: bytes,
        options: ort.SessionOptions,
        opened: tuple[Path, str, int],
    ) -> None:
        super().__init__(content, options, providers=["CPUExecutionProvider"])
        self._opened = opened

    def __reduce__(self) -> tuple[Any, tuple[Path, str, int]]:
        return open_onnx, self._opened

    def __deepcopy__(self, memo: dict[int, Any]) -> "OnnxFile":
        return self


def open_onnx(path: Path, sha256: str, threads: int = 0) -> OnnxFile:
    """Check the hash of an ONNX file and open it.

    The file holds all of its weights: other files that it refers to are not read.

    Args:
        path: of the file.
        sha256: that its content must have.
        threads: of ONNX Runtime; 0 for one on each core.

    Returns:
        The open network.

    Raises:
        ModelError: the file is missing, has another hash, or is not a network.
    """
    content = checked_bytes(path, sha256)
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads or cores()
    options.log_severity_level = 3
    # Threads that wait for more work of one network would take the cores from the next: a third of
    # the time of a view.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # The hash is of this file alone: weights that it refers to in others, of the working folder
    # say, are not found.
    options.add_session_config_entry(
        "session.model_external_initializers_file_folder_path",
        str(path),
    )
    try:
        return OnnxFile(content, options, (Path(path).absolute(), sha256, threads))
    except RUNTIME_ERRORS as error:
        raise ModelError(
            f"{path}: not a usable ONNX model ({one_line(str(error), LONGEST_MESSAGE)})"
        ) from None


def run_onnx(
    path: Path,
    session: ort.InferenceSession,
    names: Sequence[str],
    inputs: NDArray,
) -> list[NDArray]:
    """Run a network that has one input.

    Args:
        path: of its file, for messages.
        session: the open network.
        names: of the outputs.
        inputs: batch of inputs, (B, ...).

    Returns:
        The named outputs, (B, ...) each.

    Raises:
        ModelError: the network fails, or its outputs are not B rows of finite numbers.
    """
    try:
        answers = session.run(list(names), {session.get_inputs()[0].name: inputs})
    except RUNTIME_ERRORS as error:
        raise ModelError(
            f"{path}: fails when it is run ({one_line(str(error), LONGEST_MESSAGE)})"
        ) from None

    declared = {end.name: end.shape for end in session.get_outputs()}
    for name, values in zip(names, answers, strict=True):
        wanted = (len(inputs), *declared[name][1:])
        fits = zip(wanted, values.shape, strict=False)
        if values.ndim != len(wanted) or any(
            isinstance(w, int) and w != there for w, there in fits
        ):
            raise ModelError(
                f"{path}: gives {name} of the shape {values.shape} for {len(inputs)} inputs"
            )
        if not np.isfinite(values).all():
            raise ModelError(f"{path}: gives {name} that are not finite numbers")

    return answers


def check_end(path: Path, end: ort.NodeArg, kind: str, shape: InputShape) -> None:
    """Check the type and the shape of an input or output of a network.

    Args:
        path: of the network's file, for messages.
        end: the input or output.
        kind: type that it must have, such as "tensor(float)".
        shape: that it must have after a free batch dimension; None is any size.

    Raises:
        ModelError: it has another type or shape.
    """
    there = end.shape[1:]
    fits = len(end.shape) == len(shape) + 1 and all(
        w in (None, f) for w, f in zip(shape, there, strict=True)
    )
    if not fits or end.type != kind or isinstance(end.shape[0], int):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        sizes = ", ".join(map(str, end.shape))
        raise ModelError(
            f"{path}: has {end.name} ({sizes}) {end.type}, not (batch, {wanted}) {kind} as its card"
            " says"
        )
