"""A recogniser of a user's own: by views or by all views together, and what is refused at the
door.
"""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from recordings import write_captured
from scipy.spatial import cKDTree

import nextview
from nextview.captured.camera import CapturedCamera
from nextview.captured.folders import read_capture
from nextview.data.samples import sample_mesh
from nextview.errors import ModelError, SessionError, UsageError
from nextview.policies.base import Evidence
from nextview.recognition.poses import PoseCandidate
from nextview.recognition.protocol import JointBelief
from nextview.simulation.simulated import SimulatedCamera

NAMES = ("chair", "monitor", "table")


class NearestPoints:
    """A geometric matcher: how near all seen points are to those of each mesh, turned by steps."""

    classes = NAMES

    def __init__(self):
        self.trees = [cKDTree(sample_points(name)) for name in NAMES]

    def distance(self, observations, tree) -> float:
        points = np.concatenate([seen.points[::8] for seen in observations])
        angles = np.arange(12) * np.pi / 6
        turned = [points @ turn(angle).T for angle in angles]
        return min(tree.query(each)[0].mean() for each in turned)

    def belief(self, observations):
        far = np.array([self.distance(observations, tree) for tree in self.trees])
        likelihood = np.exp(-far / 0.02)
        return likelihood / likelihood.sum()


def turn(angle: float) -> np.ndarray:
    return np.array(
        [
            [np.cos(angle), -np.sin(angle), 0],
            [np.sin(angle), np.cos(angle), 0],
            [0, 0, 1],
        ]
    )


def sample_points(name: str) -> np.ndarray:
    camera = nextview.SimulatedCamera(sample_mesh(name), 96)
    return np.concatenate(
        [camera.observe(pose).points for pose in nextview.ViewSphere.named("12").poses]
    )


class Filled:
    """By how much of the picture is filled: adds up over views."""

    classes = ("much", "little")

    def __call__(self, observations):
        filled = np.array([seen.visible / seen.depth.size for seen in observations])
        return np.stack([filled, 0.3 - filled], 1)


@pytest.mark.parametrize("name", NAMES)
def test_a_geometric_matcher_of_ones_own_judges_all_views(name):
    system = nextview.load(
        recogniser=NearestPoints(), threads=1, threshold=0.9, max_views=3
    )
    assert system.classes == NAMES
    assert "NearestPoints" in repr(system)
    result = system.recognise(sample_mesh(name), seed=4)
    assert result.answer == name
    seen = [view.observation for view in result.views]
    np.testing.assert_allclose(result.views[-1].belief, NearestPoints().belief(seen))
    assert (result.pose, result.why_no_pose) == (None, "")


def test_poses_of_ones_own_arrive_in_the_result():
    pose = np.eye(4)
    pose[:3, 3] = (0.1, 0.2, 0.3)

    class Posed(NearestPoints):
        def belief(self, observations):
            found = super().belief(observations)
            best = int(found.argmax())
            candidate = PoseCandidate(
                NAMES[best], best, pose, 1.0, degrees=3.0, millimetres=4.0
            )
            return JointBelief(found, (candidate,), p_value=0.5)

    result = nextview.load(recogniser=Posed(), threads=1).recognise(
        sample_mesh("chair"), seed=1
    )
    np.testing.assert_array_equal(result.pose, pose)
    assert (result.pose_uncertainty.degrees, result.novelty) == (3.0, 0.5)


@dataclass(frozen=True)
class ForThePose:
    """A policy with a goal: any free view."""

    sphere: Any
    goal: str = "thing"
    needs: tuple = ()

    def seeking(self, goal):
        return replace(self, goal=goal)

    def next_views(self, state, rng):
        return state.free.argmax(1)


def test_for_the_goal_pose_a_session_goes_on_until_the_pose_is_sure():
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about the vertical

    class Unsure(NearestPoints):
        """Knows the thing at once, and its pose from the third view on."""

        def belief(self, observations):
            second = 0.4 if len(observations) < 3 else 0.01
            poses = (
                PoseCandidate(NAMES[0], 0, np.eye(4), 1 - second),
                PoseCandidate(NAMES[0], 0, turned, second),
            )
            return JointBelief(
                np.array([0.99, *[0.01 / (len(NAMES) - 1)] * (len(NAMES) - 1)]), poses
            )

    system = nextview.load(recogniser=Unsure(), threads=1)
    system = replace(system, policy=ForThePose(system.sphere))
    camera = SimulatedCamera(sample_mesh("chair"))
    taken = {}
    for goal in ("thing", "pose"):
        session = system.session(start=20, goal=goal)
        assert session.policy.goal == goal
        taken[goal] = len(session.run(camera).views)
    assert taken == {"thing": 1, "pose": 3}

    session = system.session(start=20)
    session.update(camera.observe(session.pose))
    with pytest.raises(SessionError):
        session.goal = "pose"
    with pytest.raises(UsageError):
        system.session(goal="speed")
    with pytest.raises(UsageError):
        nextview.load(policy="spread").session(goal="pose")


class Fails(Filled):
    def __call__(self, observations):
        return 1 / 0


def says(value, **more):
    return type(
        "Says",
        (),
        {"classes": ("a", "b"), "__call__": lambda self, seen: value, **more},
    )()


def believes(value):
    return type(
        "Believes", (), {"classes": ("a", "b"), "belief": lambda self, seen: value}
    )()


def poses(*poses, **more):
    return believes(JointBelief(np.array([0.5, 0.5]), poses, **more))


WRONG = {
    "raises": Fails(),
    "logits of other classes": says(np.zeros((1, 3))),
    "no azimuth bins": says(Evidence(np.zeros((1, 2))), azimuth_bins=8),
    "more than one": believes([0.5, 0.6]),
    "a p-value of two": poses(p_value=2.0),
    "a pose that scales": poses(PoseCandidate("a", 0, 2 * np.eye(4), 1.0)),
    "a pose of no class": poses(PoseCandidate("a", 5, np.eye(4), 1.0)),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_it_says_is_checked(what):
    system = nextview.load(recogniser=WRONG[what], threads=1)
    with pytest.raises(ModelError):
        system.recognise(sample_mesh("chair"))


@pytest.mark.parametrize(
    ("given", "error"),
    [
        (object(), ModelError),
        (SimpleNamespace(belief=print), ModelError),
        (SimpleNamespace(belief=print, classes="chair"), ModelError),
        (SimpleNamespace(belief=print, classes=()), ModelError),
        (SimpleNamespace(belief=print, classes=("a", "a")), ModelError),
        (SimpleNamespace(belief=print, classes=("a",), calibration=2), ModelError),
        (SimpleNamespace(belief=print, classes=("a",), azimuth_bins=-1), UsageError),
        (Filled, ModelError),
        ("here", UsageError),
        ("nowhere_at_all:Thing", UsageError),
    ],
)
def test_what_is_no_recogniser_is_refused_at_the_door(given, error):
    with pytest.raises(error):
        nextview.load(recogniser=given, threads=1)


class Painted:
    """Tells a red object from a blue one of the same shape, by the mean colour of its pixels."""

    classes = ("blue", "red")

    def __call__(self, observations):
        logits = []
        for observation in observations:
            colours = observation.colour[observation.depth > 0].astype(float)
            logits.append([colours[:, 2].mean() / 16, colours[:, 0].mean() / 16])
        return np.array(logits)


@pytest.mark.parametrize(
    ("table", "answer", "rgb"),
    [(False, "red", (200, 30, 20)), (True, "blue", (10, 40, 180))],
)
def test_a_recogniser_of_ones_own_sees_the_colours_of_captured_images(
    tmp_path, table, answer, rgb
):
    """The background is of the other colour, which must not reach the recogniser."""
    folder = tmp_path / "captured"
    sphere = nextview.ViewSphere.named("12")
    write_captured(sample_mesh("chair"), folder, sphere, 0.5, table=table)
    other = (10, 40, 180) if answer == "red" else (200, 30, 20)
    (folder / "rgb").mkdir(exist_ok=True)
    for mask in folder.glob("mask_visib/*.png"):
        shown = np.asarray(Image.open(mask)) > 0
        colours = np.where(shown[..., None], rgb, other).astype(np.uint8)
        Image.fromarray(colours).save(folder / "rgb" / f"{mask.stem.split('_')[0]}.png")
    camera = CapturedCamera(read_capture(folder))
    result = nextview.load(recogniser=Painted(), threshold=0.9).recognise(camera)
    assert result.answer == answer
    for view in result.views:
        shown = view.observation.depth > 0
        pure = (view.observation.colour[shown] == rgb).all(1)
        assert (
            pure.mean() > 0.95
        )  # but for edges, where a facet lies over several pixels
        assert not view.observation.colour[~shown].any()
        assert not view.observation.colour.flags.writeable
