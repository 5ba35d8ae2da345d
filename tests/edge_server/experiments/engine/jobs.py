"""Work for the tests of the engine, in a module of its own: processes import it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Point:
    """A seed and a size, and the scene that points share."""

    seed: int
    size: int = 100
    scene: str = "room"


def measure(point: Point) -> dict[str, Any]:
    """Last bits, a tuple and a number that is none, all of which have to come back alike."""
    values = np.random.default_rng(point.seed).normal(size=point.size)
    return {"mean": values.mean(), "ends": (float(values[0]), float(values[-1])), "none": float("nan")}


def note(point: Point, folder: Path) -> int:
    """The process that computes it; leaves a file for each call."""
    (folder / f"{time.monotonic_ns()}-{point.scene}-{point.seed}.call").touch()
    return os.getpid()


def fail(point: Point) -> int:
    """Seed 3 fails."""
    if point.seed == 3:
        raise ValueError(f"seed {point.seed} cannot be computed")
    return point.seed


def sleep(point: Point, folder: Path) -> int:
    """Seed 0 at once, others never within the test."""
    (folder / f"started-{point.seed}-{os.getpid()}").touch()
    if point.seed:
        time.sleep(600.0)
    return point.seed
