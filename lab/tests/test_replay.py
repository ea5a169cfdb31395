"""Replay against episodes one by one, against a live camera, and what entries and oracles
promise.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from pipeline import some_predictions

from nextview.errors import UsageError
from nextview.geometry.mesh import load_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import Evidence
from nextview.policies.registry import make_policy
from nextview.recognition.belief import Stopping
from nextview.recognition.inference import MapNetwork, Models, NetworkRecogniser
from nextview.recognition.own_stopping import own_stopping
from nextview.session.episode import run_episodes
from nextview.session.session import Session
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.benchmark.replay import make_specs, replay, truncate
from nextview_lab.data.predictions import Predictions


@pytest.fixture(scope="module")
def specs():
    return make_specs(some_predictions(30), runs=4, seed=0)


def evidence_of(predictions: Predictions, objects: np.ndarray):
    def observe(episodes, views):
        rows = objects[episodes]
        logits = predictions.logits[rows, views]
        maps = {"lem": predictions.maps["lem"][rows, views]}
        return Evidence(logits, maps, seen=logits.any(1))

    return observe


@pytest.mark.parametrize(
    ("threshold_decay", "empty"), [(0.0, False), (0.6, False), (1.0, True)]
)
@pytest.mark.parametrize("threshold", [0.0, 0.7, 0.9, 0.99])
@pytest.mark.parametrize("name", ["lem", "lem-peak", "unidirectional"])
def test_a_path_cut_at_a_threshold_is_the_episode_under_that_threshold(
    specs, name, threshold, threshold_decay, empty
):
    """A view in which nothing is seen counts neither for the decay nor as the end, as in live
    use.
    """
    p = specs.predictions
    if empty:
        p = replace(p, logits=np.where(np.arange(40)[:, None] % 2, p.logits, 0))
        specs = replace(specs, predictions=p)
    policy = make_policy(name, p.sphere, specs.valley_classes("lem"))
    stopping = Stopping(threshold, 5, threshold_decay)
    observe, rng = evidence_of(p, specs.objects), np.random.default_rng(0)
    episodes = run_episodes(
        observe, p.sphere, policy, specs.starts, stopping, rng
    ).outcome
    paths = replay(name, specs, max_views=5, seed=0)
    ends = truncate(paths, stopping)
    for field in ("answer", "confidence", "n_views", "confident", "travel", "arc"):
        np.testing.assert_allclose(
            getattr(ends, field), getattr(episodes, field), atol=1e-12, err_msg=field
        )
    taken = np.arange(5) < ends.n_views[:, None]
    np.testing.assert_array_equal(
        np.where(taken, paths.views, -1)[:, : episodes.views.shape[1]], episodes.views
    )


@dataclass(frozen=True)
class Asked:
    """A user's policy: the next view by number."""

    sphere: ViewSphere
    needs: tuple[str, ...] = ()

    def next_views(self, state, rng):
        return (state.current + 1) % len(self.sphere)


class Raises(Asked):
    def next_views(self, state, rng):
        if (state.episodes == 11).any():
            raise RuntimeError("no idea")
        return super().next_views(state, rng)


class ToItsBack:
    """Goes round the ring to where the side opposite to that which the recogniser calls 0 is
    likely to be seen.
    """

    needs = ("azimuth_bins",)

    def __init__(self, sphere):
        self.sphere = sphere

    def next_views(self, state, rng):
        n, rows = self.sphere.azimuths, np.arange(len(state.current))
        # (B, azimuth bins)
        seen = (state.belief[:, :, None] * state.azimuth_bins).sum(1)
        to = (
            self.sphere.azimuth_index[state.current][:, None] + n // 2 - np.arange(n)
        ) % n
        views = self.sphere.ring[state.current][:, None] * n + to
        return views[
            rows, np.where(state.visited[rows[:, None], views], -1.0, seen).argmax(1)
        ]


def settled(seen, threshold):
    """A user's rule: two views have changed no belief by more than the threshold."""
    return np.maximum(seen.change(1), seen.change(2)) <= threshold


@pytest.mark.parametrize("threshold", [0.05, 0.3])
def test_a_rule_about_the_change_of_belief_ends_live_and_replayed_episodes_alike(
    specs, threshold
):
    p, rule = specs.predictions, own_stopping(settled, threshold, 9)
    policy = make_policy("lem", p.sphere, specs.valley_classes("lem"))
    paths = replay("lem", specs, 9, 0, beliefs=True)

    expected = []
    for beliefs in paths.beliefs:
        ends = 9
        for k in range(2, 9):
            moved = (
                abs(beliefs[k] - beliefs[k - 1]).max(),
                abs(beliefs[k] - beliefs[k - 2]).max(),
            )
            if max(moved) <= threshold:
                ends = k + 1
                break
        expected.append(ends)
    assert sum(n < 9 for n in expected) > 0
    np.testing.assert_array_equal(truncate(paths, rule).n_views, expected)

    observe = evidence_of(p, specs.objects)
    rng = np.random.default_rng(0)
    live = run_episodes(observe, p.sphere, policy, specs.starts, rule, rng).outcome
    np.testing.assert_array_equal(live.n_views, expected)
    with pytest.raises(UsageError):
        truncate(replay("lem", specs, 9, 0), rule)


def test_replay_and_a_live_camera_with_the_networks_take_the_same_views(
    furniture, models, predictions
):
    p = Predictions.load(predictions).of_split("test")
    specs = make_specs(p, runs=2, seed=0)
    networks = Models(
        NetworkRecogniser(models / "tiny.json", 1),
        {"lem": MapNetwork(models / "tiny-lem.json", 1)},
    )
    # A threshold that some reach: the middle of all confidences after two views.
    threshold = float(np.median(replay("lem", specs, 2, 0).confidences[:, 1]))
    for name in ("lem", "lem-peak", "unidirectional", "test_replay:ToItsBack"):
        policy = make_policy(name, p.sphere, specs.valley_classes("lem"))
        paths = replay(name, specs, 5, 0)
        stopping = Stopping.of(p.calibration, threshold, max_views=5)
        ends = truncate(paths, stopping)
        for e, (i, start) in enumerate(zip(specs.objects, specs.starts, strict=True)):
            mesh = load_mesh(
                furniture / p.classes[p.labels[i]] / "test" / f"{p.names[i]}.off"
            )
            camera = SimulatedCamera(mesh, 32, p.sphere.distance)
            live = Session(networks, policy, p.sphere, int(start), stopping).run(camera)
            assert [view.index for view in live.views] == paths.views[
                e, : ends.n_views[e]
            ].tolist()
            assert live.answer == p.classes[ends.answer[e]]
            assert live.confident == ends.confident[e]
            # the store rounds
            assert live.confidence == pytest.approx(ends.confidence[e], abs=0.01)
            assert live.travel == pytest.approx(ends.travel[e])
