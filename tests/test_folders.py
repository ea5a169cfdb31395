"""Every layout of a dataset folder that is understood, and what is said of the rest."""

from pathlib import Path

import pytest

from nextview.data.folders import (
    left_out_phrases,
    list_dataset,
    read_folder,
    scan_dataset,
)
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
        (
            ["cup/test/b.off", "cup/train/a.off", "cup/val/c.off"],
            [("a", "cup", "train"), ("b", "cup", "test"), ("c", "cup", "val")],
        ),
        (
            ["train/cup/a.off", "val/cup/b.off"],
            [("a", "cup", "train"), ("b", "cup", "val")],
        ),
        (
            ["bed/77/models/model.off", "bed/78/models/model.off"],
            [("77", "bed", ""), ("78", "bed", "")],
        ),
        (
            ["bed/train/77/m.off", "bed/test/78/m.off"],
            [("77", "bed", "train"), ("78", "bed", "test")],
        ),
        (["train/a.off", "plane/b.off"], [("b", "plane", ""), ("a", "train", "")]),
        (
            ["cup/train/1.off", "cup/test/1.off", "jar/train/1.off"],
            [
                ("cup_train_1", "cup", "train"),
                ("cup_test_1", "cup", "test"),
                ("jar_train_1", "jar", "train"),
            ],
        ),
    ],
)
def test_every_layout_is_understood(tmp_path, places, entries):
    assert [
        (e.name, e.label, e.split) for e in list_dataset(meshes(tmp_path, *places))
    ] == entries


def test_links_are_followed_but_not_in_circles(tmp_path):
    root = meshes(tmp_path / "data", "cup/a.off")
    meshes(tmp_path / "elsewhere", "b.off", "c.off")
    (root / "jar").symlink_to(tmp_path / "elsewhere")
    (root / "cup/d.off").symlink_to(tmp_path / "elsewhere/b.off")
    (root / "cup/again").symlink_to(root)
    (root / "pot").symlink_to(tmp_path / "elsewhere")
    listing = scan_dataset(root)
    assert [(e.name, e.label) for e in listing.entries] == [
        ("a", "cup"),
        ("d", "cup"),
        ("b", "jar"),
        ("c", "jar"),
    ]
    assert {f"{path}" for path, _ in listing.left_out} == {"cup/again", "pot"}


# what lies in a folder; what is taken, (name, label, split); and what is left out, by a part of the
# reason
CASES = {
    "formats": (
        [
            "tin.stl",
            "tin.ply",
            "tin.OBJ",
            "box.stl",
            "cup/a.stl",
            "cup/a.off",
            "textures/wood.png",
        ],
        [("a", "cup", ""), ("box", "box", ""), ("tin", "tin", "")],
        {
            "tin.OBJ, tin.stl": "the PLY file of the same model is taken",
            "cup/a.stl": "the OFF file",
            "textures": "holds no mesh",
        },
    ),
    "ycb": (
        [
            *(
                "011_banana/google_16k/" + name
                for name in ("nontextured.stl", "textured.obj", "nontextured.ply")
            ),
            "011_banana/google_64k/nontextured.ply",
            "011_banana/clouds/merged_cloud.ply",
            "065-a_cups/tsdf/textured.obj",
            "065-a_cups/tsdf/textured.mtl",
        ],
        [("011_banana", "011_banana", ""), ("065-a_cups", "065-a_cups", "")],
        {
            "textured.obj": "the PLY file of the same model",
            "google_64k/nontextured.ply": "another file of the same model",
            "065-a_cups/tsdf/textured.mtl": "no mesh",
        },
    ),
    "splits of single things": (
        ["train/a.ply", "test/b.ply", "test/c.ply"],
        [("a", "a", "train"), ("b", "b", "test"), ("c", "c", "test")],
        {},
    ),
    "one name in several places": (
        ["box.ply", "cups/box.ply", "cups/old/box.ply"],
        [("box", "box", ""), ("cups_box", "cups", ""), ("cups_old_box", "cups", "")],
        {},
    ),
    "what is no mesh": (
        [
            "a.ply",
            "b.step",
            "c.3MF",
            "d/e.gltf",
            "d/f.usdz",
            "notes.txt",
            "__MACOSX/._a.ply",
            "._a.ply",
            "x/y/z.txt",
        ],
        [("a", "a", "")],
        {
            "b.step, c.3MF, d/e.gltf and 1 more": "of a format that is not read; export it as .off",
            "notes.txt": "no mesh",
            "._a.ply, __MACOSX": "hidden",
            "x": "holds no mesh",
        },
    ),
    "names that cannot be printed": (
        [
            "a.ply",
            "b\nc.ply",
            b"caf\xe9.ply".decode("utf-8", "surrogateescape"),
            "cl\x1bass/d.ply",
        ],
        [("a", "a", "")],
        {r"b c.ply, caf\udce9.ply, cl\x1bass": "its name cannot be printed; rename it"},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_all_that_is_in_a_folder_is_taken_or_left_out_with_a_reason(tmp_path, case):
    places, expected, left_out = CASES[case]
    listing = read_folder(meshes(tmp_path, *places), loose=True)
    in_order = sorted(expected, key=lambda e: (e[1], e[2] != "train"))
    assert [
        (entry.name, entry.label, entry.split) for entry in listing.entries
    ] == in_order
    phrases = left_out_phrases(listing.left_out)
    for path, reason in left_out.items():
        assert any(
            path in phrase.partition(": ")[0] and reason in phrase for phrase in phrases
        ), phrases
    assert len(phrases) >= len(left_out)
    assert bool(phrases) == bool(left_out)
    taken = {entry.path for entry in listing.entries}
    said = {tmp_path / place for place, _ in listing.left_out}
    for place in places:
        path = tmp_path / place
        assert (
            path in taken
            or path in said
            or any(above in said for above in path.parents)
        ), place


def test_links_that_lead_nowhere_and_folders_of_results_are_left_out(tmp_path):
    root = meshes(
        tmp_path / "scans",
        "a.ply",
        "old/memory.json",
        "views.zarr/zarr.json",
        "views.zarr/c/0.off",
        "new/b.ply",
    )
    (root / "empty").mkdir()
    (root / "gone").symlink_to("nowhere")
    (root / "gone.ply").symlink_to("nowhere.ply")
    (root / "circle.ply").symlink_to("circle.ply")
    listing = read_folder(
        root, loose=True, skip={root / "new": "a result", root / "not there": "nothing"}
    )
    assert [entry.name for entry in listing.entries] == ["a"]
    assert dict(listing.left_out) == {
        Path("circle.ply"): "a link that leads nowhere",
        Path("gone"): "a link that leads nowhere",
        Path("gone.ply"): "a link that leads nowhere",
        Path("views.zarr"): "a view store",
        Path("new"): "a result",
        Path("old"): "holds no mesh",
        Path("empty"): "holds no mesh",
    }


def test_a_dataset_without_meshes_is_rejected_with_its_contents(tmp_path, caplog):
    with pytest.raises(DatasetError):
        list_dataset(tmp_path / "nowhere")
    with pytest.raises(DatasetError):
        list_dataset(meshes(tmp_path / "empty", "cup/a.dae"))
    with pytest.raises(DatasetError):
        list_dataset(
            meshes(
                tmp_path / "twice",
                "a/b_c.off",
                "a_b/c.off",
                "d/c.off",
                "d/e/c.off",
                "f/b_c.off",
            )
        )
    list_dataset(meshes(tmp_path / "loose", "loose.off", "cup/a.off"))
    assert "loose: left out: loose.off: not in a class folder" in caplog.text
    # each is a class of its own
    flat = list_dataset(meshes(tmp_path / "flat", "a.off", "b.off"))
    assert [(entry.label, entry.name) for entry in flat] == [("a", "a"), ("b", "b")]
