"""How the bundled models are trained. No torch here, so that the command line can show them.

A recipe that makes no sense is refused when it is made, with a ``UsageError`` that names the option.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from nextview.arguments import as_line, number, of_kind, whole
from nextview.errors import UsageError

POLICY_INPUTS = ("belief", "view", "place", "lem-sphere", "azimuth_bin")
"""What the network of a policy is told by default; see ``policies.gain.INPUTS``."""

MOST = {
    "size": 4096,
    "epochs": 1_000_000,
    "views": 10_000,
    "batch": 1_000_000,
    "points": 1024,  # cloud.POINTS, which takes SciPy to import: all that a cloud has
    "hidden": 65_536,
    "networks": 1000,
    "walks": 10_000,
    "n_views": 10_000,
    "envs": 1_000_000,
    "rollout": 1_000_000,
    "updates": 100_000,
    "evaluations": 100_000,
    "holdout": 1000,
    "seed": 2**32 - 1,
    "ensemble_seed": 2**32 - 1,
    "lr": 100,
    "sharpness": 1e6,
}
"""Of options: with more, nothing is learned, and memory or time has no end. All other numbers are below a million,
or a million million where they are whole."""


def _check_types(recipe: Any) -> None:
    """See that each option of a recipe is of the type that it is declared with, and not too large."""
    declared = get_type_hints(type(recipe))
    for field in fields(recipe):
        value, kind, option = getattr(recipe, field.name), declared[field.name], _option(field.name)
        if kind is bool:
            of_kind(value, bool, f"{option} is true or false")
        elif kind is int:
            whole(value, option, 0, int(MOST.get(field.name, 10**12)))
        elif kind is float:
            if abs(number(value, option)) > MOST.get(field.name, 1e6):
                raise UsageError(f"{option} is a number of at most {MOST.get(field.name, 1e6):g}, not {value}")
        elif kind is str:
            of_kind(value, str, f"{option} is a name")
        elif get_origin(kind) is Literal:
            if not isinstance(value, str | int) or value not in get_args(kind):
                raise UsageError(f"{option} is {', '.join(map(str, get_args(kind)))}, not {as_line(value)}")
        else:
            of_kind(value, tuple | list, f"{option} are several")


def _at_least(least: int, **options: float) -> None:
    for name, value in options.items():
        if not least <= value:
            raise UsageError(f"{_option(name)} is at least {least}, not {value}")


def _share(**options: float) -> None:
    for name, value in options.items():
        if not 0 <= value < 1:
            raise UsageError(f"{_option(name)} is 0 or more and less than 1, not {value}")


def _check_inputs(inputs: tuple[str, ...]) -> None:
    """See that there are some. Which maps there are, only the predictions know."""
    if not inputs:
        raise UsageError("--inputs names at least one input of the networks")
    for name in inputs:
        of_kind(name, str, "--inputs are names")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


@dataclass(frozen=True)
class RecogniserRecipe:
    """How the recogniser is trained.

    Attributes:
        network: a ResNet, or EfficientNet-Lite0, which has a fifth of the arithmetic of a ResNet-18.
        depth: ResNet-18, -34, -50, -101 or -152.
        dropout: of EfficientNet-Lite0: chance that a pooled feature is dropped; the chance that a block is skipped for
            a view rises from 0 at the first towards it at the last.
        size: side of the input image, pixels.
        epochs: passes over the training objects.
        views: views of each object in one epoch, drawn at random.
        batch: views a step.
        lr: peak learning rate of AdamW under a one-cycle schedule.
        weight_decay: of AdamW.
        smoothing: label smoothing.
        azimuth_bins_weight: weight of the loss for the azimuth bin from which the object is seen, a cross-entropy,
            beside that of its class; 0 does without. The objects of a class have to stand alike in their files, as
            ModelNet10's do.
        validation: part of the training split held out for validation.
        deformed_share: chance that a view is drawn from the deformed objects, where such a store is given.
        seed: decides everything random.
        ensemble_seed: which network of an ensemble this is: the seed's objects validate all of them, but each has first
            weights and draws of its own.
        input: what the network sees: the geometry that a depth camera sees, or the shaded image.
        augment: whether what is seen is varied; see ``recogniser.augment``.
        balanced: whether rare classes are drawn more often; otherwise every view comes once before any comes again.
        schedule: of the learning rate: up and down once, or halved every fifth epoch from the peak.
        patience: stop after so many epochs without a better class mean on validation; 0 never stops early.
        way: in the end, how much of the way the parameters go from those that training began with to those it found.
            Less than 1 keeps more of what a network knew before it went on (Wortsman et al., "Robust fine-tuning of
            zero-shot models", CVPR 2022).
    """

    network: Literal["resnet", "lite0"] = "resnet"
    depth: Literal[18, 34, 50, 101, 152] = 18
    dropout: float = 0.0
    size: int = 112
    epochs: int = 12
    views: int = 8
    batch: int = 64
    lr: float = 2e-3
    weight_decay: float = 0.05
    smoothing: float = 0.1
    azimuth_bins_weight: float = 0.0
    validation: float = 0.1
    deformed_share: float = 0.5
    seed: int = 0
    ensemble_seed: int = 0
    input: Literal["geometry", "image"] = "geometry"
    augment: bool = True
    balanced: bool = True
    schedule: Literal["one-cycle", "halving"] = "one-cycle"
    patience: int = 0
    way: float = 1.0

    def __post_init__(self) -> None:
        _check_types(self)
        if self.network != "resnet" and self.depth != RecogniserRecipe.depth:
            raise UsageError(f"only a ResNet has a --depth: {self.network} is as deep as it is")
        if self.network == "resnet" and self.dropout:
            raise UsageError("only EfficientNet-Lite0 drops features and blocks: leave --dropout, or take lite0")
        _at_least(1, size=self.size, epochs=self.epochs, views=self.views, batch=self.batch)
        _at_least(0, lr=self.lr, weight_decay=self.weight_decay, azimuth_bins_weight=self.azimuth_bins_weight)
        _at_least(0, seed=self.seed, ensemble_seed=self.ensemble_seed, patience=self.patience)
        _share(dropout=self.dropout, smoothing=self.smoothing, validation=self.validation)
        if not 0 <= self.deformed_share <= 1:
            raise UsageError(f"--deformed-share is a chance, from 0 to 1, not {self.deformed_share}")
        if not 0 < self.way <= 1:
            raise UsageError(f"--way is more than 0 and at most 1, not {self.way}")


THESIS_RECOGNISER = RecogniserRecipe(
    depth=34,
    size=224,
    epochs=15,
    views=40,
    batch=32,
    lr=1e-3,
    weight_decay=0.0,
    smoothing=0.0,
    deformed_share=0.0,
    input="image",
    augment=False,
    balanced=False,
    schedule="halving",
)
"""As published (thesis, section 5.1): Adam, 1e-3 halved every fifth epoch, batches of 32, the shaded image of 224
pixels, every view once an epoch, cross-entropy and nothing else. The text does not say for how many epochs; its map
networks settle around the tenth (section 6.2.2). It names no validation part either: ours is kept from the training
split."""


@dataclass(frozen=True)
class MapRecipe:
    """How a map network is trained.

    Attributes:
        measure: of views, whose map it predicts: one that the store holds (nextview measure), or "confidence", the
            recogniser's where it is right, which takes predictions.
        input: what the network sees: the view as the recogniser does, geometry, through a ResNet; or the partial cloud,
            through a PointNet, as published.
        depth: of the ResNet.
        size: side of the ResNet's input image, pixels.
        points: drawn from each cloud in training; validation and use take all 1,024.
        output: what the network predicts: the local window alone, or all views of the sphere, of which the window is a
            part; the others are of use to policies that look farther.
        epochs: passes over the training objects.
        views: views of each object in one epoch, drawn at random.
        batch: views a step.
        lr: peak learning rate of Adam.
        weight_decay: of AdamW.
        regular: weight of the orthogonality terms of the PointNet's transforms.
        peak: weight of the cross-entropy of which cell of the window is the highest, beside the squared error, which
            cares for all cells alike; values are taken over ``sharpness`` for log-odds.
        sharpness: see ``peak``.
        reach: 0 if only the highest cell itself counts for ``peak``, 1 if its neighbours above, below, left and right
            do as well: what is within one cell.
        mirror: whether left and right are exchanged in half of the views, in the map too.
        schedule: of the learning rate: up and down once, or a tenth every fifth epoch from the peak.
        validation: part of the training split held out for validation.
        seed: decides everything random.
        patience: stop after so many epochs without a lower squared error on validation; 0 never stops early.
    """

    measure: str = "depth_entropy"
    input: Literal["geometry", "cloud"] = "geometry"
    depth: Literal[18, 34, 50, 101, 152] = 18
    size: int = 56
    points: int = 256
    output: Literal["window", "sphere"] = "sphere"
    epochs: int = 8
    views: int = 12
    batch: int = 64
    lr: float = 2e-3
    weight_decay: float = 0.05
    regular: float = 1e-4
    peak: float = 0.0
    sharpness: float = 0.05
    reach: int = 0
    mirror: bool = True
    schedule: Literal["one-cycle", "tenth"] = "one-cycle"
    validation: float = 0.1
    seed: int = 0
    patience: int = 0

    def __post_init__(self) -> None:
        _check_types(self)
        _at_least(1, size=self.size, points=self.points, epochs=self.epochs, views=self.views, batch=self.batch)
        _at_least(0, lr=self.lr, weight_decay=self.weight_decay, regular=self.regular, peak=self.peak)
        _at_least(0, reach=self.reach, seed=self.seed, patience=self.patience)
        _share(validation=self.validation)
        if not self.sharpness > 0:
            raise UsageError(f"--sharpness is more than 0, not {self.sharpness}")


THESIS_MAP = MapRecipe(
    input="cloud",
    points=1024,
    output="window",
    epochs=15,
    views=40,
    batch=16,
    lr=1e-3,
    weight_decay=0.0,
    mirror=False,
    schedule="tenth",
)
"""As published (thesis, sections 2.2.3 and 5.1): PointNet, Adam, 1e-3 and a tenth of it every fifth epoch, batches of
16, every view once an epoch. The text does not say for how many epochs."""


@dataclass(frozen=True)
class GainRecipe:
    """How the gain policy is trained.

    Attributes:
        inputs: of the networks: belief, view, place, azimuth_bin (see ``policies.gain.INPUTS``) and any maps of the
            predictions; in worlds visibility too, the share of the object that is expected to show from each view.
        frame: from where azimuths are counted: from the camera's, or from the one at which the object is believed to
            show its azimuth bin 0, which takes a recogniser that was taught the azimuth bins.
        objective: what a view is valued by: the belief in the true class after it, its logarithm, or whether the answer
            is right.
        n_views: the values of views 2 to this one are learned.
        hidden: width of the two hidden layers.
        networks: that are averaged, of each fold; each weighs the objects by a bootstrap draw of its own.
        epochs: each over new walks of all objects.
        walks: of each object in an epoch.
        batch: states in a step.
        lr: AdamW's learning rate at its peak (one-cycle).
        weight_decay: AdamW's.
        seed: of everything random.
    """

    inputs: tuple[str, ...] = POLICY_INPUTS
    frame: Literal["camera", "object"] = "object"
    objective: Literal["belief", "log-belief", "right"] = "log-belief"
    n_views: int = 5
    hidden: int = 32
    networks: int = 2
    epochs: int = 15
    walks: int = 8
    batch: int = 1024
    lr: float = 3e-3
    weight_decay: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        _check_types(self)
        _check_inputs(self.inputs)
        _at_least(2, n_views=self.n_views)
        _at_least(1, hidden=self.hidden, networks=self.networks, epochs=self.epochs, walks=self.walks, batch=self.batch)
        _at_least(0, lr=self.lr, weight_decay=self.weight_decay, seed=self.seed)


@dataclass(frozen=True)
class AgentRecipe:
    """How an agent learns by reinforcement, in the environment over predictions.

    Attributes:
        algorithm: of Stable-Baselines3: PPO (Schulman et al., 2017) or DQN (Mnih et al., Nature 518, 2015).
        inputs: what the agent sees: belief, view, place, azimuth_bin (see ``policies.gain.INPUTS``) and any maps of the
            predictions.
        frame: from where the azimuths of actions and observations are counted, see ``GainRecipe``.
        objective: what is paid: the change of "right" (1 if the most believed class is the true one), of the "belief"
            in the true class or of its "log-belief".
        n_views: views of an episode, the first included.
        view_price: taken from the reward for each view.
        travel_price: taken from it for each grid cell of travel.
        hidden: width of the two hidden layers.
        steps: views that are chosen in training, in all episodes together.
        envs: episodes side by side.
        rollout: PPO: views in each of these between two updates. DQN: the same between two rounds of updates.
        batch: decisions in a gradient step.
        updates: PPO: passes over what was gathered. DQN: gradient steps a round.
        lr: Adam's learning rate.
        discount: of rewards to come.
        entropy: PPO: weight of the entropy bonus.
        exploration: DQN: share of random views, from the first number down to the second over the first half of the
            steps.
        evaluations: so often the agent is judged on objects held out, and the best one kept.
        holdout: one of so many parts of the objects is held out for that.
        seed: of everything random.
    """

    algorithm: Literal["ppo", "dqn"] = "ppo"
    inputs: tuple[str, ...] = POLICY_INPUTS
    frame: Literal["camera", "object"] = "object"
    objective: Literal["belief", "log-belief", "right"] = "log-belief"
    n_views: int = 5
    view_price: float = 0.0
    travel_price: float = 0.0
    hidden: int = 64
    steps: int = 1_000_000
    envs: int = 512
    rollout: int = 8
    batch: int = 1024
    updates: int = 5
    lr: float = 1e-3
    discount: float = 1.0
    entropy: float = 0.01
    exploration: tuple[float, float] = (0.9, 0.05)
    evaluations: int = 20
    holdout: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        _check_types(self)
        _check_inputs(self.inputs)
        _at_least(2, n_views=self.n_views, holdout=self.holdout)
        _at_least(1, hidden=self.hidden, steps=self.steps, envs=self.envs, rollout=self.rollout, batch=self.batch)
        _at_least(1, updates=self.updates, evaluations=self.evaluations)
        _at_least(0, lr=self.lr, entropy=self.entropy, view_price=self.view_price, travel_price=self.travel_price)
        _at_least(0, seed=self.seed)
        least = 2 if self.algorithm == "ppo" else 1
        if not least <= self.envs * self.rollout <= 10_000_000:
            raise UsageError(f"--envs times --rollout is from {least} to 10,000,000, not {self.envs * self.rollout:,}")
        shares = [number(share, "each of --discount and --exploration") for share in (self.discount, *self.exploration)]
        if len(shares) != 3 or not all(0 <= share <= 1 for share in shares):
            raise UsageError("--discount and the two numbers of --exploration are from 0 to 1")


MVSELECT = AgentRecipe(
    algorithm="dqn",
    inputs=("belief", "place"),
    frame="camera",
    objective="right",
    rollout=1,
    updates=4,
    discount=0.99,
)
"""After MVSelect (Hou, Gould and Zheng, "Learning to select camera views: efficient multiview understanding at few
glances", arXiv 2303.06145, 2023; "Learning to select views for efficient multi-view understanding", CVPR 2024): deep
Q-learning over what all views say together and which views these were, paid for the right answer; discount 0.99,
exploration from 0.9 to 0.05 and a slowly moving target network as in the authors' code.

What differs from it: the fused input is the belief over all views instead of the maximum of their 512 features, so the
recogniser is not trained along with the agent. Views are counted from the camera, not by the number of a fixed camera.
One perceptron of two layers stands for the sum of a feature branch and a camera branch. It learns from a replay memory
instead of every first camera of every batch. The authors' published code pays the fall of the task's loss; being paid
for the right answer is the other form that it holds. Episodes have five views, not two or three."""
