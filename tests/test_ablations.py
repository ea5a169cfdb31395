"""The ablations on predictions of which it is known what each part of the belief is worth."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline import some_predictions, store_of

from nextview.errors import PredictionsError

ABLATIONS = runpy.run_path(
    str(Path(__file__).parents[1] / "benchmarks" / "ablations.py")
)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("|")[1:-1]]


def test_views_that_agree_on_the_azimuth_bin_settle_what_logits_leave_open(
    tmp_path,
    capsys,
):
    """Only in the true class do all views point the same way: the logits say nothing, the bins
    everything.
    """
    rng, p = np.random.default_rng(0), some_predictions(60)
    seen = (p.sphere.azimuth_index[None] - rng.integers(0, 8, (60, 1))) % 8
    bins = np.repeat(rng.integers(0, 8, (60, 40, 1)), 3, axis=2)
    bins[np.arange(60), :, p.labels] = seen
    azimuth_bins = np.log(np.where(np.arange(8) == bins[..., None], 0.93, 0.01)).astype(
        np.float32
    )
    # always the first class, if barely
    logits = np.broadcast_to(np.float32([0.01, 0, 0]), p.logits.shape)
    p = replace(p, logits=logits, azimuth_bins=azimuth_bins)
    replace(p, splits=np.array(["train"] * 60)).save(tmp_path / "validation.npz")
    p.save(tmp_path / "test.npz")
    ABLATIONS["agreement"](tmp_path / "validation.npz", tmp_path / "test.npz")
    lines = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")
    ]
    assert len(lines) == 16
    for line in (lines[7], lines[15]):
        views, alone, agreeing, difference = cells(line)
        assert views == "40"
        assert alone.startswith("0.333")
        assert agreeing.startswith("1.000 (1.000)")
        assert difference.startswith("+66.7 (")
    assert cells(lines[9])[3] == ""  # one view has nothing to agree with


def test_azimuth_bins_are_right_exactly_or_up_to_a_half_turn(tmp_path):
    pytest.importorskip("torch")
    p = some_predictions(10)
    values = np.tile(np.cos(np.pi / 4 * p.sphere.azimuth_index), (10, 1))
    store = store_of(
        tmp_path / "views.zarr",
        p.names,
        p.labels,
        p.sphere,
        depth_entropy=values,
    )
    features = np.repeat(p.sphere.azimuth_index[None], 10, axis=0)
    features[:3] += 4  # the wrong way round
    features[3] += 1
    azimuth_bins = np.zeros((10, 40, 3, 8), np.float32)
    np.put_along_axis(
        azimuth_bins,
        np.repeat((features % 8)[:, :, None, None], 3, axis=2),
        5,
        axis=3,
    )
    assert ABLATIONS["bins_told"](
        replace(p, azimuth_bins=azimuth_bins),
        store,
    ) == pytest.approx((0.6, 0.9))
    with pytest.raises(PredictionsError, match="tell no azimuth bins"):
        ABLATIONS["bins_told"](p, store)


def test_the_size_is_compared_with_the_shape_alone(tmp_path, capsys):
    p = some_predictions(40)
    of_size = (100.0 * np.eye(3)[p.labels]).astype(np.float32)
    replace(p, logits=p.logits + of_size[:, None], of_size=of_size).save(
        tmp_path / "sized.npz"
    )
    ABLATIONS["size"](tmp_path / "sized.npz")
    lines = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")
    ]
    assert all(cells(line)[2] == "1.000 (1.000)" for line in lines[1:])
    share = (p.logits.argmax(2) == p.labels[:, None]).mean()
    views, alone, _, difference = cells(lines[1])
    assert (views, alone[:5]) == ("1", f"{share:.3f}")
    assert difference.startswith(f"{100 * (1 - share):+.1f} (")
    p.save(tmp_path / "p.npz")
    with pytest.raises(PredictionsError, match="nothing is said of sizes"):
        ABLATIONS["size"](tmp_path / "p.npz")
