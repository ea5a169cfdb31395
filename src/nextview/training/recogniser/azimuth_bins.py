"""From which side a view sees its object: what a recogniser may learn beside the class.

Sides are counted in steps of azimuth, and from the vertical plane that makes the objects of a class their own mirror
images, so that the mirror image of a view from side a is a view from side -a.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nextview.data.rendering import turns
from nextview.data.store import ViewStore


def mirror_planes(store: ViewStore, objects: NDArray[np.int64]) -> NDArray[np.float64]:
    """Azimuth of the plane of symmetry of each class, steps of the store's viewpoints, (classes,).

    It is the one, of those that go through viewpoints, that best mirrors the depth-entropy of the views into itself; 0
    for a class of which there is no object.

    Args:
        store: the views.
        objects: indices of those that train.
    """
    n = store.sphere.azimuths
    measured = store.measure()[objects].reshape(len(objects), -1, n).astype(np.float64)
    measured -= measured.mean((1, 2), keepdims=True)
    planes = np.arange(n)[: max(1, n // 2)]  # the plane through a view also holds the one opposite
    duplicate_groups = np.stack(
        [(measured * measured[:, :, (2 * plane - np.arange(n)) % n]).sum((1, 2)) for plane in planes], 1
    )
    labels = store.labels[objects]
    return np.array(
        [planes[duplicate_groups[labels == c].sum(0).argmax()] for c in range(len(store.classes))], np.float64
    )


def azimuth_bins(store: ViewStore, azimuths: int, planes: NDArray[np.float64]) -> NDArray[np.float32]:
    """The side that each view sees of its object, in 0 .. azimuths, (N, V).

    Args:
        store: the views; its objects may have been turned, see ``data.render.Deform``.
        azimuths: steps in a full turn.
        planes: see ``mirror_planes``, steps.
    """
    sphere = store.sphere
    steps = sphere.azimuth_index * (azimuths / sphere.azimuths)
    turned = turns(store) * azimuths / (2 * np.pi) + planes[store.labels]
    return ((steps - turned[:, None]) % azimuths).astype(np.float32)


def side_loss(likely: Tensor, label: Tensor, side: Tensor) -> Tensor:
    """Mean cross-entropy of the side given the true class; between two steps, either counts by how near it is.

    Args:
        likely: logarithms of the azimuth bins' likelihoods, (B, classes, azimuths).
        label: true classes, (B,).
        side: steps, (B,).
    """
    own = likely[torch.arange(len(label), device=label.device), label]
    low, n = side.floor(), own.shape[1]
    share = (side - low)[:, None]
    low = low.long()[:, None]
    return -((1 - share) * own.gather(1, low % n) + share * own.gather(1, (low + 1) % n)).mean()
