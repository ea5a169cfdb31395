"""``nextview-lab evaluate`` from a file of predictions to a folder, and what it refuses."""

import csv
import json
from dataclasses import replace

import pytest
from lab_programs import main
from pipeline import some_predictions

TABLES = ("accuracy", "fusion", "confusion", "reliability", "maps")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An evaluation of two maps."""
    folder = tmp_path_factory.mktemp("evaluate")
    p = some_predictions(30, seed=1)
    replace(p, maps=p.maps | {"lcm": p.maps["lem"][::-1]}).save(folder / "p.npz")
    main(["evaluate", str(folder / "p.npz"), str(folder / "out"), "--samples", "50"])
    return folder


def table(folder, name):
    with (folder / "out" / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_folder_holds_tables_settings_and_a_page(made):
    files = {*(f"{name}.csv" for name in TABLES), "evaluate.json", "evaluate.html"}
    assert {path.name for path in (made / "out").iterdir()} == files
    assert (
        json.loads((made / "out" / "evaluate.json").read_text())["settings"]["objects"]
        == 30
    )
    assert all(len(table(made, name)) > 1 for name in TABLES)
    assert (made / "out" / "evaluate.html").read_text().count("data:image/svg+xml") == 4
    assert sorted(path.name for path in made.iterdir() if "part" in path.name) == []
