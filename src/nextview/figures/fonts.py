"""Find installed fonts that contain the characters of a figure's texts."""

import logging
from collections.abc import Iterable
from functools import cache

from matplotlib.font_manager import FontEntry, findfont, fontManager
from matplotlib.ft2font import FT2Font
from matplotlib.text import Text

log = logging.getLogger(__name__)
NO_SCRIPT = ("Last Resort", "STIX", "cm")  # placeholder fonts and formula fonts
INSTALL = (
    "fonts-noto on Debian and Ubuntu, fonts-noto-cjk for "
    "Chinese, Japanese and Korean, has them"
)


def fit_fonts(texts: Iterable[Text]) -> None:
    """Add the fonts that the characters of each text need.

    A character without an installed font is written as its code, and a line in the log says which
    font to install.
    """
    lacking: set[str] = set()
    for text in texts:
        missing = _missing(text.get_text(), findfont(text.get_fontproperties()))
        if not missing:
            continue
        families, without = _fonts_for(frozenset(missing))
        text.set_fontfamily([*text.get_fontfamily(), *families])
        text.set_text("".join(_code(c) if c in without else c for c in text.get_text()))
        lacking |= without
    if lacking:
        log.warning(
            "no font of this machine has %s, drawn as codes: %s",
            "".join(sorted(lacking)),
            INSTALL,
        )


def _missing(written: str, path: str) -> set[str]:
    """Return the characters that a font lacks, except line breaks."""
    has = _characters(path)
    return {c for c in written if ord(c) not in has and c != "\n"}


@cache
def _characters(path: str) -> frozenset[int]:
    """Return the codes of all characters in a font file; none if it cannot be read."""
    try:
        return frozenset(FT2Font(path).get_charmap())
    except (OSError, RuntimeError) as error:  # FreeType raises these for damaged files
        log.debug("%s: not a usable font (%s)", path, error)
        return frozenset()


@cache
def _fonts_for(missing: frozenset[str]) -> tuple[tuple[str, ...], frozenset[str]]:
    """Choose as few font families as possible for these characters.

    Also returns the characters that no font has.
    """
    families: list[str] = []
    without = set(missing)
    fonts = [
        font for font in fontManager.ttflist if not font.name.startswith(NO_SCRIPT)
    ]
    fonts.sort(key=_plainness)
    while without:
        # of equally good fonts, the plainest
        best = max(fonts, key=lambda font: len(_held(font, without)), default=None)
        held = set() if best is None else _held(best, without)
        if best is None or not held:
            break
        families.append(best.name)
        without -= held
    return tuple(families), frozenset(without)


def _held(font: FontEntry, characters: Iterable[str]) -> set[str]:
    has = _characters(font.fname)
    return {c for c in characters if ord(c) in has}


def _plainness(font: FontEntry) -> tuple[bool, bool, str]:
    """Sort key: upright fonts of normal weight first, then by name for reproducibility."""
    weighs = font.weight not in (400, "normal", "regular", "book")
    return font.style != "normal", weighs, font.name


def _code(character: str) -> str:
    return character.encode("unicode_escape").decode()
