"""The simulation's accuracy against its cost: the error of the mean age against seconds simulated and seconds
of computing, on the thesis's chapter 5 channel, whose age is known exactly."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from channel_emu.model.config import channel_from_mapping
from channel_emu.virtual.benchmark import MEAN_MS, PERIOD_MS
from channel_emu.virtual.simulate import SimulationError, simulate
from freshfield.files import format_table, picture, write_csv

Rows = list[dict[str, Any]]

CAMERAS = 18
# Of D/M/1/0 (thesis 5.2 to 5.5): 1/mu + (C/2) coth(mu C/2).
EXACT_MS = MEAN_MS + PERIOD_MS / 2 / math.tanh(PERIOD_MS / MEAN_MS / 2)


def measure(quick: bool = False, seed: int = 0) -> Rows:
    """The table; seeds count from ``seed`` on. quick: fewer seeds and shorter runs, for seconds instead of a
    minute. Raises SimulationError where numba is missing."""
    return duration(8 if quick else 24, 1000.0 if quick else 10_000.0, seed)


def duration(repeats: int, longest_s: float, seed: int = 0) -> Rows:
    """Root mean square error of the mean age of 18 cameras, over ``repeats`` seeds, against duration."""
    _age(1.0, seed)  # compiles
    rows = []
    seconds = 1.0
    while seconds <= longest_s:
        begun = time.perf_counter()
        found = np.array([_age(seconds, seed + k) for k in range(repeats)])
        rows.append({
            "seconds": seconds, "cameras": CAMERAS, "repeats": repeats, "exact_ms": EXACT_MS,
            "rms_error_pct": 100 * float(np.sqrt(np.mean((found / EXACT_MS - 1) ** 2))),
            "wall_ms": (time.perf_counter() - begun) / repeats * 1e3,
        })  # fmt: skip
        seconds *= 10**0.5
    return rows


def show(rows: Rows) -> str:
    """The table for a person."""
    return f"rms error of the mean age against seconds simulated (chapter 5)\n{format_table(rows)}"


def write(rows: Rows, out: Path) -> list[Path]:
    """OUT/accuracy-duration.csv and OUT/accuracy.png. Raises PlotError without matplotlib."""
    table, drawing = out / "accuracy-duration.csv", out / "accuracy.png"
    write_csv(table, rows)
    error = [r["rms_error_pct"] for r in rows]
    with picture(drawing, 1, 1, size=(5, 4)) as ((axes,),):
        axes.loglog([r["seconds"] for r in rows], error, "o-", label="seconds simulated")
        axes.loglog([r["wall_ms"] / 1e3 for r in rows], error, "s--", label="seconds of computing")
        axes.set(xlabel="seconds", ylabel="rms error of the mean age (%)", title="18 cameras, chapter 5")
        axes.legend()
    return [table, drawing]


def _age(seconds: float, seed: int) -> float:
    """Mean age in ms over the cameras that had a delivery."""
    config = channel_from_mapping({"preset": "ch5"})
    age = simulate(config, CAMERAS, seconds, seed, engine="kernel").mean_age_ms()
    if age is None:
        raise SimulationError(f"nothing was delivered within {seconds:g} s")
    return age
