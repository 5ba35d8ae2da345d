"""Measures the machine's current speed.

The speed of a shared machine changes: two cores may be the two threads of one core for an hour. That doubles
the time of arithmetic but does not show in the load, so measured times are reported with the machine's speed.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from edge_server.experiments.common.machine_probe import CHAINED, CHAINS, PER_TASK, TASKS, arithmetic, random_reads
from edge_server.fields.common.kernels.hash_grid import FEATURES
from edge_server.fields.common.threads.thread_pool import Pool, cores

MEGABYTES = 4  # of the table that is read from: more than a core's own cache holds
REPEATS = 3

Row = dict[str, float]


class MachineSpeed:
    """Samples the speed of the machine while something else is measured.

    Call ``sample`` now and then (it takes some 50 ms). ``medians`` are over the samples since its last call:
    billions of float32 multiply-adds in registers a second, and millions of random reads a second, of all
    cores together, measured as in ``bench limits``.
    """

    def __init__(self) -> None:
        self._pool = Pool(cores(), nice=0)
        self._samples: list[tuple[float, float]] = []
        self.sample()  # compiles
        self._samples.clear()

    def sample(self) -> None:
        """Measure once."""
        self._samples.append((multiply_adds(self._pool, REPEATS), reads(self._pool, MEGABYTES, REPEATS)))

    def medians(self) -> Row:
        """Medians by name; {} without samples."""
        samples, self._samples = self._samples, []
        names = ("multiply_adds_g_per_s", f"reads_{MEGABYTES}mb_m_per_s")
        return {name: statistics.median(values) for name, values in zip(names, zip(*samples))}

    def close(self) -> None:
        """Stop its threads."""
        self._pool.close()


def speed_text(row: Row | None) -> str:
    """``MachineSpeed.medians`` as the cell of a table; "-" where nothing was measured."""
    return ", ".join(f"{value:,.0f}" for value in row.values()) if row else "-"


def multiply_adds(pool: Pool, repeats: int) -> float:
    """Billions of float32 multiply-adds a second at the vector width that is fastest here."""
    return max(chains * in_chains(pool, k, repeats) for k, (_, chains, additions) in enumerate(CHAINS) if not additions)


def in_chains(pool: Pool, k: int, repeats: int) -> float:
    """Billions of float32 operations a second in each chain of kernel ``arithmetic[k]``."""
    totals = np.zeros(pool.threads, np.float32)
    return TASKS * CHAINED * CHAINS[k][0] / median_s(repeats, partial(pool.run, arithmetic[k], totals)) / 1e9


def reads(pool: Pool, megabytes: int, repeats: int) -> float:
    """Millions of random reads a second of one vertex (two float32) from a table of so many MB."""
    vertices = megabytes * 2**20 // (4 * FEATURES)
    table = np.zeros((vertices, FEATURES), np.float32)
    rows = np.random.default_rng(0).integers(0, vertices, PER_TASK).astype(np.uint32)
    out = np.zeros((pool.threads, FEATURES), np.float32)
    return TASKS * PER_TASK / median_s(repeats, partial(pool.run, random_reads, table, rows, out)) / 1e6


def median_s(repeats: int, work: Callable[[], Any]) -> float:
    """Median seconds of ``repeats`` calls of ``work``, after one call that is not counted."""
    work()  # compiles, and warms the caches
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return statistics.median(spent)
