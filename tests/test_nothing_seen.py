"""Views in which nothing is seen: no evidence, no confidence, no answer."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from matplotlib.text import Text
from scipy.special import softmax

import nextview
from nextview import SimulatedCamera, Stopping, ViewSphere
from nextview.data.samples import sample_mesh
from nextview.geometry.camera import pinhole
from nextview.policies.base import Evidence
from nextview.policies.baselines import Unidirectional
from nextview.recognition.belief import Calibration
from nextview.sensing.observation import Observation
from nextview.session.episode import Episodes
from nextview.session.session import Session

SPHERE = ViewSphere.named("40")


def features(logits, seen=None, azimuth_bins=None) -> Evidence:
    return Evidence(
        np.asarray(logits, float),
        azimuth_bins=azimuth_bins,
        seen=None if seen is None else np.array(seen),
    )


# Evidence


@pytest.mark.parametrize(
    "calibration",
    [Calibration(), Calibration(0.7, 0.5), Calibration(0.7, 1.0, None, 2.0)],
)
def test_episodes_are_believed_as_if_their_empty_views_had_not_been_taken(calibration):
    """Each of 40 episodes has empty views of its own; alone and without them it believes the
    same.
    """
    rng, b, k = np.random.default_rng(0), 40, 6
    logits, empty = rng.normal(size=(b, k, 3)), rng.random((b, k)) < 0.4
    empty[0], empty[1] = True, False
    azimuth_bins = (
        np.log(rng.dirichlet(np.ones(8), (b, k, 3)))
        if calibration.bin_correlation
        else None
    )
    sure = Stopping(1.0, k)
    together = Episodes(
        SPHERE,
        Unidirectional(SPHERE),
        np.arange(b),
        sure,
        np.random.default_rng(0),
        calibration,
    )
    for observation in range(k):
        unread = np.where(empty[:, observation, None], np.nan, logits[:, observation])
        bins = None if azimuth_bins is None else azimuth_bins[:, observation]
        step = together.update(features(unread, ~empty[:, observation], bins))
        np.testing.assert_array_equal(step.seen, (~empty[:, : observation + 1]).sum(1))
    assert (together.outcome.n_views == k).all()
    views = together.outcome.views
    for e in range(b):
        kept = np.flatnonzero(~empty[e])
        log_evidence = np.zeros((1, 3)) if len(kept) == 0 else logits[e, kept]
        total = log_evidence.sum(0) / calibration.temperature_after(max(len(kept), 1))
        if azimuth_bins is not None:
            zero = np.zeros((3, 8))  # by the azimuth of the object's azimuth bin 0
            for k, side in product(kept, range(8)):
                zero[:, (SPHERE.azimuth_index[views[e, k]] - side) % 8] += azimuth_bins[
                    e, k, :, side
                ]
            total = total + np.log(
                np.exp(zero / (1 + 2.0 * (max(len(kept), 1) - 1))).sum(1)
            )
        np.testing.assert_allclose(
            together.steps[-1].belief[e], softmax(total), atol=1e-12
        )
    np.testing.assert_array_equal(together.steps[-1].belief[0], np.full(3, 1 / 3))


@pytest.mark.parametrize("threshold", [0.0, 1 / 3, 0.9])
def test_an_empty_view_is_taken_but_never_confident(threshold):
    rule, rng = Stopping(threshold, 3), np.random.default_rng(0)
    episodes = Episodes(SPHERE, Unidirectional(SPHERE), np.array([0, 0]), rule, rng)
    episodes.update(features([[9, 0, 0], [9, 0, 0]], [False, True]))
    assert episodes.running.tolist() == [0]
    episodes.update(features([[9, 0, 0]], [False]))
    assert episodes.current[0] == 2  # it went on
    episodes.update(features([[9, 0, 0]], [False]))
    end = episodes.outcome
    assert end.n_views.tolist() == [3, 1]
    assert end.confident.tolist() == [False, True]


@pytest.mark.parametrize("name", ["gain", "lem", "spread-local"])
def test_every_kind_of_policy_continues_after_an_empty_view(name):
    system = nextview.load(policy=name)
    camera = SimulatedCamera(sample_mesh("chair"))

    class Covered:
        """Sees nothing in the first two views."""

        taken = 0

        def observe(self, pose):
            self.taken += 1
            view = camera.observe(pose)
            return (
                view
                if self.taken > 2
                else replace(view, depth=np.zeros_like(view.depth))
            )

    result = Session(system.models, system.policy, SPHERE, 9, Stopping(1.0, 5)).run(
        Covered()
    )
    assert len({view.index for view in result.views}) == 5
    np.testing.assert_array_equal(result.views[1].belief, np.full(10, 0.1))
    # the first that counts
    np.testing.assert_allclose(result.views[2].belief, result.views[2].alone, atol=1e-6)
    assert result.answer == "chair"


# Sessions


def view_of(depth, pose) -> Observation:
    return Observation(depth, pose, pinhole(len(depth), 3.0))


def test_nothing_seen_is_no_answer(tiny):
    session = Session(tiny, Unidirectional(SPHERE), SPHERE, 0, Stopping(0.0, 3))
    while not session.done:
        session.update(view_of(np.zeros((32, 32)), session.pose))
    result = session.result
    assert len(result.views) == 3
    assert (result.answer, result.confidence, result.confident, result.seen) == (
        None,
        0.0,
        False,
        False,
    )
    drawn = result.plot(title="air")
    assert any("nothing is seen" in text.get_text() for text in drawn.findobj(Text))
