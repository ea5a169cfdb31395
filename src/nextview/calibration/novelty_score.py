"""Fit a novelty score to the features of known views and of views of made-up objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import minimize
from scipy.special import expit

from nextview.novelty import Novelty, in_half, unit

Float = NDArray[np.floating]

DISTANCE_DIRECTIONS, PERCEPTRON_DIRECTIONS, HIDDEN, DECAY, STEPS = 64, 128, 64, 1e-3, 100
"""Principal components for either part; the perceptron's hidden units, weight decay and steps of L-BFGS."""
NEIGHBOURS = 4500
"""Known views that are kept."""
LEVELS = 201
"""Of the quantiles."""


def fit_novelty(
    known: Float,
    labels: NDArray[np.int64],
    made_up: Float,
    held_out: Float,
    held_out_labels: NDArray[np.int64],
    rng: np.random.Generator,
    n_views: int = 5,
) -> Novelty:
    """A novelty score, standardised and calibrated on objects that the recogniser did not learn.

    Args:
        known: features of views of objects that it learned, (N, F).
        labels: their classes, (N,).
        made_up: features of views of made-up objects, (M, F).
        held_out: features of views of known objects that it did not learn, (objects, views, F), in random order.
        held_out_labels: their classes, (objects,).
        rng: draws first weights, and the known views that are kept.
        n_views: quantiles after 1 to so many views.
    """
    middle, directions, _ = principal_components(known, DISTANCE_DIRECTIONS)
    kept = rng.permutation(len(known))[:NEIGHBOURS]
    neighbours = unit((known[kept] - middle) @ directions)
    hidden, hidden_bias, output, output_bias = fit_perceptron(known, labels, made_up, rng)
    hidden_bias = hidden_bias + middle @ hidden  # of features from which the middle is taken away
    raw = Novelty(
        middle=middle.astype(np.float32),
        directions=_as_stored(directions),
        neighbours=_as_stored(neighbours),
        hidden=_as_stored(hidden),
        hidden_bias=hidden_bias.astype(np.float32),
        output=output.astype(np.float32),
        output_bias=output_bias.astype(np.float32),
        standard=np.array([[0, 1], [0, 1]], np.float32),
        quantiles=np.zeros((1, 2), np.float32),
        objects=np.array([len(held_out)]),
    )
    parts = raw.parts(held_out.reshape(-1, held_out.shape[-1]))
    standard = np.stack([parts.mean(0), parts.std(0)], 1).astype(np.float32)
    ready = replace(raw, standard=standard)
    scores = ready.scores(held_out.reshape(-1, held_out.shape[-1])).reshape(held_out.shape[:2])
    return replace(ready, quantiles=quantiles(scores, held_out_labels, n_views))


def _as_stored(table: Float) -> NDArray[np.float32]:
    """Rounded as ``Novelty.save`` rounds, so that what is calibrated is what is read."""
    return in_half(table).astype(np.float32)


def principal_components(rows: Float, most: int) -> tuple[Float, Float, Float]:
    """Middle (F,), directions (F, D) and variances along these (D,) of the largest components, in descending order."""
    middle = rows.mean(0)
    centred = rows - middle
    f = rows.shape[1]
    variances, directions = eigh(centred.T @ centred / len(rows), subset_by_index=[max(0, f - most), f - 1])
    kept = variances > 1e-6 * variances.max()
    return middle, directions[:, kept][:, ::-1], variances[kept][::-1]


def fit_perceptron(
    known: Float, labels: NDArray[np.int64], made_up: Float, rng: np.random.Generator
) -> tuple[Float, Float, Float, Float]:
    """A perceptron with one hidden layer of tanh that tells made-up objects (above zero) from known ones.

    The classes count the same, and the known objects together as much as the made-up ones. It is learned on the
    standardised principal components, which are then folded into its first layer.

    Returns:
        First layer (F, H) and (H,), second (H,) and (1,), for raw features.
    """
    middle, directions, variances = principal_components(np.concatenate([known, made_up]), PERCEPTRON_DIRECTIONS)
    whiten = directions / np.sqrt(variances)
    rows = ((np.concatenate([known, made_up]) - middle) @ whiten).astype(np.float32)
    truth = np.repeat([0.0, 1.0], [len(known), len(made_up)]).astype(np.float32)
    count = np.bincount(labels)
    weights = np.concatenate([1 / count[labels] / (count > 0).sum(), np.full(len(made_up), 1 / len(made_up))]) / 2
    weights = weights.astype(np.float32)
    d = rows.shape[1]
    cuts = np.cumsum([d * HIDDEN, HIDDEN, HIDDEN])

    def layers(parameters: Float) -> tuple[Float, Float, Float, Float]:
        first, bias, second, last = np.split(parameters, cuts)
        return first.reshape(d, HIDDEN), bias, second, last

    def loss(parameters: Float) -> tuple[float, Float]:
        first, bias, second, last = layers(parameters.astype(np.float32))
        units = np.tanh(rows @ first + bias)
        logit = units @ second + last
        error = weights * (expit(logit) - truth)
        back = error[:, None] * second * (1 - units**2)
        gradient = np.concatenate([(rows.T @ back).ravel(), back.sum(0), units.T @ error, [error.sum()]])
        value = weights @ (np.logaddexp(0, logit) - truth * logit) + DECAY / 2 * parameters @ parameters
        return float(value), gradient.astype(np.float64) + DECAY * parameters

    begin = [rng.normal(size=d * HIDDEN) / np.sqrt(d), np.zeros(HIDDEN), rng.normal(size=HIDDEN) / np.sqrt(HIDDEN), [0]]
    found = minimize(loss, np.concatenate(begin), jac=True, method="L-BFGS-B", options={"maxiter": STEPS})
    first, bias, second, last = layers(found.x)
    folded = whiten @ first
    return folded, bias - middle @ folded, second, last


def quantiles(scores: Float, labels: NDArray[np.int64], n_views: int) -> NDArray[np.float32]:
    """Quantiles of the mean score over 1, 2, ... views, the classes weighted evenly.

    Args:
        scores: of the views of held-out objects, (objects, views), in random order: disjoint runs of them are draws.
        labels: (objects,).
        n_views: at most.

    Returns:
        (views, LEVELS) float32, ascending.
    """
    count = np.bincount(labels)
    each, found = 1 / count[labels], []
    for n in range(1, min(n_views, scores.shape[1]) + 1):
        draws = scores.shape[1] // n
        means = scores[:, : draws * n].reshape(len(scores), draws, n).mean(2)
        order = np.argsort(means, axis=None)
        weight = np.repeat(each, draws)[order]
        share = (np.cumsum(weight) - weight / 2) / weight.sum()
        found.append(np.interp(np.linspace(0, 1, LEVELS), share, means.ravel()[order]))
    return np.array(found, np.float32)
