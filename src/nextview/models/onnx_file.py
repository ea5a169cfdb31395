"""Open an ONNX file of which a card holds the hash."""

from __future__ import annotations

import hashlib
from pathlib import Path

import onnxruntime as ort

from nextview.errors import ModelError


def open_onnx(path: Path, sha256: str, threads: int = 0) -> ort.InferenceSession:
    """Check the hash of an ONNX file and hand it to ONNX Runtime.

    Args:
        path: the file.
        sha256: what its hash has to be, in hexadecimal.
        threads: of ONNX Runtime, 0 for one on each core.

    Raises:
        ModelError: the file is missing, is not the one that the card describes, or ONNX Runtime refuses it.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: the weights are missing or cannot be read ({error.strerror})") from None
    if hashlib.sha256(content).hexdigest() != sha256:
        raise ModelError(f"{path}: is not the file that its card describes (the SHA-256 differs)")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    try:
        return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime has a class of exception for every reason
        raise ModelError(f"{path}: not a usable ONNX model ({str(error).splitlines()[0]})") from None
