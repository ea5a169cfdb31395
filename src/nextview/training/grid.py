"""The published comparison of recognisers (table 6): which networks it holds, and how ours do on the same footing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from nextview.benchmark.published import published_recognisers, read_rows
from nextview.training.packed import PackedViews


def published_cells(classes: tuple[str, ...], views: int) -> dict[tuple[int, int], list[float]]:
    """Depth and batch size of the networks of table 6, with their published accuracies; two are given for one of them.

    For a data set that table 6 does not have, all of its networks, without accuracies.

    Args:
        classes: of the data.
        views: of each object.
    """
    cells: dict[tuple[int, int], list[float]] = {}
    for model, batch, accuracy in published_recognisers(classes, views):
        cells.setdefault((_depth(model), batch), []).append(accuracy)
    if not cells:
        cells = {(_depth(row["model"]), int(row["batch_size"])): [] for row in read_rows("table6_resnet")}
    return dict(sorted(cells.items()))


def count_right(
    network: nn.Module, inputs: PackedViews, objects: NDArray[np.int64], labels: NDArray[np.int64]
) -> Iterator[int]:
    """How many single views of each object are named right, on a GPU where there is one.

    Args:
        network: gives logits first.
        inputs: of all views, (N, V, C, S, S).
        objects: indices, (M,).
        labels: of all objects, (N,).

    Yields:
        A count for each of ``objects``.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = network.eval().to(device)
    for i in objects:
        with torch.inference_mode():
            x = torch.from_numpy(inputs[i]).to(device).float() / 255
            yield int((network(x)[0].argmax(1) == int(labels[i])).sum())


def _depth(model: str) -> int:
    return int(model.removeprefix("ResNet"))
