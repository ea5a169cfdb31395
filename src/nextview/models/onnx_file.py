"""Open an ONNX file of which a card holds the hash."""

from __future__ import annotations

from pathlib import Path

import onnxruntime as ort

from nextview.errors import ModelError
from nextview.weights_file import checked_content


def open_onnx(path: Path, sha256: str, threads: int = 0) -> ort.InferenceSession:
    """Check the hash of an ONNX file and hand it to ONNX Runtime.

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
    try:
        return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime has a class of exception for every reason
        raise ModelError(f"{path}: not a usable ONNX model ({str(error).splitlines()[0]})") from None


def check_end(path: Path, end: ort.NodeArg, kind: str, shape: tuple[int | None, ...]) -> None:
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
