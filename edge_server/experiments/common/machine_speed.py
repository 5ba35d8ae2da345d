"""How fast the machine is just now.

On a shared one two cores may be one core's two threads for an hour, which doubles the time of arithmetic and
shows in no load of its own; so what is measured stands beside how fast the machine was meanwhile.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from edge_server.experiments.common.machine_probe import (
    CHAINED,
    CHAINS,
    PER_TASK,
    TASKS,
    arithmetic,
    random_reads,
)
from edge_server.fields.common.kernels.hash_grid import FEATURES
from edge_server.fields.common.kernels.thread_pool import Pool

MEGABYTES = 4  # of the table that is read from: more than a core's own cache holds
REPEATS = 3

Row = dict[str, float]


class Speed:
    """``look`` now and then while something is measured, some 50 ms each; ``row`` has the medians since the
    row before: billions of float32 multiply-adds in registers a second and millions of random reads a second,
    all cores together, as ``bench limits`` measures both."""

    def __init__(self) -> None:
        self._pool = Pool(nice=0)
        self._seen: list[tuple[float, float]] = []
        self.look()  # compiles
        self._seen.clear()

    def look(self) -> None:
        """Measure once."""
        self._seen.append((multiply_adds(self._pool, REPEATS), reads(self._pool, MEGABYTES, REPEATS)))

    def row(self) -> Row:
        """{} where nobody has looked."""
        seen, self._seen = self._seen, []
        names = ("multiply_adds_g_per_s", f"reads_{MEGABYTES}mb_m_per_s")
        return {name: statistics.median(values) for name, values in zip(names, zip(*seen))}

    def close(self) -> None:
        """Stop its threads."""
        self._pool.close()


def told(row: Row | None) -> str:
    """A row in a table's cell; "-" where none was measured."""
    return ", ".join(f"{value:,.0f}" for value in row.values()) if row else "-"


def multiply_adds(pool: Pool, repeats: int) -> float:
    """Billions of float32 multiply-adds a second: the most of the widths of vector that processors have."""
    return max(
        chains * in_chains(pool, k, repeats)
        for k, (_, chains, additions) in enumerate(CHAINS)
        if not additions
    )


def in_chains(pool: Pool, k: int, repeats: int) -> float:
    """Billions of float32 operations a second in each of the chains of kernel ``arithmetic[k]``."""
    totals = np.zeros(pool.threads, np.float32)
    return TASKS * CHAINED * CHAINS[k][0] / median_s(repeats, partial(pool.run, arithmetic[k], totals)) / 1e9


def reads(pool: Pool, megabytes: int, repeats: int) -> float:
    """Millions of random reads a second of a vertex, two float32, from one table of so many MB."""
    vertices = megabytes * 2**20 // (4 * FEATURES)
    table = np.zeros((vertices, FEATURES), np.float32)
    rows = np.random.default_rng(0).integers(0, vertices, PER_TASK).astype(np.uint32)
    out = np.zeros((pool.threads, FEATURES), np.float32)
    return TASKS * PER_TASK / median_s(repeats, partial(pool.run, random_reads, table, rows, out)) / 1e6


def median_s(repeats: int, work: Callable[[], Any]) -> float:
    """Seconds that ``work`` takes, once it has been done."""
    work()  # compiles, and warms the caches
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return statistics.median(spent)
