"""The published comparison of recognisers: which networks it holds, and one of them trained."""

import csv

import pytest

torch = pytest.importorskip("torch")

from nextview_lab.thesis import train_grid
from nextview_lab.thesis.train_grid import published_cells
from nextview_lab.training.recipes import RecogniserRecipe

TEN = (
    "bathtub",
    "bed",
    "chair",
    "desk",
    "dresser",
    "monitor",
    "night_stand",
    "sofa",
    "table",
    "toilet",
)


def test_the_grid_holds_the_networks_of_table_6():
    assert published_cells(
        TEN,
        40,
    ) == {  # two numbers are printed for ResNet-34 in batches of 4
        (18, 4): [0.8588],
        (34, 4): [0.8599, 0.8588],
        (34, 8): [0.8642],
        (34, 16): [0.8662],
        (34, 32): [0.871],
        (34, 64): [0.8704],
        (50, 4): [0.8444],
        (101, 4): [0.8523],
        (152, 4): [0.862],
    }
    assert published_cells(TEN, 12) == {(18, 32): [0.8901]}
    elsewhere = published_cells(("a", "b"), 5)
    assert {depth for depth, _ in elsewhere} == {18, 34, 50, 101, 152}
    assert not any(elsewhere.values())


def test_one_network_is_trained_judged_and_drawn(views, tmp_path, monkeypatch):
    monkeypatch.setattr(
        train_grid, "published_cells", lambda *_: {(18, 4): [0.5, 0.75], (34, 4): []}
    )
    recipe = RecogniserRecipe(
        epochs=1,
        size=32,
        views_per_object=2,
        validation_share=0.25,
    )
    train_grid.main(views, tmp_path / "grid", (18,), recipe=recipe)
    rows = list(csv.DictReader((tmp_path / "grid/grid.csv").read_text().splitlines()))
    assert [(row["depth"], row["batch_size"], row["published"]) for row in rows] == [
        ("18", "4", "0.5"),
        ("18", "4", "0.75"),
    ]
    assert 0 <= float(rows[0]["accuracy"]) <= 1
    assert (tmp_path / "grid/grid.png").exists()
    assert (tmp_path / "grid/resnet18-batch4/curves.png").exists()
