"""A roofline of the fields' kernels: the limits of this machine, and each kernel against them.

The limits are measured: random reads and writes of one vertex (two float32, as in the hash tables) in tables
of several sizes, arithmetic in registers, divisions, and copies within a core's own cache. Multiply-adds of
BLAS, on one large and one narrow matrix, are shown for comparison; they are not a limit, because on a
processor that BLAS was not tuned for they reach half of what is possible. A kernel's floor is the least time
that all cores together need for the slowest of its reads, writes and arithmetic, which overlap. The rest of
its time is spent on addresses, sampling, marching, branches and waiting. Measured for ``ngp`` and ``splat``,
the default and the fastest field.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from edge_server.experiments.bench.run import BenchRun
from edge_server.experiments.common.machine_probe import CHAINS, PER_TASK, ROUNDS, TASKS, copies, divisions, random_adds
from edge_server.experiments.common.machine_speed import in_chains, median_s, reads
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields import Budget, FitReport, View
from edge_server.fields.common.kernels.hash_grid import FEATURES
from edge_server.fields.common.threads.thread_pool import Pool, cores
from edge_server.fields.common.training_schedule import active_levels
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import NgpSettings
from edge_server.fields.splat.kernels.composite import SAVED, STRIP, STRIPS, SUMS
from edge_server.fields.splat.kernels.project import BASE, HALF_HEIGHT, MEAN_Y, TILE
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.still_field import StillField
from freshfield.machine_load import LoadMeter

TABLES_MB = (1, 4, 64)
CORNERS = 8  # corners of a cell, each read once per level and sample, and written once by its gradient
WARM_STEPS = 600
LEAST_SHARE = 0.01  # share of a step below which kernels have no row in the table
LIMITS = {
    **{f"reads_{mb}mb_m_per_s": f"million random reads a second from {mb} MB" for mb in TABLES_MB},
    **{f"adds_{mb}mb_m_per_s": f"million random additions a second to {mb} MB a core" for mb in TABLES_MB},
    "multiply_adds_g_per_s": "billion multiply-adds a second in registers",
    "operations_g_per_s": "billion operations a second in registers, a multiply-add as one",
    "gemm_g_per_s": "of BLAS: billion multiply-adds a second, 2048 x 2048 x 2048",
    "narrow_gemm_g_per_s": "of BLAS: billion multiply-adds a second, 65536 x 32 x 32",
    "divisions_g_per_s": "billion divisions a second",
    "copies_gb_per_s": "GB copied a second within a core's cache",
}

# Numbers of operations of the Gaussians' kernels, counted in their sources: additions, multiplications,
# comparisons and conversions; a multiplication with the following addition counts as one. Per pixel and
# Gaussian in one of its strips, forward (12 of them for a power of 2) and backward (11 of them for adding up
# lanes):
COMPOSITING, COMPOSITING_BACK = 33, 31
# Per Gaussian: its projection; the backward pass of the projection and a step of Adam.
PROJECTING, UPDATING = 300, 680
# Moves per sorted Gaussian (counted and moved, twice) and per pair (counted, owned, listed).
SORTING, BINNING = 4, 3


class TimedPool(Pool):
    """A pool that sums the wall-clock seconds of each kernel by name."""

    def __init__(self, threads: int | None = None) -> None:
        super().__init__(threads, nice=0)
        self.seconds: dict[str, float] = defaultdict(float)

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """As ``Pool.run``."""
        began = time.perf_counter()
        super().run(kernel, *args)
        self.seconds[kernel.__name__] += time.perf_counter() - began


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure the limits of the machine and, for ``ngp`` and ``splat`` on ``tile`` and ``room``, each
    kernel's share of a step, its milliseconds per step and the share of these that its floor explains."""
    pool = TimedPool(cores())  # as many threads as for the limits
    load = LoadMeter()
    limits = Limits(repeats=5 if run.quick else 15)
    figures: dict[str, Any] = {}
    steps = 60 if run.quick else 300
    for name in ("tile", "room"):
        views = synthetic_still(name, cameras=19, size=128).training
        figures[f"ngp on {name}"] = _of_ngp(views, pool, limits, steps)
        figures[f"splat on {name}"] = _of_splat(views, pool, limits, steps)
    figures["machine"] = limits.highest
    limits.pool.close()
    pool.close()
    figures["outside_cores"] = load.outside_cores()
    return figures


class Limits:
    """The limits of the machine, measured again after each fit that is compared with them, because the speed
    of a shared machine changes within a minute and a slow minute would underestimate the limits.

    highest: the highest value of each limit.
    """

    def __init__(self, repeats: int) -> None:
        self.pool = Pool(cores(), nice=0)
        self._repeats = repeats
        self._last = machine_limits(self.pool, repeats)
        self.highest = self._last

    def around(self) -> dict[str, float]:
        """The limits since the last measurement: the higher values of that and of a new one."""
        before, self._last = self._last, machine_limits(self.pool, self._repeats)
        self.highest = _higher(self.highest, self._last)
        return _higher(before, self._last)


def _higher(a: dict[str, float], b: dict[str, float]) -> dict[str, float]:
    return {name: max(limit, b[name]) for name, limit in a.items()}


def machine_limits(pool: Pool, repeats: int) -> dict[str, float]:
    """Measure, for all workers together, millions of random vertex reads and random vertex additions a
    second, by table size; and billions a second of float32 multiply-adds, of any operations, of BLAS's
    multiply-adds (2048 x 2048; 65536 x 32 x 32), of divisions, and of bytes copied from 256 kB to 256 kB."""
    limits: dict[str, float] = {}
    rng = np.random.default_rng(0)
    for megabytes in TABLES_MB:
        vertices = megabytes * 2**20 // (4 * FEATURES)
        # All workers read one table, as in the fields. Each adds to its own, as in the gradient's kernel.
        tables = np.zeros((pool.threads, vertices, FEATURES), np.float32)
        rows = rng.integers(0, vertices, PER_TASK).astype(np.uint32)
        add_s = median_s(repeats, partial(pool.run, random_adds, tables, rows))
        limits[f"reads_{megabytes}mb_m_per_s"] = reads(pool, megabytes, repeats)
        limits[f"adds_{megabytes}mb_m_per_s"] = TASKS * PER_TASK / add_s / 1e6
    for name, (m, k, n) in {"gemm": (2048, 2048, 2048), "narrow_gemm": (65536, 32, 32)}.items():
        a, b = rng.random((m, k), np.float32), rng.random((k, n), np.float32)
        limits[f"{name}_g_per_s"] = m * k * n / median_s(repeats, partial(np.matmul, a, b)) / 1e9
    limits |= {"multiply_adds_g_per_s": 0.0, "operations_g_per_s": 0.0}
    for k, (_, multiply_adds, additions) in enumerate(CHAINS):
        vectors = in_chains(pool, k, repeats)
        for name, chains in {"multiply_adds": multiply_adds, "operations": multiply_adds + additions}.items():
            limits[f"{name}_g_per_s"] = max(limits[f"{name}_g_per_s"], chains * vectors)
    x, y = rng.random((2, 2048), np.float32) + np.float32(1.0)
    out = np.zeros((pool.threads, x.size), np.float32)
    memory = np.zeros((pool.threads, 2 * PER_TASK), np.float32)
    divide_s = median_s(repeats, partial(pool.run, divisions, x, y, out))
    copy_s = median_s(repeats, partial(pool.run, copies, memory))
    limits["divisions_g_per_s"] = TASKS * ROUNDS * x.size / divide_s / 1e9
    limits["copies_gb_per_s"] = TASKS * PER_TASK * 4 / copy_s / 1e9
    return limits


def _of_ngp(views: Sequence[View], pool: TimedPool, limits: Limits, steps: int) -> dict[str, Any]:
    settings = NgpSettings(device="cpu")
    field = NgpField(settings, pool)
    field.fit(views, Budget(steps=WARM_STEPS))  # all levels on, most of space known to be empty
    pool.seconds.clear()
    report = field.fit(views, Budget(steps=steps))
    floors = _floors_of_ngp(
        samples=report.samples / report.steps,
        levels=active_levels(settings, field.step),
        widths=[int(w) for w in field._net.widths],
        table_mb=field.state()["table"].nbytes / settings.levels / 2**20,
        limits=limits.around(),
    )
    return _against(floors, report, pool)


def _of_splat(views: Sequence[View], pool: TimedPool, limits: Limits, steps: int) -> dict[str, Any]:
    field = StillField(SplatSettings(), pool)
    field.fit(views, Budget(steps=WARM_STEPS))  # until it has its largest size
    pool.seconds.clear()
    report = field.fit(views, Budget(steps=steps))
    spent = dict(pool.seconds)  # the counting below is not timed
    counts = []
    for _ in range(len(views)):
        field.fit(views, Budget(steps=1))
        counts.append(_counted(field))
    pool.seconds.clear()
    pool.seconds.update(spent)
    gaussians, seen, pairs, strips = np.mean(counts, axis=0)
    return _against(_floors_of_splat(gaussians, seen, pairs, strips, limits.around()), report, pool)


def _counted(field: StillField) -> tuple[int, int, int, int]:
    """Counts of a field's last step, on one image: Gaussians, visible Gaussians, pairs of a Gaussian and a
    tile, and strips reached by pairs that changed a pixel (the other pairs are hidden). Some of these strips
    may already have been opaque, so the floor is slightly too high if much is hidden."""
    raster, count = field._raster, len(field.cloud)
    lists, pairs = raster.lists, int(raster.lists.needed[0])
    used = (raster.sums[0, :pairs] != 0.0).any(axis=-1)
    rows = raster.projected[0, lists.owner[0, :pairs][used]]
    row = np.zeros(pairs, np.int64)  # of tiles, of each pair
    lengths = np.diff(lists.first[0, : int(raster.columns[0] * raster.rows[0]) + 1])
    row[lists.pair[0, :pairs]] = np.repeat(np.arange(len(lengths)) // raster.columns[0], lengths)
    middle = rows[:, MEAN_Y] - TILE * row[used] - 0.5
    top, bottom = (
        np.clip(edge, 0, TILE - 1).astype(np.int64) * STRIPS // TILE
        for edge in (np.ceil(middle - rows[:, HALF_HEIGHT]), middle + rows[:, HALF_HEIGHT])
    )
    return count, int((lists.own_count[0, :count] > 0).sum()), pairs, int((bottom - top + 1).sum())


def _against(floors: dict[str, dict[str, float]], report: FitReport, pool: TimedPool) -> dict[str, Any]:
    """Time of each kernel in the reported steps, and the parts of its floor, in milliseconds per step."""
    spent_ms = {name: s / report.steps * 1e3 for name, s in sorted(pool.seconds.items(), key=lambda i: -i[1])}
    kernels: dict[str, Any] = {}
    for name, ms in spent_ms.items():
        kernels[name] = {"ms_a_step": ms, "share": ms / (report.seconds / report.steps * 1e3)}
        if name in floors:
            kernels[name] |= {
                "floor_ms": max(floors[name].values()),
                "floor_share": max(floors[name].values()) / ms,
                "floor_parts_ms": floors[name],
            }
    return {
        "ms_a_step": report.seconds / report.steps * 1e3,
        "samples_a_step": report.samples / report.steps,
        "samples_per_s": report.samples / report.seconds,
        "outside_kernels_share": 1.0 - sum(pool.seconds.values()) / report.seconds,
        "kernels": kernels,
    }


def _floors_of_ngp(
    samples: float, levels: int, widths: list[int], table_mb: float, limits: dict[str, float]
) -> dict[str, dict[str, float]]:
    """Floors of the two kernels that take nearly all the time: milliseconds per step of reads, additions and
    multiply-adds at the machine's limits.

    table_mb: size of one level, which a pass reads.

    The floor of ``scatter`` counts all samples, but the kernel skips those without a gradient (behind the
    first opaque surface), so its share can exceed 1.
    """
    size = min(TABLES_MB, key=lambda mb: abs(np.log(mb / table_mb)))
    vertices = samples * levels * CORNERS
    multiply_adds = samples * sum(a * b for a, b in pairwise(widths))
    return {
        "train_chunks": {
            "reads": vertices / limits[f"reads_{size}mb_m_per_s"] / 1e3,
            # Forward once; backward twice: the gradient of the inputs and that of the weights.
            "multiply_adds": 3.0 * multiply_adds / limits["multiply_adds_g_per_s"] / 1e6,
        },
        "scatter": {"adds": vertices / limits[f"adds_{size}mb_m_per_s"] / 1e3},
    }


def _floors_of_splat(
    gaussians: float, seen: float, pairs: float, strips: float, limits: dict[str, float]
) -> dict[str, dict[str, float]]:
    """Floors of the four kernels of a step on one image, in milliseconds at the machine's limits.

    gaussians: number of Gaussians in the cloud.
    seen: number of Gaussians in the image.
    pairs: number of pairs of a Gaussian and a tile.
    strips: number of strips in which pairs change a pixel.

    Only operations count, although ``project`` and ``adam_step`` mostly rearrange numbers and ``bin_tiles``
    mostly sorts.
    """
    operations, divisions_ms = limits["operations_g_per_s"] * 1e6, limits["divisions_g_per_s"] * 1e6
    copied, added = limits["copies_gb_per_s"] * 1e6, limits[f"adds_{TABLES_MB[0]}mb_m_per_s"] * 1e3
    parameters = BASE
    return {
        "train_tiles": {
            "arithmetic": strips * STRIP * (COMPOSITING + COMPOSITING_BACK) / operations,
            "divisions": strips * STRIP / divisions_ms,
            "copies": strips * SAVED * 4 / copied,  # written and read once
        },
        "project": {"arithmetic": gaussians * PROJECTING / operations},
        "bin_tiles": {"moves": (seen * SORTING + pairs * BINNING) / added},
        "adam_step": {
            "arithmetic": (seen * UPDATING + pairs * SUMS) / operations,
            "divisions": seen * 2 * parameters / divisions_ms,  # square roots take as long
            "copies": pairs * SUMS * 4 / 2 / copied,
        },
    }


def table(figures: dict[str, Any]) -> str:
    """Markdown tables: the machine's limits, and a row for each kernel."""
    limits = [(LIMITS[k], f"{v:,.0f}" if v >= 100 else f"{v:.1f}") for k, v in figures["machine"].items()]
    head = ("field, scene", "kernel", "ms a step", "of the step", "explained by limits", "by which, ms")
    rows = [
        row
        for about, found in figures.items()
        if isinstance(found, dict) and "kernels" in found
        for row in _rows(about, found)
    ]
    tables = markdown_table(("limit of this machine, all cores", ""), limits), markdown_table(head, rows)
    return "\n\n".join(tables)


def _rows(about: str, found: dict[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    for name, kernel in found["kernels"].items():
        if kernel["share"] >= LEAST_SHARE:
            parts = kernel.get("floor_parts_ms", {})
            floor = ", ".join(f"{part.replace('_', '-')} {ms:.2f}" for part, ms in parts.items())
            explained = f"{kernel['floor_share']:.0%}" if parts else "-"
            rows.append((about, name, f"{kernel['ms_a_step']:.2f}", f"{kernel['share']:.0%}", explained, floor))
    outside = found["outside_kernels_share"]
    return [*rows, (about, "outside kernels", f"{found['ms_a_step'] * outside:.2f}", f"{outside:.0%}", "-", "")]
