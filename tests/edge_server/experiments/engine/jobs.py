"""Work for the tests of the engine, in a module of its own: processes import it."""

import os
import signal
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


def measure_on_ray(point: Point, folder: Path) -> dict[str, Any]:
    """As ``measure``, and not at once. Leaves a file for each call, and the first with seed 3 ends its process."""
    import ray

    known = any(folder.glob(f"call-{point.seed}-{point.scene}-*"))
    node = ray.get_runtime_context().get_node_id()
    (folder / f"call-{point.seed}-{point.scene}-{node}-{time.monotonic_ns()}").touch()
    if point.seed == 3 and not known:
        end_worker(point)
    time.sleep(0.5)
    return measure(point)


def end_worker(point: Point) -> None:
    """As when memory is short."""
    os.kill(os.getpid(), signal.SIGKILL)


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
