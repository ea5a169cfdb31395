"""Training of the gain policy: networks regress the value of every choice, which the predictions know.

States come from random walks and from the networks' own. Several networks, each of which weighs the objects by a
bootstrap draw of its own, are averaged: the highest of many noisy estimates is too high by chance, and less so if it
is a mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from nextview.calibration.rollout import ReplayTable, Value, candidate_values, judge, mean_value, rollout
from nextview.policies.base import Policy
from nextview.policies.baselines import Random, RandomAll
from nextview.policies.gain import VISIBILITY, Gain, features, mirrored, mirrored_features, origin
from nextview.policies.learned_tables import cells_from
from nextview.training.gain.perceptrons import Layers, Perceptrons
from nextview.training.recipes import GainRecipe

Float = NDArray[np.float64]


@dataclass(frozen=True)
class States:
    """S states on walks, and what each choice would lead to; cells as in ``policies.tables``.

    Attributes:
        features: to the networks, (S, D).
        values: of a view of each cell, less the mean over the free ones, (S, V).
        free: whether the cell is unvisited and can be reached, (S, V) bool.
        objects: rows of the fitting set, (S,).
    """

    features: NDArray[np.float32]
    values: NDArray[np.float32]
    free: NDArray[np.bool_]
    objects: NDArray[np.int64]


def walk(table: ReplayTable, policies: list[Policy], recipe: GainRecipe, rng: np.random.Generator) -> States:
    """The states met when each of the policies is followed once over every object."""
    sphere, parts = table.data.sphere, []
    for policy in policies:
        for moment in rollout(table, policy, recipe.n_views - 1, rng, VISIBILITY in recipe.inputs):
            state = moment.state
            view = cells_from(sphere)[origin(sphere, state, recipe.frame)]
            value = np.take_along_axis(candidate_values(table, moment, recipe.objective), view, 1)
            free = np.take_along_axis(state.free, view, 1)
            mean = (value * free).sum(1, keepdims=True) / np.maximum(free.sum(1, keepdims=True), 1)
            seen = features(sphere, state, recipe.inputs, recipe.frame)
            parts.append((seen.astype(np.float32), (value - mean).astype(np.float32), free, state.episodes))
    return States(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class Networks(nn.Module):
    """Several perceptrons side by side: weights (E, in, out), biases (E, 1, out)."""

    def __init__(self, widths: list[int], networks: int, generator: torch.Generator) -> None:
        super().__init__()
        pairs = list(pairwise(widths))
        last = len(pairs) - 1
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for i, (a, b) in enumerate(pairs):
            scale = 0.0 if i == last else (2 / a) ** 0.5
            self.weights.append(nn.Parameter(scale * torch.randn(networks, a, b, generator=generator)))
            self.biases.append(nn.Parameter(torch.zeros(networks, 1, b)))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x.expand(len(self.weights[0]), *x.shape)
        for i, (weights, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, torch.relu(x) if i else x, weights)
        return x

    def layers(self) -> tuple[Layers, ...]:
        """As ``Perceptrons`` wants them, float32."""
        weights, biases = ([p.detach().numpy().copy() for p in part] for part in (self.weights, self.biases))
        chains = range(len(weights[0]))
        return tuple(tuple((w[e], b[e, 0]) for w, b in zip(weights, biases, strict=True)) for e in chains)


def train(table: ReplayTable, recipe: GainRecipe, fold: int = 0) -> Iterator[Gain]:
    """Train the networks.

    Args:
        table: what is learned from.
        recipe: how.
        fold: makes for other draws than those of other folds.

    Yields:
        After every epoch, the policy as it then is, at travel weight 0 and over all views.
    """
    rng, data = np.random.default_rng([recipe.seed, fold]), table.data
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    sphere, c = data.sphere, len(data.classes)
    flip = torch.from_numpy(mirrored_features(sphere, c, recipe.inputs, recipe.frame))
    cells_flip = torch.from_numpy(mirrored(sphere))
    widths = [len(flip), recipe.hidden, recipe.hidden, len(sphere)]
    networks = Networks(widths, recipe.networks, generator)
    drawn = rng.multinomial(len(data), np.full(len(data), 1 / len(data)), size=recipe.networks)
    weights = torch.from_numpy(drawn * data.weights).float()
    optimiser = torch.optim.AdamW(networks.parameters(), recipe.lr, weight_decay=recipe.weight_decay)
    states_each = recipe.walks * (recipe.n_views - 1) * len(data)
    steps = recipe.epochs * -(-states_each // recipe.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, recipe.lr, total_steps=steps)
    policy: Policy = RandomAll(sphere)
    for _ in range(recipe.epochs):
        blind: list[Policy] = [Random(sphere), RandomAll(sphere)]
        policies = [blind[i % 2] for i in range(recipe.walks)]
        if isinstance(policy, Gain):
            policies[::2] = [policy] * len(policies[::2])
        states = walk(table, policies, recipe, rng)
        order = rng.permutation(len(states.objects))
        for batch in np.array_split(order, -(-states_each // recipe.batch)):
            seen, value, free = (torch.from_numpy(a[batch]) for a in (states.features, states.values, states.free))
            turned = torch.from_numpy(rng.random(len(batch)) < 0.5)[:, None]
            seen = torch.where(turned, seen[:, flip], seen)
            value, free = (torch.where(turned, a[:, cells_flip], a) for a in (value, free))
            error = (((networks(seen) - value) ** 2) * free).sum(-1) / free.sum(-1).clamp(min=1)
            loss = (weights[:, states.objects[batch]] * error).sum() / len(batch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        score = Perceptrons.of(sphere, c, recipe.inputs, networks.layers(), recipe.frame)
        policy = Gain(sphere, c, score, recipe.inputs, frame=recipe.frame)
        yield policy


def best_epoch(
    folds: Sequence[Iterable[Gain]], tables: Sequence[ReplayTable], recipe: GainRecipe
) -> Iterator[tuple[tuple[Gain, ...], Value]]:
    """After every epoch, the policies of the best epoch so far by their objective over 2 to ``recipe.n_views`` views.

    Args:
        folds: trainings side by side, each a policy an epoch.
        tables: by which they are judged, one each: of objects that it was not trained on.
        recipe: how.

    Yields:
        The policies of the same epoch, and their worth, a mean over all objects.
    """
    best = None
    for policies in zip(*folds, strict=True):
        values = [
            judge(table, policy, recipe.n_views, recipe.objective, np.random.default_rng([recipe.seed, 2]), rounds=4)
            for table, policy in zip(tables, policies, strict=True)
        ]
        value = mean_value(values, [len(table.data) for table in tables])
        if best is None or value.mean.mean() > best[1].mean.mean():
            best = policies, value
        yield best


def averaged(policies: Sequence[Gain]) -> Gain:
    """One policy whose networks are those of all."""
    scores = [policy.score for policy in policies if isinstance(policy.score, Perceptrons)]
    return replace(
        policies[0], score=replace(scores[0], networks=tuple(net for score in scores for net in score.networks))
    )
