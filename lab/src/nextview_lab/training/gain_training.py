"""Train the gain policy from predictions, and write its card and its ONNX file."""

from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from nextview.data.progress import TrackProgress, silently
from nextview.errors import ModelError, UsageError
from nextview.files import check_new, command, new_folder, sha256_of
from nextview.policies.base import Policy
from nextview.policies.baselines import Random, RandomAll
from nextview.policies.gain import (
    FEATURES_INPUT,
    Gain,
    GainTable,
    features,
    mirrored,
    mirrored_features,
    origin,
)
from nextview.policies.learned_tables import cells_from
from nextview.policies.policy_card import LearnedFrom, PolicyCard, write_policy_card
from nextview.runtime import open_onnx
from nextview.types import Float, Float32, Floats
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.progress import collected
from nextview_lab.extras import extras
from nextview_lab.training.export import export_onnx
from nextview_lab.training.fitting_set import hold_out, load_sensed
from nextview_lab.training.recipes import GainRecipe
from nextview_lab.training.rollout import (
    Value,
    candidate_values,
    check_inputs,
    fit_travel_weight,
    for_replay,
    judge_all,
    rollout,
)

with extras():
    import torch
    from torch import Tensor, nn

# policies, one per fold, and their mean value
Best = tuple[tuple[Gain, ...], Value]
BOUND = 1e-5
"""Largest allowed difference between the outputs of the file and of the networks in double
precision, relative to the largest output above 1. For gains this is a fiftieth of the lowest travel
weight."""


class Perceptrons(nn.Module):
    """Perceptrons averaged over an object and its mirror image: (B, D) to cells, (B, V)."""

    def __init__(
        self,
        weights: list[Tensor],
        biases: list[Tensor],
        features_flip: NDArray,
        cells_flip: NDArray,
    ) -> None:
        super().__init__()
        self.weights = nn.ParameterList(weights)
        self.biases = nn.ParameterList(biases)
        self.register_buffer("features_flip", torch.as_tensor(features_flip))
        self.register_buffer("cells_flip", torch.as_tensor(cells_flip))

    def each(self, x: Tensor) -> Tensor:
        """Return the outputs of each perceptron, without the mirror image, (E, B, V)."""
        x = x.expand(len(self.weights[0]), *x.shape)
        for i, (weights, bias) in enumerate(
            zip(self.weights, self.biases, strict=True)
        ):
            x = torch.baddbmm(bias, torch.relu(x) if i else x, weights)
        return x

    def forward(self, x: Tensor) -> Tensor:
        return (
            self.each(x) + self.each(x[:, self.features_flip])[..., self.cells_flip]
        ).mean(0) / 2


class RowByRow(nn.Module):
    """``Perceptrons`` as exported: every row is a separate product, (1, in) by (in, out)."""

    def __init__(self, networks: Perceptrons) -> None:
        super().__init__()
        self.networks = networks

    def forward(self, told: Tensor) -> Tensor:
        n = self.networks
        x = torch.stack([told, told[:, n.features_flip]], 1)[:, :, None, None]
        for i, (weights, bias) in enumerate(zip(n.weights, n.biases, strict=True)):
            # The weights are duplicated, as a single perceptron would be one matrix product for
            # all rows.
            x = (
                torch.matmul(
                    torch.relu(x) if i else x,
                    weights.expand(2, *weights.shape),
                )
                + bias
            )
        return (x[:, 0, :, 0] + x[:, 1, :, 0][..., n.cells_flip]).mean(1) / 2


@dataclass(frozen=True)
class Score:
    """The score of a ``Gain``, computed by networks in torch.

    Attributes:
        networks: perceptrons whose mean is the score.
    """

    networks: Perceptrons

    def __call__(self, features: Floats) -> Floats:
        with torch.inference_mode():
            return self.networks(
                torch.from_numpy(features).to(self.networks.weights[0].dtype)
            ).numpy()


def walk(
    data: Predictions,
    policies: list[Policy],
    recipe: GainRecipe,
    rng: np.random.Generator,
) -> list[NDArray]:
    """Collect the states when each policy is followed once over every object.

    Args:
        data: of the objects.
        policies: the policies.
        recipe: of the training.
        rng: source of all random numbers.

    Returns:
        For S states: features, (S, D) float32; value of each choice minus the mean over the free
        ones, (S, V) float32, with cells as in ``policies.learned_tables``; free choices, (S, V)
        bool; and the objects, (S,) int64.
    """
    sphere = data.sphere
    parts = []
    for policy in policies:
        for moment in rollout(
            data,
            policy,
            recipe.max_views - 1,
            rng,
        ):
            state = moment.state
            view = cells_from(sphere)[origin(sphere, state, recipe.frame)]
            value = np.take_along_axis(
                candidate_values(data, moment, recipe.objective),
                view,
                1,
            )
            free = np.take_along_axis(state.free, view, 1)
            mean = (value * free).sum(1, keepdims=True) / np.maximum(
                free.sum(1, keepdims=True),
                1,
            )

            seen = features(sphere, state, recipe.inputs, recipe.frame)
            parts.append(
                (
                    seen.astype(np.float32),
                    (value - mean).astype(np.float32),
                    free,
                    state.episodes,
                )
            )
    return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]


def train(data: Predictions, recipe: GainRecipe, fold: int = 0) -> Iterator[Gain]:
    """Train the networks of one fold.

    Args:
        data: of the objects of the fold.
        recipe: of the training.
        fold: number of the fold, which together with the seed determines all random numbers.

    Yields:
        After every epoch the policy, at travel weight 0 and over all views.
    """
    rng = np.random.default_rng([recipe.seed, fold])
    sphere = data.sphere
    n = len(data)
    c = len(data.classes)
    e = recipe.networks_per_fold

    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    features_flip = mirrored_features(sphere, c, recipe.inputs, recipe.frame)
    widths = list(
        pairwise([len(features_flip), recipe.hidden, recipe.hidden, len(sphere)])
    )
    scales = [(2 / inputs) ** 0.5 for inputs, _ in widths[:-1]] + [0.0]

    first = [
        scale * torch.randn(e, *width, generator=generator)
        for scale, width in zip(scales, widths, strict=True)
    ]
    biases = [torch.zeros(e, 1, outputs) for _, outputs in widths]
    networks = Perceptrons(first, biases, features_flip, mirrored(sphere))

    drawn = rng.multinomial(n, np.full(n, 1 / n), size=e)
    weights = torch.from_numpy(drawn * data.weights).float()
    optimiser = torch.optim.AdamW(
        networks.parameters(),
        recipe.lr,
        weight_decay=recipe.weight_decay,
    )

    batches = -(-recipe.episodes * (recipe.max_views - 1) * n // recipe.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser,
        recipe.lr,
        total_steps=recipe.epochs * batches,
    )
    policies: list[Policy] = [
        (Random, RandomAll)[i % 2](sphere) for i in range(recipe.episodes)
    ]

    for _ in range(recipe.epochs):
        *states, objects = walk(data, policies, recipe, rng)
        for batch in np.array_split(rng.permutation(len(objects)), batches):
            seen, value, free = (torch.from_numpy(values[batch]) for values in states)
            flipped = torch.from_numpy(rng.random(len(batch)) < 0.5)[:, None]
            seen = torch.where(flipped, seen[:, networks.features_flip], seen)
            value, free = (
                torch.where(flipped, a[:, networks.cells_flip], a)
                for a in (value, free)
            )

            error = (((networks.each(seen) - value) ** 2) * free).sum(-1) / free.sum(
                -1
            ).clamp(min=1)
            optimiser.zero_grad()
            ((weights[:, objects[batch]] * error).sum() / len(batch)).backward()
            optimiser.step()
            schedule.step()

        policy = Gain(
            sphere,
            c,
            Score(deepcopy(networks)),
            recipe.inputs,
            frame=recipe.frame,
        )
        policies[::2] = [policy] * len(policies[::2])
        yield policy


def best_epoch(
    folds: Sequence[Iterable[Gain]],
    tables: Sequence[Predictions],
    recipe: GainRecipe,
) -> Iterator[Best]:
    """Run the training of all folds and keep the best epoch.

    Args:
        folds: the trainings, see ``train``.
        tables: the held-out objects of each fold.
        recipe: of the training.

    Yields:
        After every epoch the policies of the best epoch so far, and their mean value over all
        objects.
    """
    best = None
    for policies in zip(*folds, strict=True):
        judged = list(zip(tables, policies, strict=True))
        value = judge_all(
            judged,
            recipe.max_views,
            recipe.objective,
            [recipe.seed, 2],
            rounds=4,
        )
        if best is None or value.mean.mean() > best[1].mean.mean():
            best = policies, value
        yield best


def averaged(policies: Sequence[Gain]) -> Gain:
    """Combine policies into one with the networks of all."""
    networks = [
        policy.score.networks for policy in policies if isinstance(policy.score, Score)
    ]
    weights = [
        torch.cat(layers).detach()
        for layers in zip(*(n.weights for n in networks), strict=True)
    ]
    biases = [
        torch.cat(layers).detach()
        for layers in zip(*(n.biases for n in networks), strict=True)
    ]
    joined = Perceptrons(
        weights,
        biases,
        networks[0].features_flip,
        networks[0].cells_flip,
    )

    return replace(policies[0], score=Score(joined))


def write_gain(card: Path, policy: Gain, about: PolicyCard, features: Float32) -> float:
    """Write a trained policy to NAME.onnx and NAME.json, replacing existing files.

    Args:
        card: path of the card.
        policy: the policy.
        about: content of the card.
        features: states on which the exported network is compared, (S, D) float32.

    Returns:
        Largest difference between the networks in torch and in ONNX.
    """
    assert isinstance(policy.score, Score)
    weights = card.with_suffix(".onnx")
    networks = policy.score.networks
    expected = Score(deepcopy(networks).double())(features.astype(np.float64))

    with new_folder(card.parent, overwrite=True, last=card.name) as part:
        made = part / weights.name
        export_onnx(
            RowByRow(networks),
            features[:2].astype(np.float32),
            FEATURES_INPUT,
            ["cells"],
            made,
            bits=32,
        )

        sha256 = sha256_of(made)
        answers = open_onnx(made, sha256, threads=1).run(
            ["cells"],
            {FEATURES_INPUT: features.astype(np.float32)},
        )[0]

        # the exported file must agree with the trained networks
        difference = float(np.abs(answers - expected).max())
        if not difference <= BOUND * max(1.0, float(np.abs(expected).max())):
            differ = f"differ by {difference:.2g} from the networks'"
            raise ModelError(f"{weights}: ONNX Runtime's answers {differ}; not written")

        table = msgspec.to_builtins(
            GainTable(policy.classes, policy.inputs, policy.travel_weight, policy.frame)
        )
        about = msgspec.structs.replace(
            about,
            sha256=sha256,
            table=table,
            scope=policy.scope,
        )
        write_policy_card(part / card.name, about)
    return difference


@dataclass(frozen=True)
class TrainedGain:
    """A trained and exported gain policy.

    Attributes:
        card: path of its card.
        value: mean objective after 2, 3, ... views at travel weight 0, (views - 1,).
        travel_weight: the chosen weight of travel.
        states: number of states in which the exported file was compared with the networks.
        difference: largest difference of its outputs from those of the networks.
    """

    card: Path
    value: Float
    travel_weight: float
    states: int
    difference: float


def train_gain(
    predictions: Path,
    out: Path,
    folds: int = 20,
    sensed: tuple[Path, ...] = (),
    recipe: GainRecipe = GainRecipe(),
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> TrainedGain:
    """Train the gain policy, which predicts the value of each view.

    An interrupted training starts over.

    Args:
        predictions: predictions of training objects that the recogniser has not seen (nextview-lab
            predict --held-out).
        out: card to write (NAME.json); the networks are written next to it (NAME.onnx).
        folds: number of folds; one policy is trained without each fold and validated on it, and the
            result is the mean of all.
        sensed: predictions of the same objects through sensors (nextview-lab render --sensor mix),
            as additional training data.
        overwrite: replace existing files.

    Raises:
        UsageError, ResultsError: the card is not called NAME.json, or exists.
        PredictionsError: the predictions lack inputs of the recipe, are of the test split or do not
            belong together.
        DatasetError, ModelError: there are too few objects for the folds; or the outputs of the
            ONNX file differ.
    """
    if out.suffix != ".json":
        raise UsageError(f"{out}: the card of a policy is called NAME.json")
    for path in (out, out.with_suffix(".onnx")):
        check_new(path, overwrite)
    learned, validated, about, rng = _load(predictions, sensed, recipe, folds)
    trainings = [train(part, recipe, fold) for fold, part in enumerate(learned)]
    epochs = best_epoch(trainings, validated, recipe)
    policies, value = collected(epochs, recipe.epochs, "training", track)[-1]

    # the lowest weight at which the policy travels no farther than a random walk in the window
    judged = list(zip(validated, policies, strict=True))
    travel_weight = fit_travel_weight(
        judged, recipe.max_views, recipe.objective, recipe.seed
    )
    policy = replace(averaged(policies), travel_weight=travel_weight)
    states = np.concatenate(
        [walk(part, [policy], recipe, rng)[0] for part in validated]
    )
    difference = write_gain(out, policy, about, states)
    return TrainedGain(
        out,
        value.mean,
        travel_weight,
        len(states),
        difference,
    )


def _load(
    predictions: Path,
    sensed: Sequence[Path],
    recipe: GainRecipe,
    folds: int,
) -> tuple[list[Predictions], list[Predictions], PolicyCard, np.random.Generator]:
    """Return what each fold learns from and is validated on, a card without its table, and rng."""
    table = Predictions.load(predictions).deduplicate()
    variants = load_sensed(sensed, table)
    sources = [(predictions, table), *zip(sensed, variants, strict=True)]
    for path, p in sources:
        check_inputs(p, recipe.inputs, recipe.frame, f"{path}: ")
    everything = np.arange(len(table))
    # few objects have one fold each
    folds = min(folds, len(np.unique(table.depth_entropy, axis=0)))
    validating = hold_out(table.labels, table.depth_entropy, folds, recipe.seed)
    learning = [np.setdiff1d(everything, part) for part in validating]
    rng = np.random.default_rng([recipe.seed, 1])
    learned = [for_replay(table, part, rng, variants) for part in learning]
    validated = [for_replay(table, part, rng, variants) for part in validating]
    objects = len(np.unique(np.concatenate(learning)))
    learned_from = f"{objects} objects of the training split"
    if sensed:
        learned_from += ", clean and through sensors"
    about = PolicyCard(
        "gain",
        "global",
        table.sphere.elevations,
        table.sphere.azimuths,
        table.classes,
        {},
        f"{learned_from}, classes weighted evenly; epoch and travel weight chosen on the same, each"
        f" judged by networks of {folds - 1} other folds",
        tuple(LearnedFrom(sha256_of(path), p.models) for path, p in sources),
        tuple(
            (part.calibration.temperature, part.calibration.correlation)
            for part in learned
        ),
        asdict(recipe),
        tuple(
            dict.fromkeys(
                (*(line for _, p in sources for line in p.commands), command())
            )
        ),
    )
    return learned, validated, about, rng
