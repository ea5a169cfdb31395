"""What studies share, and how they count: results line by line, so that a run goes on after a
kill and runs nothing again.
"""

import json
from dataclasses import dataclass

import pytest

from nextview.errors import UsageError
from nextview_lab.studies.shared import read_lines, results, scans_in


@dataclass(frozen=True)
class Terms:
    seed: int
    sizes: tuple[float, ...]


TERMS = Terms(3, (1.0, 2.0))
FIELDS = ("terms", "number")


def squares(path, numbers, ran, terms=TERMS):
    def run(asked):
        ran.append(asked[1])
        return {"square": asked[1] ** 2}

    asked = [(terms, number) for number in numbers]
    return [line["square"] for line in results(path, FIELDS, asked, run, "squares")]


def test_what_is_in_the_file_is_not_run_again(tmp_path):
    ran = []
    assert squares(tmp_path / "lines", [5, 2], ran) == [25, 4]
    assert squares(tmp_path / "lines", [2, 7, 5], ran) == [4, 49, 25]
    assert ran == [5, 2, 7]
    assert squares(tmp_path / "lines", [2], ran, Terms(4, (1.0, 2.0))) == [4]
    assert ran == [5, 2, 7, 2]
    lines = [json.loads(line) for line in (tmp_path / "lines").read_text().splitlines()]
    assert [line["number"] for line in lines] == ran
    assert lines[0]["terms"] == {"seed": 3, "sizes": [1.0, 2.0]}


@pytest.mark.parametrize("left", ['{"ter', '{"terms": {}, "number": 7}'])
def test_a_line_that_a_kill_cut_off_is_run_again(tmp_path, left):
    path = tmp_path / "lines"
    squares(path, [5, 2], [])
    whole = path.read_text()
    path.write_text(whole + left)
    assert len(read_lines(path)) == 2
    assert path.read_text() == whole
    ran = []
    assert squares(path, [5, 7], ran) == [25, 49]
    assert ran == [7]


def test_scans_are_found_by_their_names(tmp_path):
    with pytest.raises(UsageError):
        scans_in(tmp_path)
    for name in ("mug.ply", "bowl.OFF", "notes.txt"):
        (tmp_path / name).touch()
    assert list(scans_in(tmp_path)) == ["bowl", "mug"]
    assert list(scans_in(tmp_path, (".ply",))) == ["mug"]
