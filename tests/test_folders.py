"""Every layout of a dataset folder that is understood, and what is said of the rest."""

from pathlib import Path

import pytest

from nextview.data.folders import list_dataset, scan_dataset
from nextview.errors import DatasetError


def meshes(root: Path, *places: str) -> Path:
    for place in places:
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        (root / place).write_text("OFF\n")
    return root


@pytest.mark.parametrize(
    ("places", "entries"),
    [
        (["cup/1.off", "jar/1.off"], [("cup_1", "cup", ""), ("jar_1", "jar", "")]),
        (["cup/a.off", "jar/b.off"], [("a", "cup", ""), ("b", "jar", "")]),
        (
            ["cup/test/b.off", "cup/train/a.off", "cup/val/c.off"],
            [("a", "cup", "train"), ("b", "cup", "test"), ("c", "cup", "val")],
        ),
        (["train/cup/a.off", "val/cup/b.off"], [("a", "cup", "train"), ("b", "cup", "val")]),
        (["bed/77/models/model.off", "bed/78/models/model.off"], [("77", "bed", ""), ("78", "bed", "")]),
        (["bed/train/77/m.off", "bed/test/78/m.off"], [("77", "bed", "train"), ("78", "bed", "test")]),
        (["bed/old/a.off", "bed/b.off"], [("a", "bed", ""), ("b", "bed", "")]),
        (["train/a.off", "plane/b.off"], [("b", "plane", ""), ("a", "train", "")]),
        (
            ["cup/train/1.off", "cup/test/1.off", "jar/train/1.off"],
            [("cup_train_1", "cup", "train"), ("cup_test_1", "cup", "test"), ("jar_train_1", "jar", "train")],
        ),
    ],
)
def test_every_layout_is_understood(tmp_path, places, entries):
    assert [(e.name, e.label, e.split) for e in list_dataset(meshes(tmp_path, *places))] == entries


def test_links_are_followed_but_not_in_circles(tmp_path):
    root = meshes(tmp_path / "data", "cup/a.off")
    meshes(tmp_path / "elsewhere", "b.off", "c.off")
    (root / "jar").symlink_to(tmp_path / "elsewhere")
    (root / "cup/d.off").symlink_to(tmp_path / "elsewhere/b.off")
    (root / "cup/again").symlink_to(root)
    (root / "pot").symlink_to(tmp_path / "elsewhere")
    listing = scan_dataset(root)
    assert [(e.name, e.label) for e in listing.entries] == [("a", "cup"), ("d", "cup"), ("b", "jar"), ("c", "jar")]
    assert {f"{path}" for path, _ in listing.left_out} == {"cup/again", "pot"}


def test_what_is_understood_and_what_is_left_out_is_said(tmp_path):
    root = meshes(tmp_path, "loose.off", ".trash/bed/a.off", "bed/train/a.off", "bed/val/b.off", "bed/9/m/c.off")
    (root / "bed/gone.off").symlink_to(root / "nowhere.off")
    assert scan_dataset(root).summary() == (
        "3 of 6 objects: 1 in CLASS/train/MESH, 1 in CLASS/val/MESH, 1 in CLASS/.../MESH; left out: "
        "1 (hidden): .trash/bed/a.off; 1 (no file): bed/gone.off; 1 (not in a class folder): loose.off"
    )


def test_meshes_of_one_name_in_one_place_are_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"1\.obj and .*1\.off would both be called jar_1; rename one"):
        list_dataset(meshes(tmp_path, "jar/1.off", "jar/1.obj", "cup/1.off"))
    with pytest.raises(DatasetError, match="no such folder"):
        list_dataset(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="no meshes in CLASS/NAME"):
        list_dataset(meshes(tmp_path / "empty", "notes.txt"))
    flat = list_dataset(meshes(tmp_path / "flat", "a.off", "b.off"))  # each is a class of its own
    assert [(entry.label, entry.name) for entry in flat] == [("a", "a"), ("b", "b")]
