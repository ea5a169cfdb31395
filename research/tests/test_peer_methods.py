"""Methods of other libraries that nextview-lab submit runs, where they are installed."""

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from nextview_lab.benchmark.frozen import FrozenArchive
from nextview_lab.benchmark.methods import CommandMethod, FrozenLook
from nextview_lab.benchmark.standings import KnownShape
from research.peers.looks import FARTHEST, Fit, Scan, Seen, View, averaged, said_of

PEERS = Path(__file__).parents[1] / "peers"


@pytest.fixture(params=[("gicp", "small_gicp"), ("point_pairs", "cv2")])
def method(request, archive):
    """A method in a process of its own."""
    script, library = request.param
    module = pytest.importorskip(library)
    if library == "cv2":
        module.ppf_match_3d  # noqa: B018
    command = f"{sys.executable} {PEERS / script}_method.py {archive / 'scans'}"
    started = CommandMethod(command, script, "1", blind=True)
    yield started
    started.close()


def look_at(archive, number, view, step=1):
    """A view of an episode of two views."""
    frozen = FrozenArchive(archive)
    episode = frozen.episode(number)
    images = frozen.view(number, view)
    return FrozenLook(
        number,
        step,
        2,
        view,
        str(images.depth),
        str(images.mask),
        episode.metres_per_unit,
        episode.intrinsics,
        episode.poses,
        tuple({0, 1, 2, 3} - {view}) if step == 1 else (),
        episode.held,
        tuple(frozen.things),
    )


def test_a_thing_is_named_and_its_pose_found(archive, method):
    frozen = FrozenArchive(archive)
    truth = frozen.truth("0001")
    answers = [
        method.answer(look_at(archive, "0001", 0)),
        method.answer(look_at(archive, "0001", 2, step=2)),
    ]
    assert [answer.name for answer in answers] == [truth.thing] * 2
    shape = KnownShape(frozen.scan(truth.thing), truth.thing)
    pose, true = (np.array(each) for each in (answers[1].pose, truth.pose))
    assert shape.distance(pose, true) < 3  # mm
    assert shape.turn(pose, true) < 5  # degrees
    # the farthest of the other three, which are 90 degrees apart
    assert answers[0].next == 2
    assert answers[1].next is None


def test_where_nothing_is_seen_the_thing_is_unknown(archive, method, tmp_path):
    look = look_at(archive, "0000", 0)
    empty = tmp_path / "mask.png"
    mask = np.asarray(Image.open(look.mask))
    Image.fromarray(np.zeros_like(mask)).save(empty)
    answer = method.answer(FrozenLook(**{**fields(look), "mask": str(empty)}))
    assert (answer.name, answer.confident, answer.pose) == (None, False, None)
    assert answer.next == 2

    later = method.answer(look_at(archive, "0000", 2, step=2))
    assert later.name == FrozenArchive(archive).truth("0000").thing


def fields(record):
    return {name: getattr(record, name) for name in record.__struct_fields__}


@pytest.fixture(scope="module")
def brick():
    """A box of 100 x 60 x 40 mm."""
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    points, faces = trimesh.sample.sample_surface(mesh, 20_000, seed=1)
    points = np.array(points)
    return Scan(points[:2000], mesh.face_normals[faces[:2000]], cKDTree(points))


@pytest.fixture(scope="module")
def top():
    """What a camera half a metre above the box sees of it: its upper face."""
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 101), np.linspace(-0.03, 0.03, 61))
    points = np.stack([x, y, np.full_like(x, 0.02)], -1).reshape(-1, 3)
    return Seen.of([View(points, np.array([0, 0, 0.5]))])


def test_the_misfit_is_small_at_the_true_pose_alone(brick, top):
    heights = brick.facing(np.eye(3), top)[:, 2]
    assert heights.max() == 0.02
    assert heights.min() > -0.02  # the lower face looks away
    true = brick.misfit(np.eye(4), top)
    raised, turned = np.eye(4), np.eye(4)
    raised[2, 3] = 0.005
    turned[:2, :2] = [[0, -1], [1, 0]]
    assert true < 0.0015  # half the distances between points
    assert true + 0.004 < brick.misfit(raised, top) < true + 0.01  # 5 mm, both ways
    assert brick.misfit(turned, top) > 0.002
    far = np.eye(4)
    far[0, 3] = 1
    assert brick.misfit(far, top) == pytest.approx(2 * FARTHEST)


def test_a_pose_that_is_not_finite_is_left_out(brick, top):
    broken = np.full((4, 4), np.nan)
    assert np.array_equal(brick.best([broken, np.eye(4)], top).pose, np.eye(4))
    assert brick.best([broken], top) is None
    assert brick.best([], top) is None


def test_points_in_a_cell_are_averaged():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.5, 0.9], [1.5, 0.2, 0.2]])
    assert np.allclose(averaged(points, 1.0), [[0.2, 0.3, 0.5], [1.5, 0.2, 0.2]])


def test_the_confidence_is_how_much_worse_the_second_fits():
    fits = {"mug": Fit(0.004, np.eye(4)), "cup": Fit(0.001, np.eye(4))}
    assert said_of({})["name"] is None
    said = said_of(fits)
    assert (said["name"], said["confidence"], said["confident"]) == ("cup", 0.75, True)
    alone = said_of({"mug": fits["mug"]})
    assert alone["confidence"] == pytest.approx(0.8)
