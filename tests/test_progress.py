"""What a long job shows of itself."""

import io
import time

import pytest
from rich.console import Console

from nextview.cli import progress


def shown(monkeypatch, columns: int, counts, total: int, what: str, **more) -> str:
    """The last state of the threshold, on a terminal so wide."""
    file = io.StringIO()
    monkeypatch.setattr(progress, "console", Console(file=file, width=columns))
    progress.track(counts, total, what, **more)
    return file.getvalue().splitlines()[-1]


def slowly(counts):
    for n in counts:
        time.sleep(0.005)
        yield n


@pytest.mark.parametrize("what", ["rendering q.zarr", "corresponding a_store_with_a_long_name.zarr"])
def test_speed_is_not_cut_at_80_columns(monkeypatch, what):
    counts = slowly(range(12301, 12312))
    line = shown(monkeypatch, 80, counts, 12311, what, before=12300, views=40)
    assert what[:19] in line
    assert " 12311/12311 " in line
    assert line.rstrip().endswith(" views/s")
    objects, views = (float(word) for word in line.replace(",", "").split() if word.replace(".", "").isdigit())
    assert views == pytest.approx(40 * objects, rel=0.01)
    assert objects > 10  # this was no slow one


def test_a_bar_without_views_shows_no_speed(monkeypatch):
    line = shown(monkeypatch, 80, slowly([1, 2]), 2, "exporting")
    assert " 2/2 " in line
    assert "/s" not in line
