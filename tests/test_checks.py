"""Numbers and points at the door, and what plugins raise."""

import numpy as np
import pytest

from nextview import checks
from nextview.errors import PolicyError, UsageError


def test_numbers_within_limits():
    assert checks.whole(np.int64(3), "n", 1, 3) == 3
    assert checks.number(np.float32(0.5), "x", above=0) == 0.5
    for value in (True, 1.5, "1", None, 0, 4):
        with pytest.raises(UsageError, match="n is a whole number from 1 to 3, not"):
            checks.whole(value, "n", 1, 3)
    for value in (True, "1", None, np.nan, np.inf, 0, 2):
        with pytest.raises(UsageError, match="x is a number above 0, of at most 1, not"):
            checks.number(value, "x", above=0, most=1)


def test_points():
    assert checks.points([[1, 2, 3]], "these").shape == (1, 3)
    for value in ([1, 2, 3], [[1, 2], [1, 2, 3]], [[np.nan] * 3], "abc"):
        with pytest.raises(UsageError, match="points"):
            checks.points(value, "these")


def test_a_plugin_is_imported_from_the_working_folder_and_its_errors_say_where(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "someones.py").write_text("def fails():\n    raise KeyError('a\\nb')\n")
    with pytest.raises(PolicyError, match=r"^it raised KeyError: .*, at someones.py:2$") as raised:
        with checks.plugin_errors(lambda text: PolicyError(f"it raised {text}")):
            checks.plugin("someones:fails")()
    assert isinstance(raised.value.__cause__, KeyError)
    with pytest.raises(KeyboardInterrupt), checks.plugin_errors(PolicyError):
        raise KeyboardInterrupt
    with pytest.raises(PolicyError, match="SystemExit"), checks.plugin_errors(PolicyError):
        raise SystemExit(0)
