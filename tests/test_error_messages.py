"""The sentences on the page of error messages are those of the source."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import nextview
from nextview.errors import option, shell_words

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/error_messages.md").read_text(encoding="utf-8")
SENTENCES = re.findall(r"^\| `([^`]+)` \|", PAGE, re.M)


@cache
def texts() -> str:
    """All texts of the source and of the ROS node, a line each.

    What an f-string puts in is left out, except for options, which are named as in a shell.
    """
    found = []
    for top in ("src/nextview", "lab/src", "ros2/nextview_ros/nextview_ros"):
        for path in sorted((ROOT / top).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    found.append("".join(map(_part, node.values)))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found.append(node.value.replace("{where}", "\n"))
    return "\n".join(found)


def _part(value: ast.expr) -> str:
    if isinstance(value, ast.Constant):
        return str(value.value)
    inserted = value.value if isinstance(value, ast.FormattedValue) else None
    if not isinstance(inserted, ast.Call) or ast.unparse(inserted.func) != "option":
        return "\n"
    given = [a.value if isinstance(a, ast.Constant) else "\n" for a in inserted.args]
    with shell_words():
        return option(*given)


@pytest.mark.parametrize("sentence", SENTENCES)
def test_each_message_of_the_page_is_in_the_source(sentence):
    for part in sentence.split("…"):
        assert part.strip() in texts(), part


def test_the_page_has_messages_for_each_interface():
    doors = re.split(r"^## ", PAGE, flags=re.M)[1:]
    assert len(doors) == 7
    for door in doors:
        assert len(re.findall(r"^\| `", door, re.M)) >= 5, door.splitlines()[0]


def test_a_message_of_the_page_is_raised(tmp_path):
    with pytest.raises(nextview.NextviewError) as raised:
        nextview.load(str(tmp_path / "missing"))
    (begin,) = [text for text in SENTENCES if "neither a folder with models" in text]
    assert begin.strip("…: ") in str(raised.value)
