"""How many threads torch computes with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Compute with one thread in the block.

    Sums then have one order, and results the same bits on any number of cores. Small work is also faster: on
    cores that others keep busy, OpenMP's threads spin for each other, which made LPIPS forty times as slow.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
