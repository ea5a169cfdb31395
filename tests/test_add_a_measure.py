import doctest
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "add_a_measure.md"


def test_the_page_does_what_it_says():
    failed, tried = doctest.testfile(str(PAGE), module_relative=False)
    assert tried > 15
    assert failed == 0
