"""Fits to a whole memory: weight of similarities, linear head for classes, sizes, novelty."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.recognition.belief import (
    Calibration,
    SizeEvidence,
    log_evidence_of,
    of_true_class,
)
from nextview.things.memory import AZIMUTHS, by_ring, similarities
from nextview.types import Float, Float32, Floats, Index, Mask

# log-likelihood per unit of cosine similarity
COSINE_WEIGHTS = (20.0, 30.0, 40.0, 60.0, 90.0)
# correlations of two views, see ``Calibration.bin_correlation``
BIN_CORRELATIONS = (0.1, 0.3, 0.6)
HEADS = (0.0, 5.0, 15.0)  # weights of the head relative to the nearest views
RIDGE = 1.0
# most things whose held-out views are evaluated; more are sampled
MOST_THINGS_JUDGED = 150
DRAWS = 4
VIEWS_FITTED = (1, 2, 3, 5)
FOLDS = 5
QUANTILE_COUNT = 101
SIZE_ERROR = 0.05  # standard deviation of a measured log-radius
NO_LIKENESS = -1e3


@dataclass(frozen=True)
class Fit:
    """Fit to a memory, with the accuracy on held-out views.

    Without features there is nothing to fit, and the last four are empty.

    Attributes:
        weight: weight of the similarity of a view to the stored views.
        correlation: correlation of the evidence of two views.
        head: weights of the linear head on the features.
        head_bias: biases of the head.
        quantiles: quantiles of the novelty score, see ``recognition.novelty.Quantiles``.
        usual: see ``recognition.novelty.Quantiles``.
        accuracy: share of correct answers after each number of views in VIEWS_FITTED.
        confused: pairs that are most often confused: (thing, thing, share).
    """

    weight: float
    correlation: float | None
    head: Floats
    head_bias: Floats
    quantiles: Floats
    usual: Floats
    accuracy: tuple[float, ...]
    confused: tuple[tuple[int, int, float], ...]


def fit_memory(
    views: Floats,
    thing: Index,
    label: Index,
    held_out: Floats,
    held_out_views: Floats,
    radii: Floats,
) -> Fit:
    """Fit to the held-out views of the things by maximum likelihood after 1, 2, 3 and 5 views.

    A thing in a class of several is recognised by the others of its class, in folds over things,
    because a taught class will meet new members. A thing that is a class of its own is recognised
    by its own stored views.

    Args:
        views: stored views, unit vectors, (H, rings, azimuths, F).
        thing: thing of each resting pose, (H,).
        label: class of each thing, ascending, (T,).
        held_out: embeddings of held-out views, (T, K, F).
        held_out_views: their elevations and azimuths, radians, (T, K, 2).
        radii: object radius of each thing, metres, (T,); NaN if unknown.

    Returns:
        The fit.
    """
    views = np.asarray(views, np.float32)
    held_out = np.asarray(held_out, np.float32)
    rng = np.random.default_rng(0)
    several = np.bincount(label)[label] > 1
    judged = np.sort(rng.permutation(len(label))[:MOST_THINGS_JUDGED])
    fold = rng.permutation(len(label)) % FOLDS
    alike = _judged(views, thing, held_out[judged], held_out_views[judged])

    for row, t in enumerate(judged):
        if several[t]:
            alike[row][:, (fold[thing] == fold[t]) & several[thing]] = NO_LIKENESS
    heads, whole = _heads(views, thing, label, several, fold, held_out, judged)
    size = size_evidence(radii, label)
    # as a sensor would measure it
    measured = radii * np.exp(rng.normal(0, SIZE_ERROR, len(radii)))
    sizes = np.float32(0) if size is None else size.logits(measured)[judged, None]

    drawn = np.stack(
        [
            np.stack([rng.permutation(held_out.shape[1]) for _ in range(DRAWS)])
            for _ in judged
        ]
    )
    where = held_out_views[judged]
    of_class = label[thing]
    scored = []

    for h in HEADS if several.any() else (0.0,):
        for w in COSINE_WEIGHTS:
            sums = _sums(w * alike, h * heads + sizes, where, drawn, VIEWS_FITTED)
            scored += [
                (_belief(sums, heads.shape[-1], of_class, c), (w, c, h))
                for c in BIN_CORRELATIONS
            ]

    truth = label[judged]
    loss = [
        -np.mean([of_true_class(logs, truth).mean() for logs in beliefs])
        for beliefs, _ in scored
    ]
    beliefs, (weight, correlation, head) = scored[int(np.argmin(loss))]

    accuracy = tuple(
        float((logs.argmax(-1) == truth[:, None]).mean()) for logs in beliefs
    )
    sums = _sums(
        weight * alike,
        head * heads + sizes,
        where,
        drawn,
        range(1, 1 + max(VIEWS_FITTED)),
    )

    each = _belief(sums, heads.shape[-1], of_class, correlation)
    usual = np.stack([_usual(logs, truth) for logs in each])
    scores = [
        -logs.max(-1) - own[logs.argmax(-1)]
        for logs, own in zip(each, usual, strict=True)
    ]
    quantiles = np.quantile(scores, np.linspace(0, 1, QUANTILE_COUNT), axis=(1, 2)).T
    confused = _confused(beliefs[1], truth, judged, label)

    return Fit(
        weight,
        correlation,
        head * whole[0],
        head * whole[1],
        quantiles,
        usual,
        accuracy,
        confused,
    )


def fit_without_features(classes: int) -> Fit:
    """Placeholder fit of a memory without features.

    Args:
        classes: number of classes.

    Returns:
        A fit with neutral values.
    """
    nothing = np.zeros(0)
    return Fit(
        1.0,
        None,
        np.zeros((0, classes), np.float32),
        np.zeros(classes, np.float32),
        quantiles=nothing,
        usual=nothing,
        accuracy=(),
        confused=(),
    )


def _usual(logs: Floats, truth: Index) -> Floats:
    """Usual excess novelty of each class, (C,), from log-beliefs, (T, draws, C); 0 if unknown.

    It is half the observed excess, because eight views through one setup of a sensor do not support
    more.
    """
    scores = -logs.max(-1)
    found = np.zeros(logs.shape[-1])
    for c in np.unique(truth):
        found[c] = (scores[truth == c].mean() - scores.mean()) / 2
    return found


def _judged(views: Floats, thing: Index, held_out: Floats, where: Floats) -> Float32:
    """Similarity of each held-out view to each resting pose and azimuth, (T, K, H, azimuths)."""
    flat = similarities(
        by_ring(views),
        held_out.reshape(-1, held_out.shape[-1]),
        where[..., 0].ravel(),
    )
    return flat.reshape(*held_out.shape[:2], len(thing), AZIMUTHS)


def _heads(
    views: Floats,
    thing: Index,
    label: Index,
    several: Mask,
    fold: Index,
    held_out: Floats,
    judged: Index,
) -> tuple[Float32, tuple[Floats, Floats]]:
    """Logits of held-out views by heads that were fitted without the thing, (T, K, C).

    The head of all things is returned as well.
    """
    classes = int(label.max()) + 1
    f = views.shape[-1]
    found = np.zeros((len(judged), held_out.shape[1], classes), np.float32)
    if not several.any():
        return found, (
            np.zeros((f, classes), np.float32),
            np.zeros(classes, np.float32),
        )

    x = views[:, :, ::4].reshape(len(thing), -1, f)
    y = label[thing]

    for k in range(FOLDS):
        others = (fold[thing] != k) | ~several[thing]
        weights, bias = _ridge(x[others], y[others], classes)
        own = fold[judged] == k
        found[own] = held_out[judged][own] @ weights + bias

    return found, _ridge(x, y, classes)


def _ridge(x: Floats, y: Index, classes: int) -> tuple[Floats, Floats]:
    """Fit ridge regression from views, (H, n, F), to one-hot classes, (H,).

    All classes have equal weight.
    """
    h, n, f = x.shape
    rows = x.reshape(h * n, f)
    target = np.repeat(np.eye(classes, dtype=np.float32)[y], n, 0)
    weight = np.repeat(
        1 / np.maximum(np.bincount(y, minlength=classes), 1)[y] / n,
        n,
    ).astype(np.float32)[:, None]
    middle = (weight * rows).sum(0) / weight.sum()
    centred = rows - middle
    gram = centred.T @ (weight * centred) + RIDGE * 0.01 * np.eye(f, dtype=np.float32)
    found = np.linalg.solve(gram, centred.T @ (weight * (target - 1 / classes)))
    return found.astype(np.float32), (-middle @ found).astype(np.float32)


def _sums(
    alike: Floats,
    logits: Floats,
    where: Floats,
    drawn: Index,
    after: Sequence[int],
) -> dict[int, Floats]:
    """Sums of log-evidence ``after`` some numbers of drawn views, (T, draws, ...) each."""
    total = [
        log_evidence_of(x, a, z)
        for x, a, z in zip(logits, alike, where[..., 1], strict=True)
    ]
    return {
        k: np.stack([t[d[:, :k]].sum(1) for t, d in zip(total, drawn, strict=True)])
        for k in after
    }


def _belief(
    sums: dict[int, Floats],
    classes: int,
    hypotheses: Index,
    correlation: float,
) -> list[Float]:
    """Log-belief from sums of log-evidence, (T, draws, classes), up to a constant."""
    calibration = Calibration(1.0, 1.0, None, correlation, tuple(hypotheses.tolist()))
    return [calibration.log_belief(total, k, classes) for k, total in sums.items()]


def _confused(
    logs: Floats,
    truth: Index,
    judged: Index,
    label: Index,
) -> tuple[tuple[int, int, float], ...]:
    """Pairs of things by the frequency of their confusion, worst first."""
    answers = logs.argmax(-1)
    pairs = dict[tuple[int, int], float]()
    first = {int(c): int(np.flatnonzero(label == c)[0]) for c in np.unique(label)}
    for row, t in enumerate(judged):
        for answer in answers[row][answers[row] != truth[row]]:
            other = first[int(answer)]
            pair = min(int(t), other), max(int(t), other)
            pairs[pair] = pairs.get(pair, 0) + 0.5 / answers.shape[1]
    return tuple(
        (a, b, share)
        for (a, b), share in sorted(pairs.items(), key=lambda item: -item[1])
    )


def size_evidence(radii: Floats, label: Index) -> SizeEvidence | None:
    """Likelihood of each size for the things of each class.

    Each thing of a class adds a normal distribution of the log-radius, and a wide one with a tenth
    of the weight, because half-hidden things appear smaller. A class without known sizes has no
    evidence.

    Args:
        radii: radii of the things, metres, (T,); NaN if unknown.
        label: class of each thing, (T,) int64.

    Returns:
        The evidence from size; None if no size is known.
    """
    known = np.isfinite(radii)
    if not known.any():
        return None
    low = np.log(radii[known].min()) - 0.7
    high = np.log(radii[known].max()) + 0.7
    grid = np.linspace(low, high, int((high - low) / 0.03) + 2)
    density = np.zeros((int(label.max()) + 1, len(grid)))

    for c in range(len(density)):
        own = np.log(radii[known & (label == c)])
        # The sizes in a class differ, and fewer known things require a wider distribution.
        wide = SIZE_ERROR
        if (label == c).sum() > 1:
            wide = max(SIZE_ERROR, 0.5 * own.std() if len(own) > 1 else 0.3)
        if len(own):
            off = (grid[:, None] - own) / wide
            density[c] = np.log(
                (0.9 * np.exp(-(off**2) / 2) + 0.1 / 4 * np.exp(-(off**2) / 32)).mean(1)
                / wide
                + 1e-9
            )
    # the best size of all classes has log-likelihood 0, so sizes only count against a class
    density -= density.max()
    density[~np.isin(np.arange(len(density)), label[known])] = 0
    # rounded, because people read cards, too
    short = np.array([float(f"{radius:.5g}") for radius in np.exp(grid)])
    return SizeEvidence.from_arrays(short, np.round(density, 3), 1.0)
