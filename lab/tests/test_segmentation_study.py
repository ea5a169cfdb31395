"""How well things are parted, counted on drawn rectangles."""

import numpy as np
import pytest
from PIL import Image

from nextview.sensing.frame import Frame
from nextview_lab.studies.segmentation import Counts, draw_worst

SHAPE = (240, 320)
CAMERA = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


def labels(*rectangles: tuple[int, int, int, int, int]) -> np.ndarray:
    """Numbers of pixels: each rectangle is (number, top, bottom, left, right)."""
    drawn = np.zeros(SHAPE, np.int64)
    for number, top, bottom, left, right in rectangles:
        drawn[top:bottom, left:right] = number
    return drawn


@pytest.fixture
def counted() -> Counts:
    """Two things side by side that are one segment, and one behind a post that are two."""
    truth = labels((1, 50, 100, 20, 60), (2, 50, 100, 62, 82))
    truth += labels((3, 150, 200, 100, 200)) * (labels((1, 0, 240, 150, 160)) == 0)
    truth += labels((4, 140, 230, 150, 160))
    found = labels(
        (1, 50, 100, 20, 82), (2, 150, 200, 100, 150), (3, 150, 200, 160, 200)
    )
    found += labels((4, 140, 230, 150, 160))
    depth = np.where(truth == 4, 0.7, 0.9).astype(np.float32)
    counts = Counts()
    counts.add(Frame(depth, CAMERA), truth, found)
    return counts


def test_joined_and_cut_things_are_told_apart(counted):
    one, other, behind, post = counted.things
    assert (one.joined, one.cut, one.touching, one.pieces) == (1, 1, 1, 1)
    assert one.overlap == pytest.approx(40 / 62)
    assert (other.joined, other.overlap) == (1, pytest.approx(20 / 62))
    assert (behind.joined, behind.cut, behind.touching, behind.pieces) == (0, 2, 1, 2)
    assert behind.overlap == pytest.approx(50 / 90)
    assert (post.joined, post.cut, post.overlap) == (0, 1, 1)
    assert [thing.crowd for thing in counted.things] == [4] * 4
    assert [thing.distance for thing in counted.things] == pytest.approx(
        [0.9, 0.9, 0.9, 0.7]
    )
    assert (counted.segments, counted.good, counted.merges) == (4, 3, 1)


def test_a_frame_without_segments_has_things_of_no_overlap():
    counts = Counts()
    truth = labels((1, 50, 100, 20, 60))
    counts.add(Frame(np.ones(SHAPE, np.float32), CAMERA), truth, 0 * truth)
    (thing,) = counts.things
    assert (thing.overlap, thing.joined, thing.cut) == (0, 0, 0)
    assert counts.segments == 0


def test_the_worst_thing_of_each_frame_is_drawn(counted, tmp_path):
    draw_worst(counted.things, tmp_path / "worst.png")
    with Image.open(tmp_path / "worst.png") as drawn:
        pixels = np.asarray(drawn.convert("RGB")).astype(int)
    # blue is the narrow one of the joined things, and nothing else
    blue = pixels[..., 2] - pixels[..., 0] > 40
    high, wide = (np.ptp(at) + 1 for at in np.nonzero(blue))
    assert wide / high == pytest.approx(20 / 50, rel=0.1)
