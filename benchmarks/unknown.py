"""How well the recogniser tells objects of no class that it knows from those of its classes.

    nextview render data/ModelNet10 views.zarr
    nextview render data/PSB unseen.zarr
    python -m benchmarks.unknown views.zarr unseen.zarr [--split test]

The classes of the second store must not be among the recogniser's. Prints, after one, two, three
and five random views, the area under the ROC curve of the novelty score, the share of known objects
that are taken for unknown at the rates that were asked for (calibrated on held-out training
objects), the share of unknown ones that are caught, and what each unknown class that is seldom
caught is taken for. In brackets: 95 % of the bootstrap over objects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.benchmark.statistics import interval, resample
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.data.store import ViewStore
from nextview.recognition.belief import log_evidence_of
from nextview.recognition.inference import Features, NetworkRecogniser
from nextview.recognition.model_card import RECOGNISER
from nextview.recognition.network_input import from_store

VIEWS = (1, 2, 3, 5)
RATES = (0.01, 0.05, 0.1)
HARD = 0.95


@dataclass(frozen=True)
class Judged:
    """What the recogniser gives for some views of N objects, in random order.

    Attributes:
        labels: classes, (N,) strings.
        scores: novelty, (N, views).
        evidence: that can be summed over views, (N, views, D).
    """

    labels: NDArray[np.str_]
    scores: NDArray[np.float64]
    evidence: NDArray[np.float64]

    def after(self, n_views: int) -> NDArray[np.float64]:
        """Mean scores over disjoint runs of so many views, (N, runs)."""
        runs = self.scores.shape[1] // n_views
        return (
            self.scores[:, : runs * n_views]
            .reshape(len(self.scores), runs, n_views)
            .mean(2)
        )


def judge(
    store: Path,
    split: str | None,
    objects: int | None,
    recogniser: NetworkRecogniser,
    seed: int,
) -> Judged:
    views = ViewStore.open(store)
    rng = np.random.default_rng(seed)
    chosen = np.flatnonzero(views.done & ((views.splits == split) if split else True))
    chosen = np.sort(rng.permutation(chosen)[:objects])
    drawn = np.array(
        [rng.permutation(len(views.sphere))[: 2 * max(VIEWS)] for _ in chosen]
    )
    scores = []
    evidence = []
    features = Features()
    exact = views.attributes.sensor is None

    def work() -> Iterator[int]:
        for k, i in enumerate(chosen):
            inputs = from_store(recogniser.card.input, views, int(i), drawn[k])
            found = recogniser.from_inputs(inputs)
            known = features.card.input == recogniser.card.input
            seen = features(
                inputs
                if known
                else from_store(features.card.input, views, int(i), drawn[k])
            )
            scores.append(recogniser.novelty.scores(seen, exact))
            evidence.append(
                log_evidence_of(
                    found.logits,
                    found.azimuth_bins,
                    views.sphere.azimuth[drawn[k]],
                )
            )
            yield k + 1

    track(work(), len(chosen), f"views of {views.path.name}")
    labels = np.array([views.classes[label] for label in views.labels[chosen]])
    return Judged(labels, np.array(scores), np.array(evidence, np.float64))


def roc_area(
    known: NDArray,
    unknown: NDArray,
    of_known: NDArray,
    of_unknown: NDArray,
) -> float:
    """Area under the ROC curve: how often an unknown object scores higher than a known one, equal
    scores half.

    Args:
        known, unknown: scores, (N, draws) and (M, draws).
        of_known, of_unknown: weights of the objects, (N,) and (M,).
    """
    k = known.ravel()
    u = unknown.ravel()
    weights = np.repeat(of_known, known.shape[1])
    order = np.argsort(k)
    below = np.r_[0, np.cumsum(weights[order])]
    at = (
        below[np.searchsorted(k[order], u, "left")]
        + below[np.searchsorted(k[order], u, "right")]
    ) / 2
    of_each = np.repeat(of_unknown, unknown.shape[1])
    return float(at @ of_each / weights.sum() / of_each.sum())


def main(
    known: tyro.conf.Positional[Path],
    unknown: tyro.conf.Positional[Path],
    split: str = "test",
    objects: int | None = None,
    recogniser: str = RECOGNISER,
    samples: int = 1000,
    seed: int = 0,
) -> None:
    """Print the tables, for a store of known objects, and one of objects of no known class."""
    network = NetworkRecogniser(recogniser)
    if network.novelty is None:
        raise SystemExit(
            f"{recogniser} cannot tell unknown objects; nextview fit unknown teaches it"
        )
    ours = judge(known, split, None, network, seed)
    others = judge(unknown, None, objects, network, seed)
    print(
        f"{len(ours.labels)} known objects, {len(others.labels)} of {len(set(others.labels))}"
        " unknown classes\n"
    )
    rng = np.random.default_rng(seed)
    of_ours, of_others = (
        resample(len(each.labels), samples, rng) for each in (ours, others)
    )
    ones = np.ones(len(ours.labels)), np.ones(len(others.labels))

    def spread(values: list[float]) -> str:
        (low,), (high,) = interval(np.array(values)[:, None])
        return f"({low:.3f}-{high:.3f})"

    print(
        "| views | ROC area | known rejected, unknown caught at "
        + " | at ".join(f"{r:.0%}" for r in RATES)
        + " |"
    )
    print("|---|---|" + "---|" * len(RATES))
    for n in VIEWS:
        a = ours.after(n)
        b = others.after(n)
        area = roc_area(a, b, *ones)
        drawn = [roc_area(a, b, v, w) for v, w in zip(of_ours, of_others, strict=True)]
        cells = [f"{area:.3f} {spread(drawn)}"]
        for rate in RATES:
            shares = []
            for scores, weights in ((a, of_ours), (b, of_others)):
                flagged = (network.novelty.p_value(scores, n) < rate).mean(1)
                shares.append(
                    f"{flagged.mean():.3f} {spread(list((weights @ flagged) / weights.sum(1)))}"
                )
            cells.append(", ".join(shares))
        print(f"| {n} | " + " | ".join(cells) + " |")

    def answers(judged: Judged, n: int) -> NDArray[np.int64]:
        classes = len(network.classes)
        return network.calibration.log_belief(
            judged.evidence[:, :n].sum(1),
            n,
            classes,
        ).argmax(1)

    caught = {
        n: network.novelty.p_value(others.scores[:, :n].mean(1), n) < 0.05
        for n in (1, 3)
    }
    taken = answers(others, 3)
    print(f"\nUnknown classes of which less than {HARD:.0%} are caught after 3 views:")
    print(
        "\n| unknown class | objects | caught after 1 view | after 3 | most like, after 3"
        " |\n|---|---|---|---|---|"
    )
    classes = ((label, others.labels == label) for label in sorted(set(others.labels)))
    for label, here in (
        (label, here) for label, here in classes if caught[3][here].mean() < HARD
    ):
        most = Counter(network.classes[c] for c in taken[here]).most_common(3)
        named = ", ".join(f"{name} {count}" for name, count in most)
        print(
            f"| {label} | {here.sum()} | {caught[1][here].mean():.2f} |"
            f" {caught[3][here].mean():.2f} | {named} |"
        )
    right = answers(ours, 3) == np.array(
        [network.classes.index(label) for label in ours.labels]
    )
    kept = network.novelty.p_value(ours.scores[:, :3].mean(1), 3) >= 0.05
    print(
        f"\nknown objects after 3 views: right {right.mean():.3f}; of those not taken for unknown"
        f" at 5 %, {right[kept].mean():.3f}; of those taken for unknown, {right[~kept].mean():.3f}"
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
