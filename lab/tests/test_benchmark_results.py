"""What studies share, and how they count: results line by line, so that a run goes on after a
kill and runs nothing again; frames with their truth.
"""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from PIL import Image

from nextview.errors import UsageError
from nextview_lab.studies.real_frames import Answer, alone, answers, frames_in
from nextview_lab.studies.shared import read_lines, results, scans_in, scans_of, share

INTRINSICS = (30.0, 31.0, 11.5, 7.5)


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
    with pytest.raises(UsageError, match="holds no scan"):
        scans_in(tmp_path)
    for name in ("mug.ply", "bowl.OFF", "notes.txt"):
        (tmp_path / name).touch()
    assert list(scans_in(tmp_path)) == ["bowl", "mug"]
    assert list(scans_in(tmp_path, (".ply",))) == ["mug"]
    assert [path.name for path in scans_of(tmp_path, ["mug", "bowl"])] == [
        "mug.ply",
        "bowl.OFF",
    ]
    with pytest.raises(UsageError, match="no scan of fork, and of 1 other things"):
        scans_of(tmp_path, ["fork", "mug", "notes"])


def test_a_share_has_the_wilson_interval():
    # (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n), z = 1.96, by hand
    assert share(8, 10) == "8 of 10, 0.80 (0.49 to 0.94)"
    assert share(0, 0) == "-"


# Real frames


def columns(low, high):
    """A mask of some columns of an image of 16 x 24 pixels."""
    mask = np.zeros((16, 24), bool)
    mask[:, low:high] = True
    return mask


def test_objects_are_compared_with_the_things_that_they_hold():
    things = [
        ("nut", columns(2, 5)),
        ("bolt", columns(8, 12)),
        ("pin", columns(20, 21)),
    ]
    objects = [
        ("nut", True, columns(1, 5)),
        ("unknown", False, columns(10, 13)),
        ("washer", True, columns(7, 10) & ~columns(9, 10)),  # holds less of the bolt
        ("nut", False, columns(15, 17)),
    ]
    known, others = answers(things, objects)
    assert known == [
        Answer("nut", True, True),
        Answer("unknown", False, False),
        Answer(None, False, False),
    ]
    assert others == [Answer("washer", True, False), Answer("nut", False, False)]
    assert [one.sure_and_wrong for one in known + others] == [False] * 3 + [True, False]


def test_the_name_of_two_things_in_one_object_is_right_for_one_of_them():
    things = [("nut", columns(2, 5)), ("bolt", columns(8, 12))]
    known, others = answers(things, [("bolt", True, columns(0, 14))])
    assert [(one.right, one.sure_and_wrong) for one in known] == [
        (False, True),
        (True, False),
    ]
    assert others == []


def test_strangers_alone_are_right_if_they_are_unknown():
    known, others = answers([], [("unknown", False, columns(0, 3))])
    assert (known, others) == ([], [Answer("unknown", False, True)])


def test_frames_are_read_with_points_or_with_labels(tmp_path):
    depth = np.full((16, 24), 5000, np.uint16)
    points = tmp_path / "points"
    for name, scale in (("second", 0.0002), ("first", None)):
        folder = points / name
        folder.mkdir(parents=True)
        Image.fromarray(depth).save(folder / "depth.png")
        (folder / "K.json").write_text(json.dumps(INTRINSICS))
        if scale:
            (folder / "scale.json").write_text(str(scale))
    truth = {"second": [{"name": "nut", "column": 20, "row": 3}]}
    (points / "truth.json").write_text(json.dumps(truth))
    first, second = frames_in(points, (1.0, 1.0, 0.0, 0.0))
    assert (first.name, first.things, second.name) == ("first", [], "second")
    assert first.frame.depth.max() == 5.0
    np.testing.assert_allclose(second.frame.depth, 1.0)
    assert second.frame.intrinsics[0, 0] == 30
    ((name, pixels),) = second.things
    assert name == "nut"
    assert pixels[3, 20]
    assert pixels[11, 20]
    assert not pixels[12, 20]
    assert not pixels[3, 11]

    labels = tmp_path / "labels"
    labels.mkdir()
    Image.fromarray(depth).save(labels / "a.depth.png")
    shown = columns(2, 5) * 2 + columns(8, 12).astype(np.uint8)
    Image.fromarray(shown.astype(np.uint8)).save(labels / "a.labels.png")
    (labels / "names.txt").write_text("none\nbolt\nnut\n")
    (frame,) = frames_in(labels, INTRINSICS)
    assert [name for name, _ in frame.things] == ["bolt", "nut"]
    np.testing.assert_array_equal(frame.things[1][1], columns(2, 5))

    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"empty: holds no NAME\.depth\.png"):
        frames_in(tmp_path / "empty", INTRINSICS)


def test_a_thing_in_a_frame_without_a_table_is_not_right(tmp_path, capsys):
    folder = tmp_path / "frames/nothing"
    folder.mkdir(parents=True)
    depth = np.zeros((48, 64), np.uint16)
    depth[20:23, 30:33] = 900
    Image.fromarray(depth).save(folder / "depth.png")
    (folder / "K.json").write_text(json.dumps([60.0, 60.0, 31.5, 23.5]))
    truth = {"nothing": [{"name": "mug", "column": 30, "row": 20}]}
    (tmp_path / "frames/truth.json").write_text(json.dumps(truth))
    alone(tmp_path / "frames")
    shown = capsys.readouterr().out
    assert "1 frames, each alone; 1 refused" in shown
    assert "| taught things | 1 | 0 of 1, 0.00" in shown
    assert "other objects" not in shown
