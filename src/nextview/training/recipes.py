"""How the bundled models are trained. No torch here, so that the command line can show them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RecogniserRecipe:
    """How the recogniser is trained.

    Attributes:
        depth: ResNet-18 or -34.
        size: side of the input image, pixels.
        small: side of the images in the first epochs, which are faster so; see ``small_epochs``.
        small_epochs: how many epochs see small images.
        epochs: passes over the training objects.
        views: views of each object in one epoch, drawn at random.
        batch: views a step.
        rate: peak learning rate of AdamW under a one-cycle schedule.
        decay: weight decay.
        smoothing: label smoothing.
        validation: part of the training split held out for validation.
        deformed_share: chance that a view is drawn from the deformed objects, where such a store is given.
        seed: decides everything random.
    """

    depth: int = 18
    size: int = 112
    small: int = 80
    small_epochs: int = 0
    epochs: int = 12
    views: int = 8
    batch: int = 64
    rate: float = 2e-3
    decay: float = 0.05
    smoothing: float = 0.1
    validation: float = 0.1
    deformed_share: float = 0.5
    seed: int = 0


@dataclass(frozen=True)
class MapRecipe:
    """How a map network, LEM or LCM, is trained.

    Attributes:
        epochs: passes over the training objects.
        views: views of each object in one epoch, drawn at random.
        points: points drawn from each cloud in training; validation and use take all 1,024.
        batch: clouds a step.
        rate: peak learning rate of Adam under a one-cycle schedule.
        regular: weight of the transforms' orthogonality terms (thesis: 1e-4).
        validation: part of the training split held out for validation.
        seed: decides everything random.
    """

    epochs: int = 5
    views: int = 6
    points: int = 256
    batch: int = 16
    rate: float = 1e-3
    regular: float = 1e-4
    validation: float = 0.1
    seed: int = 0
