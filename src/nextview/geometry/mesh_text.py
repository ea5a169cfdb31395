"""What the text formats of meshes have in common: encodings, lines, words and numbers."""

import codecs
import io
import warnings
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nextview.errors import MeshError
from nextview.types import Float, Index

ENCODING_MARKS = (  # that editors put before a text, the longer first: UTF-32's begins as UTF-16's
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


def encoding_of(data: bytes) -> tuple[str, int]:
    """The encoding that a file announces by its first bytes.

    Args:
        data: the file's bytes.

    Returns:
        The name of the encoding, and how many bytes the mark before the text has. Without a mark
        UTF-16 is told by the zero beside each of the first two letters; everything else is "utf-8",
        of which only ASCII is ever looked at, so that Latin-1 and its kin are read too.
    """
    for mark, name in ENCODING_MARKS:
        if data.startswith(mark):
            return name, len(mark)
    first = data[:4]
    if len(first) == 4 and first[1] == first[3] == 0 and first[0] and first[2]:
        return "utf-16-le", 0
    if len(first) == 4 and first[0] == first[2] == 0 and first[1] and first[3]:
        return "utf-16-be", 0
    return "utf-8", 0


def plain_text(data: bytes) -> bytes:
    r"""Decode a text file and end every line with a line feed.

    Args:
        data: the file's bytes, in UTF-8, UTF-16, UTF-32 or any eight-bit encoding.

    Returns:
        The text. Carriage returns become line ends, too.

    Raises:
        MeshError: the file is not in the encoding that its first bytes announce.
    """
    encoding, mark = encoding_of(data)
    if encoding != "utf-8":
        try:
            data = data[mark:].decode(encoding).encode()
        except UnicodeDecodeError:
            raise MeshError(
                f"it begins as {encoding.upper()} text, but is none"
            ) from None
    elif mark:
        data = data[mark:]
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data


def lines_of_words(text: bytes) -> Iterator[list[bytes]]:
    """Yield the words of each line that has any, without comments (#).

    It goes line by line to save memory.
    """
    for line in io.BytesIO(text):
        words = line.partition(b"#")[0].split()
        if words:
            yield words


def numbers(text: bytes) -> Float:
    """All the numbers of a text that is made of numbers and white space.

    Raises:
        ValueError: there is something else in it.
    """
    return _parsed(text, np.float64)


def whole_numbers(text: bytes) -> Index:
    """As ``numbers``, of a text of whole numbers."""
    return _parsed(text, np.int64)


def _parsed(text: bytes, kind: type) -> NDArray:
    with warnings.catch_warnings(action="error", category=DeprecationWarning):
        try:
            return np.fromstring(text, kind, sep=" ")
        except (
            DeprecationWarning,
            ValueError,
        ):  # which of them depends on NumPy's version
            raise ValueError(
                "something other than numbers stands where numbers are expected"
            ) from None
