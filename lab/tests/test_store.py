"""A store knows when it is damaged or lacks a part, and says so in one sentence."""

import shutil
from pathlib import Path

import pytest
from lab_programs import refused
from pipeline import SPHERE

from nextview.errors import DatasetError
from nextview_lab.data.measures import measure
from nextview_lab.data.rendering import RenderOptions, render
from nextview_lab.data.store import RENDERED_ARRAYS, ViewStore


@pytest.fixture
def store(views, tmp_path) -> Path:
    """A copy of the shared store, to be damaged."""
    shutil.copytree(views, tmp_path / "views.zarr")
    return tmp_path / "views.zarr"


def chunk(views: Path, name: str, i: int) -> Path:
    place = views / name / "c" / str(i)
    return (
        place if place.is_file() else next(p for p in place.rglob("*") if p.is_file())
    )


def damage(file: Path, how: str) -> None:
    data = bytearray(file.read_bytes())
    match how:
        case "flipped":
            data[len(data) // 2] ^= 0x10
            file.write_bytes(data)
        case "cut":
            file.write_bytes(data[:-3])
        case "lost":
            file.unlink()


@pytest.mark.parametrize("name", [name for name in RENDERED_ARRAYS if name != "status"])
@pytest.mark.parametrize("how", ["flipped", "cut", "lost"])
def test_damage_is_named_by_every_read(store, name, how):
    ViewStore.open(store).note(unit="cm")
    damage(chunk(store, name, 1), how)
    wrong = "is missing" if how == "lost" else "cannot be read"
    views = ViewStore.open(store)
    reads = {
        "image": lambda: views.image(1),
        "depth": lambda: views.depth(1),
        "points": lambda: views.points(1),
        "measures/depth_entropy": views.measure,
        "radius": lambda: views.radii,
    }
    for read in (reads[name], lambda: views.rows(name)):
        with pytest.raises(
            DatasetError,
            match=rf"{name} of chair_1 {wrong}.*remove the store and render",
        ):
            read()


def test_a_damaged_object_ends_the_command_that_reads_it(
    store, models, tmp_path, capsys
):
    damage(chunk(store, "depth", 1), "lost")
    cards = [
        "--recogniser",
        models / "tiny.json",
        "--maps",
        f"lem={models / 'tiny-lem.json'}",
    ]
    said = refused(
        capsys, "predict", store, tmp_path / "out.npz", *cards, "--workers", 0
    )
    assert f"{store}: depth of chair_1 is missing; remove the store" in said
    assert not (tmp_path / "out.npz").exists()


def test_other_settings_and_meshes_are_refused_or_replace_the_store(
    store, furniture, tmp_path
):
    (store / "notes.txt").write_text("mine")
    changed = shutil.copytree(furniture, tmp_path / "changed")
    with (changed / "chair/test/chair_4.off").open("a") as file:
        file.write("\n")
    with pytest.raises(DatasetError):
        list(render(changed, store, SPHERE, 32))
    for options in (
        {"options": RenderOptions(seed=1)},
        {"size": 16},
        {"options": RenderOptions(split="train")},
    ):
        with pytest.raises(DatasetError):
            list(
                render(furniture, store, SPHERE, **{"size": 32, "workers": 0} | options)
            )
    list(measure(store, ["depth_entropy"], workers=0))
    options = RenderOptions(split="test")
    assert (
        len(
            list(
                render(furniture, store, SPHERE, 16, options, workers=0, overwrite=True)
            )
        )
        == 6
    )
    assert ViewStore.open(store).image(0).shape == (40, 16, 16)
    assert (store / "notes.txt").read_text() == "mine"
