"""How far the field's kernels are from what this machine allows: its limits, then each kernel against them.

The limits are measured, not looked up: random reads and writes of one vertex (two float32, as the hash
tables hold them) in tables of several sizes, and multiply-adds of BLAS on one large and one narrow matrix.
A kernel's floor is the time in which the machine could do its reads, writes and multiply-adds alone, one
after the other; what it takes beyond that goes into addresses, drawing, marching, compositing and waiting.
"""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.fields import Budget
from edge_server.fields.kernels.grid import FEATURES
from edge_server.fields.kernels.pool import Pool
from edge_server.fields.kernels.probe import PER_TASK, TASKS, random_adds, random_reads
from edge_server.fields.ngp import NgpField
from edge_server.fields.ngp_schedule import active_levels
from edge_server.fields.ngp_settings import NgpSettings
from edge_server.offline.still import synthetic
from edge_server.offline.usage import Usage

TABLES_MB = (1, 4, 64)
CORNERS = 8  # of a cell, each read once a level and sample, and written once by its gradient


class TimedPool(Pool):
    """A pool that adds up the wall seconds spent in each kernel, by its name."""

    def __init__(self, threads: int | None = None) -> None:
        super().__init__(threads, nice=0)
        self.seconds: dict[str, float] = defaultdict(float)

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """As ``Pool.run``."""
        began = time.perf_counter()
        super().run(kernel, *args)
        self.seconds[kernel.__name__] += time.perf_counter() - began


def measure(quick: bool, folder: Path, lpips: Path | None = None) -> dict[str, Any]:
    """The machine's limits and, for the default field on ``tile`` and ``room``, each kernel's share of a
    step, its milliseconds a step and the share of them that its floor explains."""
    del folder, lpips
    pool = TimedPool()
    usage = Usage("bench")
    limits = machine_limits(pool, repeats=5 if quick else 15)
    figures: dict[str, Any] = {"machine": limits}
    for name in ("tile", "room"):
        figures[name] = _kernels(name, pool, limits, steps=60 if quick else 300)
    pool.close()
    figures["outside_cores"] = usage.outside(usage.row(0.0))
    return figures


def machine_limits(pool: Pool, repeats: int) -> dict[str, float]:
    """Millions of random vertex reads and of random vertex additions a second, all workers together, by
    table size; billions of float32 multiply-adds a second of BLAS (2048 x 2048; 65536 x 32 x 32)."""
    limits: dict[str, float] = {}
    rng = np.random.default_rng(0)
    for megabytes in TABLES_MB:
        vertices = megabytes * 2**20 // (4 * FEATURES)
        tables = np.zeros((pool.threads, vertices, FEATURES), np.float32)
        rows = rng.integers(0, vertices, PER_TASK).astype(np.uint32)
        out = np.zeros((pool.threads, FEATURES), np.float32)
        # Reading: one table for all, as the hash tables are. Adding: a table each, since no two workers of
        # the gradient's kernel share one either.
        read_s = _median_s(repeats, partial(pool.run, random_reads, tables[0], rows, out))
        add_s = _median_s(repeats, partial(pool.run, random_adds, tables, rows))
        limits[f"reads_{megabytes}mb_m_per_s"] = TASKS * PER_TASK / read_s / 1e6
        limits[f"adds_{megabytes}mb_m_per_s"] = TASKS * PER_TASK / add_s / 1e6
    for name, (m, k, n) in {"gemm": (2048, 2048, 2048), "narrow_gemm": (65536, 32, 32)}.items():
        a, b = rng.random((m, k), np.float32), rng.random((k, n), np.float32)
        limits[f"{name}_g_per_s"] = m * k * n / _median_s(repeats, partial(np.matmul, a, b)) / 1e9
    return limits


def _median_s(repeats: int, work: Callable[[], Any]) -> float:
    work()  # compiles, and warms the caches
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return statistics.median(spent)


def _kernels(scene: str, pool: TimedPool, limits: dict[str, float], steps: int) -> dict[str, Any]:
    still = synthetic(scene, cameras=19, size=128)
    settings = NgpSettings(device="cpu")
    field = NgpField(settings, pool)
    field.fit(still.training, Budget(steps=600))  # all levels on, most of space known to be empty
    pool.seconds.clear()
    report = field.fit(still.training, Budget(steps=steps))
    state = field.state()
    floors = _floors_ms(
        samples=report.samples / report.steps,
        levels=active_levels(settings, field.step),
        widths=[int(w) for w in field._net.widths],
        table_mb=state["table"].nbytes / settings.levels / 2**20,
        limits=limits,
    )
    spent_ms = {name: s / report.steps * 1e3 for name, s in sorted(pool.seconds.items(), key=lambda i: -i[1])}
    kernels: dict[str, Any] = {}
    for name, ms in spent_ms.items():
        kernels[name] = {"ms_a_step": ms, "share": ms / (report.seconds / report.steps * 1e3)}
        if name in floors:
            kernels[name] |= {
                "floor_ms": sum(floors[name].values()),
                "floor_share": sum(floors[name].values()) / ms,
                **{f"floor_{part}_ms": value for part, value in floors[name].items()},
            }
    return {
        "ms_a_step": report.seconds / report.steps * 1e3,
        "samples_a_step": report.samples / report.steps,
        "samples_per_s": report.samples / report.seconds,
        "outside_kernels_share": 1.0 - sum(pool.seconds.values()) / report.seconds,
        "kernels": kernels,
    }


def _floors_ms(
    samples: float, levels: int, widths: list[int], table_mb: float, limits: dict[str, float]
) -> dict[str, dict[str, float]]:
    """For the two kernels that do nearly everything: milliseconds a step of reads, additions and
    multiply-adds at the machine's limits. table_mb: of one level, which is what a pass walks through.

    The floor of ``scatter`` counts every sample, the kernel leaves out those without a gradient (behind the
    first opaque surface): its share can pass 1. Of BLAS the large product is the limit; what BLAS itself
    makes of a product as narrow as the network's is printed as a peer."""
    size = min(TABLES_MB, key=lambda mb: abs(np.log(mb / table_mb)))
    vertices = samples * levels * CORNERS
    multiply_adds = samples * sum(a * b for a, b in pairwise(widths))
    return {
        "train_chunks": {
            "reads": vertices / limits[f"reads_{size}mb_m_per_s"] / 1e3,
            # Forward once; backward twice: the gradient of the inputs and that of the weights.
            "multiply_adds": 3.0 * multiply_adds / limits["gemm_g_per_s"] / 1e6,
        },
        "scatter": {"adds": vertices / limits[f"adds_{size}mb_m_per_s"] / 1e3},
    }
