"""How the bundled models are trained. No torch here, so that the command line can show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from nextview.checks import number, whole


@dataclass(frozen=True)
class Hardware:
    """Devices and precision; see docs/training.md for several devices.

    Attributes:
        devices: processes, each with its own GPU where there are any; they share every batch out.
        accelerator: "auto" takes GPUs where there are any.
        precision: of the arithmetic; weights are kept in single precision. Take 16-mixed on GPUs older than Ampere.
    """

    devices: int = 1
    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    precision: Literal["bf16-mixed", "16-mixed", "32-true"] = "bf16-mixed"


POLICY_INPUTS = ("belief", "view", "place", "lem-sphere", "azimuth_bin")
"""Features of the bundled gain policy; see ``policies.decision_features.INPUTS``."""
Depth = Literal[18, 34, 50, 101, 152]


def _check(recipe: Any, at_least_one: tuple[str, ...], shares: tuple[str, ...] = ()) -> None:
    for name in at_least_one:
        whole(getattr(recipe, name), f"--{name.replace('_', '-')}", 1)
    for name in shares:
        number(getattr(recipe, name), f"--{name.replace('_', '-')}", 0, 0.999)


@dataclass(frozen=True)
class RecogniserRecipe:
    """How the recogniser is trained.

    Attributes:
        network: a ResNet, or EfficientNet-Lite0, which has a fifth of the arithmetic of a ResNet-18.
        depth: of the ResNet.
        dropout: of EfficientNet-Lite0: chance that a pooled feature is dropped; the chance that a block is skipped for
            a view rises from 0 at the first towards it at the last.
        size: side of the input image, pixels.
        epochs: passes over the training objects.
        views: views of each object in one epoch, drawn at random.
        batch: views a step.
        lr: peak learning rate of AdamW.
        weight_decay: of AdamW.
        smoothing: label smoothing.
        azimuth_bins_weight: weight of the loss for the azimuth bin from which the object is seen, beside that of its
            class; 0 does without. All objects of a class have to face the same way in their files, as ModelNet10's do.
        validation: part of the training split held out for validation.
        deformed_share: chance that a view is drawn from the deformed objects, where such a store is given.
        seed: decides everything random.
        ensemble_seed: of one network of an ensemble: --seed decides the objects that validate all of them, this one the
            first weights and draws.
        input: what the network sees: the geometry that a depth camera sees, or the shaded image.
        augment: whether views are varied: mirrored, shifted, scaled, partly hidden.
        balanced: whether rare classes are drawn more often; otherwise every view comes once before any comes again.
        schedule: of the learning rate: up and down once, or halved every fifth epoch from the peak.
        patience: stop after so many epochs without a better class mean on validation; 0 never stops early.
        way: how far the parameters go in the end, from the first to the trained ones. Less than 1 keeps more of what
            the network learned before (Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022).
    """

    network: Literal["resnet", "lite0"] = "resnet"
    depth: Depth = 18
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
        _check(self, ("size", "epochs", "views", "batch"), ("dropout", "smoothing", "validation"))


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
pixels, every view once an epoch, plain cross-entropy. The epochs and the validation part are ours: the text names
neither, and its map networks settle around the tenth epoch (section 6.2.2)."""


@dataclass(frozen=True)
class MapRecipe:
    """How a map network is trained.

    Attributes:
        measure: of views, whose map it predicts: one that the store holds (nextview measure), or "confidence", the
            recogniser's where it is right, which takes predictions.
        input: what the network sees: the geometry of the view, through a ResNet; or the partial cloud, through a
            PointNet, as published.
        depth: of the ResNet.
        size: side of the ResNet's input image, pixels.
        points: drawn from each cloud in training; validation and use take all 1,024.
        output: what the network predicts: the local window alone, or all views of the sphere.
        epochs: passes over the training objects.
        views: views of each object in one epoch, drawn at random.
        batch: views a step.
        lr: peak learning rate of AdamW.
        weight_decay: of AdamW.
        regular: weight of the orthogonality terms of the PointNet's transforms.
        peak: weight of the cross-entropy of the highest cell of the window, beside the squared error of all cells;
            values are divided by ``sharpness`` to give log-odds.
        sharpness: see ``peak``.
        reach: of ``peak``: 0 for the highest cell itself, 1 for its neighbours above, below, left and right too.
        mirror: whether left and right are exchanged in half of the views, in the map too.
        schedule: of the learning rate: up and down once, or a tenth every fifth epoch from the peak.
        validation: part of the training split held out for validation.
        seed: decides everything random.
        patience: stop after so many epochs without a lower squared error on validation; 0 never stops early.
    """

    measure: str = "depth_entropy"
    input: Literal["geometry", "cloud"] = "geometry"
    depth: Depth = 18
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
        _check(self, ("size", "points", "epochs", "views", "batch"), ("validation",))


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
16, every view once an epoch. The number of epochs is ours."""


@dataclass(frozen=True)
class GainRecipe:
    """How the gain policy is trained.

    Attributes:
        inputs: of the networks: belief, view, place, azimuth_bin and any maps of the predictions; in scenes visibility
            too, the share of the object that is expected to show from each view.
        frame: from where azimuths are counted: from the camera's, or from the object's azimuth bin 0, which takes a
            recogniser with azimuth bins.
        objective: value of a view: the belief in the true class after it, its logarithm, or whether the answer is
            right.
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
        _check(self, ("hidden", "networks", "epochs", "walks", "batch"))
        whole(self.n_views, "--n-views", 2)
