"""Training recipes. The docstring of an attribute is its help on the command line.

This module does not import torch, as the command line uses it.
"""

from dataclasses import dataclass
from typing import Any, Literal

from nextview.checks import number, whole


@dataclass(frozen=True)
class Hardware:
    """Device and precision.

    Attributes:
        accelerator: "auto" uses a GPU if available.
        precision: use 16-mixed on GPUs older than Ampere.
    """

    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    precision: Literal["bf16-mixed", "16-mixed", "32-true"] = "bf16-mixed"


POLICY_INPUTS = (
    "belief",
    "view",
    "place",
    "lem-sphere",
    "azimuth_bin",
)  # of the bundled policy
Layers = Literal[18, 34, 50, 101, 152]


def _check(
    recipe: Any,
    at_least_one: tuple[str, ...],
    shares: tuple[str, ...] = (),
) -> None:
    for name in at_least_one:
        whole(getattr(recipe, name), f"--{name.replace('_', '-')}", 1)
    for name in shares:
        number(getattr(recipe, name), f"--{name.replace('_', '-')}", 0, 0.999)


@dataclass(frozen=True)
class RecogniserRecipe:
    """Training of the recogniser.

    Attributes:
        network: ResNet, or EfficientNet-Lite0 with a fifth of the computation of a ResNet-18.
        layers: number of layers of the ResNet.
        dropout: for EfficientNet-Lite0: probability of dropping a pooled feature; the probability
            of skipping a block rises from 0 at the first to this value at the last.
        size: side of the input image, pixels.
        epochs: passes over the training objects.
        views_per_object: random views of each object in one epoch.
        batch: views per step.
        lr: peak learning rate of AdamW.
        weight_decay: weight decay of AdamW.
        smoothing: label smoothing.
        azimuth_bins_weight: weight of the loss of the azimuth bin relative to that of the class; 0
            for no bins. All objects of a class must have the same orientation in their files, as
            in ModelNet10.
        validation_share: share of the training split that is held out for validation.
        deformed_share: probability that a view is drawn from the deformed objects, if there are
            any.
        seed: seed of all random draws.
        ensemble_seed: seed of the initial weights and random numbers of one network in an ensemble;
            --seed determines the validation objects of all.
        input: input of the network: the geometry that a depth camera measures, or a shaded image.
        augment: by default views are augmented: mirrored, shifted, scaled, partly hidden.
        balanced: by default rare classes are drawn more often; otherwise every view is used once
            in turn.
        lr_schedule: schedule of the learning rate: one cycle up and down, or halved every fifth
            epoch.
        interpolation: position of the final weights between the initial (0) and the trained ones
            (1). Values below 1 retain more of the initial network (Wortsman et al., "Robust
            fine-tuning of zero-shot models", CVPR 2022).
    """

    network: Literal["resnet", "lite0"] = "resnet"
    layers: Layers = 18
    dropout: float = 0.0
    size: int = 112
    epochs: int = 12
    views_per_object: int = 8
    batch: int = 64
    lr: float = 2e-3
    weight_decay: float = 0.05
    smoothing: float = 0.1
    azimuth_bins_weight: float = 0.0
    validation_share: float = 0.1
    deformed_share: float = 0.5
    seed: int = 0
    ensemble_seed: int = 0
    input: Literal["geometry", "image"] = "geometry"
    augment: bool = True
    balanced: bool = True
    lr_schedule: Literal["one-cycle", "halving"] = "one-cycle"
    interpolation: float = 1.0

    def __post_init__(self) -> None:
        _check(
            self,
            ("size", "epochs", "views_per_object", "batch"),
            ("dropout", "smoothing", "validation_share"),
        )


THESIS_RECOGNISER = RecogniserRecipe(
    layers=34,
    size=224,
    epochs=15,
    views_per_object=40,
    batch=32,
    lr=1e-3,
    weight_decay=0.0,
    smoothing=0.0,
    deformed_share=0.0,
    input="image",
    augment=False,
    balanced=False,
    lr_schedule="halving",
)
"""As published (thesis, section 5.1). The number of epochs and the validation share are not stated
there; the map networks of the thesis converge around the tenth epoch (section 6.2.2)."""


@dataclass(frozen=True)
class MapRecipe:
    """Training of a map network.

    Attributes:
        measure: measure to predict: one in the store (nextview-lab measure), or "confidence", the
            belief of the recogniser in its answer, and 0 if the answer is wrong, which needs
            --predictions.
        input: input of the network: the geometry of the view for a ResNet, or the partial cloud for
            a PointNet, as published.
        layers: number of layers of the ResNet.
        size: side of the ResNet's input image, pixels.
        points: number of points sampled from each cloud in training; validation and use take all
            1,024.
        extent: predicted views: the local window, or all views.
        epochs: passes over the training objects.
        views_per_object: random views of each object in one epoch.
        batch: views per step.
        lr: peak learning rate of AdamW.
        weight_decay: weight decay of AdamW.
        orthogonality_weight: weight of the orthogonality terms of the PointNet's transforms.
        peak_weight: weight of the cross-entropy of the window's highest cell, relative to the
            squared error of all cells.
        peak_sharpness: for --peak-weight: values are divided by it to give log-odds.
        peak_reach: for --peak-weight: 0 for the highest cell alone, 1 for its four neighbours too.
        mirror: by default half of the views are mirrored left to right, with their maps.
        lr_schedule: schedule of the learning rate: one cycle up and down, or divided by ten every
            fifth epoch.
        validation_share: share of the training split that is held out for validation.
        seed: seed of all random draws.
    """

    measure: str = "depth_entropy"
    input: Literal["geometry", "cloud"] = "geometry"
    layers: Layers = 18
    size: int = 56
    points: int = 256
    extent: Literal["window", "sphere"] = "sphere"
    epochs: int = 8
    views_per_object: int = 12
    batch: int = 64
    lr: float = 2e-3
    weight_decay: float = 0.05
    orthogonality_weight: float = 1e-4
    peak_weight: float = 0.0
    peak_sharpness: float = 0.05
    peak_reach: int = 0
    mirror: bool = True
    lr_schedule: Literal["one-cycle", "tenth"] = "one-cycle"
    validation_share: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        _check(
            self,
            ("size", "points", "epochs", "views_per_object", "batch"),
            ("validation_share",),
        )


THESIS_MAP = MapRecipe(
    input="cloud",
    points=1024,
    extent="window",
    epochs=15,
    views_per_object=40,
    batch=16,
    lr=1e-3,
    weight_decay=0.0,
    mirror=False,
    lr_schedule="tenth",
)
"""As published (thesis, sections 2.2.3 and 5.1): PointNet, every view once per epoch.

The number of epochs is our choice.
"""


@dataclass(frozen=True)
class GainRecipe:
    """Training of the gain policy.

    Attributes:
        inputs: inputs of the networks: belief, view, place, azimuth_bin and any maps of the
            predictions.
        frame: origin of the azimuths: that of the camera, or azimuth bin 0 of the object, which
            needs a recogniser with azimuth bins.
        objective: value of a view: the belief in the true class after it, its logarithm, or whether
            the answer is right.
        max_views: number of views in an episode; values are learned from the second view on.
        hidden: width of the two hidden layers.
        networks_per_fold: networks that are averaged in each fold; each is trained with its own
            bootstrap weights of the objects.
        epochs: number of epochs, each with new episodes of all objects.
        episodes: episodes of each object in one epoch.
        batch: states per step.
        lr: peak learning rate of AdamW (one-cycle).
        weight_decay: weight decay of AdamW.
        seed: seed of all random draws.
    """

    inputs: tuple[str, ...] = POLICY_INPUTS
    frame: Literal["camera", "object"] = "object"
    objective: Literal["belief", "log-belief", "right"] = "log-belief"
    max_views: int = 5
    hidden: int = 32
    networks_per_fold: int = 2
    epochs: int = 15
    episodes: int = 8
    batch: int = 1024
    lr: float = 3e-3
    weight_decay: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        _check(self, ("hidden", "networks_per_fold", "epochs", "episodes", "batch"))
        whole(self.max_views, "--max-views", 2)


@dataclass(frozen=True)
class SegmentationRecipe:
    """Training of the segmentation network.

    Attributes:
        frames: number of simulated training frames.
        width: channels of the first layers; the deeper ones have up to four times as many.
        epochs: passes over the frames.
        batch: frames per step.
        lr: peak learning rate of AdamW, with warm-up and cosine decay.
        weight_decay: weight decay of AdamW.
        validation_share: share of the meshes that is held out for validation, and number of
            validation frames relative to --frames.
        seed: seed of all random numbers, including those of the frames.
        interpolation: position of the final weights between the initial (0) and the trained ones
            (1), as of the recogniser; for --start.
    """

    frames: int = 12_000
    width: int = 32
    epochs: int = 12
    batch: int = 16
    lr: float = 2e-3
    weight_decay: float = 0.01
    validation_share: float = 0.05
    seed: int = 0
    interpolation: float = 1.0

    def __post_init__(self) -> None:
        _check(self, ("frames", "width", "epochs", "batch"), ("validation_share",))
