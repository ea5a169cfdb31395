"""Workers on this machine: what a script has to look like that uses them."""

import subprocess
import sys

import pytest

LINES = """
import math
print("script runs", flush=True)
from nextview.data.pool import each
print(sorted(result for _, result in each(math.sqrt, [1, 4, 9], 2)), flush=True)
"""


OWN_CODE = """
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from nextview.data.pool import each

def double(x, times=2):
    return times * x

@dataclass(frozen=True)
class Mine:
    value: int

if __name__ == "__main__":
    print(sorted(result for _, result in each({function}, {items}, 2)))
"""


@pytest.mark.parametrize("way", ["a file", "standard input"])
def test_a_plain_script_without_a_guard_may_use_workers(tmp_path, way):
    (tmp_path / "script.py").write_text(LINES)
    call = {"a file": ["script.py"], "standard input": ["-"]}[way]
    done = subprocess.run(
        [sys.executable, *call],
        input=LINES,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    assert done.stdout == "script runs\n[1.0, 2.0, 3.0]\n"


def test_what_a_guarded_script_defines_reaches_the_workers(tmp_path):
    items = "[Mine(2), Mine(8), Mine(18)]"
    code = OWN_CODE.format(function="attrgetter('value')", items=items)
    (tmp_path / "script.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.stderr, done.stdout) == ("", "[2, 8, 18]\n")
