"""Batches are made in the background while the network learns."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from torch.utils.data import IterableDataset


class Ahead(IterableDataset):
    """The batches of a data set in the same order, the next few made by a thread while one is used.

    A thread is enough: the batches are copies out of memory-mapped files. What fails there is raised here.
    """

    def __init__(self, batches: IterableDataset, depth: int = 4) -> None:
        self.batches, self.depth = batches, depth

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[Any]:
        batches = iter(self.batches)
        with ThreadPoolExecutor(1) as thread:
            coming = deque(thread.submit(next, batches, None) for _ in range(self.depth))
            while (batch := coming.popleft().result()) is not None:
                coming.append(thread.submit(next, batches, None))
                yield batch
