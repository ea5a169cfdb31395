"""The content of a file of weights, if it is the one of which a card holds the hash."""

from __future__ import annotations

import hashlib
from pathlib import Path

from nextview.arguments import regular_file, takes_paths
from nextview.errors import ModelError


@takes_paths("path")
def checked_content(path: Path, sha256: str, what: str = "the weights are") -> bytes:
    """What is in a file.

    Args:
        path: the file.
        sha256: what its hash has to be, in hexadecimal.
        what: it holds, for the sentence that says that it is missing.

    Raises:
        ModelError: the file is missing, or is not the one that the card describes.
    """
    regular_file(path, "weights", ModelError)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: {what} missing or cannot be read ({error.strerror})") from None
    if hashlib.sha256(content).hexdigest() != sha256:
        raise ModelError(f"{path}: is not the file that its card describes (the SHA-256 differs)")
    return content
