import doctest
import sys
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "add_a_policy.md"


def test_the_page_does_what_it_says():
    try:
        failed, tried = doctest.testfile(str(PAGE), module_relative=False)
    finally:
        sys.modules.pop("spread", None)
    assert tried > 15
    assert failed == 0
