"""Open an ONNX file of which a card holds the hash."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from nextview.arguments import in_one_line
from nextview.errors import ModelError
from nextview.weights_file import checked_content

LONGEST = 300
"""Letters of what the runtime says: it names places in its own source too."""
Shape = tuple[int | None, ...]
"""Without the batch; None for a size that is free."""


def open_onnx(path: Path, sha256: str, threads: int = 0) -> ort.InferenceSession:
    """Check the hash of an ONNX file, which holds all its weights, and hand it to ONNX Runtime.

    Args:
        path: the file.
        sha256: what its hash has to be, in hexadecimal.
        threads: of ONNX Runtime, 0 for one on each core.

    Raises:
        ModelError: the file is missing, is not the one that the card describes, or ONNX Runtime refuses it.
    """
    content = checked_content(path, sha256)
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Threads that wait for more work of one network would take the cores from the next: a third of the time of a view.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # The hash is of this file alone: weights that it refers to in others, of the working folder say, are not found.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(path))
    try:
        return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime has a class of exception for every reason
        raise ModelError(f"{path}: not a usable ONNX model ({in_one_line(str(error), LONGEST)})") from None


def run_onnx(
    path: Path, session: ort.InferenceSession, names: Sequence[str], inputs: NDArray[Any]
) -> list[NDArray[Any]]:
    """What a network with one input answers.

    Args:
        path: of its file.
        session: the network.
        names: of the outputs.
        inputs: (B, ...).

    Raises:
        ModelError: it fails, or answers with anything but B rows of finite numbers, in the shape that it declares.
    """
    try:
        answers = session.run(list(names), {session.get_inputs()[0].name: inputs})
    except Exception as error:  # as above
        raise ModelError(f"{path}: fails when it is run ({in_one_line(str(error), LONGEST)})") from None
    declared = {end.name: end.shape for end in session.get_outputs()}
    for name, values in zip(names, answers, strict=True):
        wanted = (len(inputs), *declared[name][1:])
        fits = zip(wanted, values.shape, strict=False)
        if values.ndim != len(wanted) or any(isinstance(w, int) and w != there for w, there in fits):
            raise ModelError(f"{path}: gives {name} of the shape {values.shape} for {len(inputs)} inputs")
        if not np.isfinite(values).all():
            raise ModelError(f"{path}: gives {name} that are not finite numbers")
    return answers


def check_input(path: Path, session: ort.InferenceSession, name: str | None, kind: str, shape: Shape) -> None:
    """Refuse a network that takes anything but one input of a name, see ``check_end``; any name where none is given."""
    ends = session.get_inputs()
    if len(ends) != 1 or name not in (None, ends[0].name):
        wants = ", ".join(end.name for end in ends) or "nothing"
        raise ModelError(f"{path}: takes {wants}, not one input{f' called {name}' if name else ''}")
    check_end(path, ends[0], kind, shape)


def check_end(path: Path, end: ort.NodeArg, kind: str, shape: Shape) -> None:
    """Refuse a network of which an input or output is not of this type and shape, after a batch dimension that is free.

    Args:
        path: of the network.
        end: the input or output.
        kind: of its numbers, as ONNX Runtime writes it: "tensor(float)".
        shape: without the batch; None for a size that is free.

    Raises:
        ModelError: it is another.
    """
    found = end.shape[1:]
    fits = len(end.shape) == len(shape) + 1 and all(w in (None, f) for w, f in zip(shape, found, strict=True))
    if not fits or end.type != kind or isinstance(end.shape[0], int):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        there = ", ".join(map(str, end.shape))
        raise ModelError(f"{path}: has {end.name} ({there}) {end.type}, not (batch, {wanted}) {kind} as its card says")
