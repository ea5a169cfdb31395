"""What is fitted to predictions, against generated evidence whose answer is known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from factories import change_card, make_recogniser
from pipeline import some_predictions, train_predictions
from scipy.special import softmax

from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.baselines import Random
from nextview.recognition.belief import PLAIN_SUM, Calibration
from nextview.recognition.inference import NetworkRecogniser
from nextview.recognition.model_card import read_card
from nextview_lab.data.predictions import Predictions
from nextview_lab.training.card_fits import (
    fit_calibration,
    fit_risk,
    fit_temperature,
    loss,
)
from nextview_lab.training.fitting_set import blind_walks
from nextview_lab.training.unknown import fit_novelty

SMALL = ViewSphere((0.0, 30.0, 60.0), 4)


def correlated(
    n: int, correlation: float, temperature: float, seed: int = 0
) -> Predictions:
    """Two classes at -1 and +1, seen through Gaussian noise that is shared in part by all views
    of an object.
    """
    rng, spread = np.random.default_rng(seed), 1.5
    # a mix that the even weights have to undo
    labels = (rng.random(n) < 0.8).astype(np.int64)
    shared, own = rng.normal(size=(n, 1)), rng.normal(size=(n, len(SMALL)))
    seen = (
        2.0 * labels[:, None]
        - 1
        + spread * (np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own)
    )
    logits = np.stack([-((seen - m) ** 2) / (2 * spread**2) for m in (-1, 1)], -1)
    return train_predictions(
        (temperature * logits).astype(np.float32), labels, SMALL, ("minus", "plus")
    )


@pytest.mark.parametrize(
    ("correlation", "temperature"), [(0.0, 1.0), (0.4, 0.5), (0.8, 2.0)]
)
def test_the_correlation_and_temperature_of_generated_looks_are_found(
    correlation, temperature
):
    data = correlated(4000, correlation, temperature)
    found = fit_temperature(data, np.random.default_rng(1), walks=1)
    assert found.temperature == pytest.approx(temperature, rel=0.08)
    assert found.correlation == pytest.approx(correlation, abs=0.06)
    losses = [
        loss(data, c, np.random.default_rng(2), walks=1)
        for c in (found, Calibration(temperature, correlation))
    ]
    assert losses[0] == pytest.approx(losses[1], rel=0.01)
    if correlation:
        assert losses[0] < loss(data, PLAIN_SUM, np.random.default_rng(2), walks=1)


def test_promises_are_kept_as_often_as_promised():
    whole = correlated(40_000, 0.5, 1.0, seed=9)
    even = whole.weights
    calibration, risk, n_views, delta = Calibration(1.0, 0.5), 0.22, 3, 0.2
    starts = np.random.default_rng(0).integers(12, size=len(whole))
    walks = blind_walks(SMALL, Random(SMALL), starts, n_views, np.random.default_rng(1))
    total = np.cumsum(whole.logits[np.arange(len(whole))[:, None], walks], axis=1)
    temperatures = calibration.temperature_after(np.arange(1, n_views + 1))
    sure = softmax(total / temperatures[:, None], axis=2).max(2)
    wrong = total.argmax(2) != whole.labels[:, None]

    def error_at(threshold: float) -> float:
        reached = sure >= threshold
        stopped, first = reached.any(1), reached.argmax(1)
        return np.average(
            wrong[np.arange(len(whole)), first][stopped], weights=even[stopped]
        )

    promises, broken = 0, 0
    for seed in range(60):
        some = np.random.default_rng([5, seed]).choice(len(whole), 300, replace=False)
        part = whole.of_objects(some)
        bounds = fit_risk(
            part, calibration, np.random.default_rng(seed), delta, n_views, walks=1
        )
        # else it promises nothing, and nothing is broken
        if min(bounds.bounds[n_views - 1]) <= risk:
            promises += 1
            broken += error_at(bounds.threshold(risk, n_views)) > risk
    assert promises > 30
    assert broken <= 60 * delta + 3 * np.sqrt(60 * delta * (1 - delta))


# The stages


@pytest.fixture
def training_predictions(tmp_path):
    """A recogniser's card, and predictions of the training split that claim to be its own."""
    card = make_recogniser(tmp_path, ["ball", "box", "pillar"])
    p = some_predictions(90)
    logits = p.logits.copy()
    logits[np.arange(90), :, p.labels] += np.random.default_rng(0).normal(
        0.6, 0.8, (90, 1)
    )
    change_card(card, held_out=list(p.names[:45]))
    models = {**p.models, "recogniser": ("tiny", read_card(card).sha256)}
    path = tmp_path / "training.npz"
    replace(
        p,
        logits=logits.astype(np.float32),
        splits=np.array(["train"] * 90),
        models=models,
    ).save(path)
    return card, path


def test_a_calibration_goes_into_the_card_and_is_used(
    training_predictions, monkeypatch
):
    card, path = training_predictions
    before = json.loads(card.read_text())
    monkeypatch.setattr("sys.argv", ["/bin/nextview-lab", "fit", "calibration", "a b"])
    fitted = fit_calibration(path, card)
    after = json.loads(card.read_text())
    assert {name: after[name] for name in before} == before | {
        "schema": 2
    }  # written anew
    assert after["training"]["commands"] == ["nextview-lab fit calibration 'a b'"]
    assert NetworkRecogniser(card).calibration == fitted.calibration
    assert fitted.after < fitted.before
    assert "45 objects" in after["fitted_to"]["calibration"]
    # no lock, no part is left
    assert [p.name for p in card.parent.iterdir() if p.name.startswith(".")] == []


# Novelty


def test_what_is_fitted_finds_the_strange_and_keeps_the_rate_that_was_asked_for():
    rng, centres = np.random.default_rng(4), 6 * np.eye(3, 12)

    def objects(n, middle, views=5):
        """(n, 2, views, 12): through a sensor, with twice the errors, and without one."""
        errors = np.array([2.0, 1.0])[:, None, None] * rng.normal(
            size=(n, 2, views, 12)
        )
        rows = middle[:, None, None] + rng.normal(size=(n, 1, 1, 12)) * 0.5 + errors
        return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)

    def known(n):
        labels = rng.integers(3, size=n)
        return objects(n, centres[labels]), labels

    learned, _ = known(600)
    score = fit_novelty(learned, *known(400))
    fresh, _ = known(2000)
    strange = objects(500, np.tile(6 * np.eye(12)[7], (500, 1)))
    for n in (1, 3):
        for kind in (0, 1):
            novelty = (
                score.scores(rows[:, kind, :n].reshape(-1, 12), kind == 1)
                .reshape(-1, n)
                .mean(1)
                for rows in (fresh, strange)
            )
            usual, novel = (score.p_value(scores, n) < 0.05 for scores in novelty)
            assert usual.mean() == pytest.approx(0.05, abs=0.03)
            assert novel.mean() > 0.8
