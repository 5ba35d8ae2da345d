"""Measures the time to embed a frame, compared with ONNX Runtime alone on the same part of the same model."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.embed import MODELS, EmbeddingConfig, EmbeddingError, SizeError, make_embedder
from edge_server.experiments.bench.run import BenchError, BenchRun
from edge_server.experiments.common.tables import markdown_table
from freshfield.machine_load import LoadMeter

SIZES = (128, 320)
BATCHES = (1, 18)  # one camera, and a whole rig
# Image size (height, width) of a camera whose frames do not have the model's size.
CAMERA = (480, 640)
DIM = 32
_WARM_UP = 3  # rounds that are not counted, because they allocate memory
# Figures of a row of the table and their decimals.
_COLUMNS = (
    ("embed_ms", 3),
    ("runtime_ms", 3),
    ("ratio", 2),
    ("cpu_ratio", 2),
    ("camera_ms", 3),
    ("camera_ratio", 2),
    ("camera_cpu_ratio", 2),
)


def measure(run: BenchRun) -> dict[str, Any]:
    """Median milliseconds per frame by model, size and batch.

    embed_ms: of frames of the model's size.
    runtime_ms: of ONNX Runtime on prepared input in the same parts, in alternating runs.
    camera_ms: of frames of 640 x 480, which are first fitted into the model's size.
    ratio, camera_ratio: medians over rounds of embed_ms and camera_ms over runtime_ms.
    cpu_ratio, camera_cpu_ratio: the same of processor time, which the load of other processes does not
        affect.
    Raises BenchError if a model cannot be measured.
    """
    repeats = 20 if run.quick else 100
    files = [run.model] if run.model is not None else sorted(MODELS.glob("detector_*.onnx"))
    found: dict[str, Any] = {"threads": 1, "repeats": repeats}
    for path in files:
        of_model = {}
        for size in SIZES:
            try:
                config = EmbeddingConfig(str(path), DIM, size, None, "cpu", threads=1)
                rows = {str(n): _by_batch(config, n, repeats) for n in BATCHES}
            except SizeError:
                continue  # exported for another size only
            except EmbeddingError as error:
                raise BenchError(str(error)) from None
            of_model[str(size)] = rows
        if not of_model:
            raise BenchError(f"{path}: takes images of neither {SIZES[0]} nor {SIZES[1]} pixels a side")
        found[path.stem] = of_model
    return found


def _by_batch(config: EmbeddingConfig, n: int, repeats: int) -> dict[str, Any]:
    embedder = make_embedder(config)
    backbone = embedder.backbone
    rng = np.random.default_rng(0)
    frames = _images(rng, n, backbone.height, backbone.width)
    larger = _images(rng, n, *CAMERA)
    ready = rng.random((n, 3, backbone.height, backbone.width)).astype(backbone.dtype)
    step = embedder.step
    parts = [ready[first : first + step] for first in range(0, n, step)]
    if backbone.batch is not None:
        parts[-1] = np.resize(parts[-1], (backbone.batch, *ready.shape[1:]))

    def alone() -> None:
        for part in parts:
            embedder.run(part)

    load = LoadMeter()
    spent = _in_turn(
        {"embed": lambda: embedder.embed(frames), "runtime": alone, "camera": lambda: embedder.embed(larger)}, repeats
    )
    ms = {f"{name}_ms": statistics.median(wall for wall, _ in rows) / n for name, rows in spent.items()}
    ratios = {}
    for name, prefix in (("embed", ""), ("camera", "camera_")):
        rounds = list(zip(spent[name], spent["runtime"]))
        ratios[f"{prefix}ratio"] = statistics.median(a[0] / b[0] for a, b in rounds)
        ratios[f"{prefix}cpu_ratio"] = statistics.median(a[1] / b[1] for a, b in rounds)
    return {**ms, **ratios, "outside_cores": load.outside_cores()}


def _in_turn(work: dict[str, Callable[[], Any]], repeats: int) -> dict[str, list[tuple[float, float]]]:
    """(milliseconds, processor milliseconds) of each run. All take turns, so that the load of other processes
    affects them equally, and the order changes every round, because a busy system tends to interrupt what has
    been running long."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in work}
    names = list(work)
    for k in range(repeats + _WARM_UP):
        for i in range(len(names)):
            name = names[(i + k) % len(names)]
            began, cpu = time.perf_counter(), time.process_time()
            work[name]()
            if k >= _WARM_UP:
                row = (time.perf_counter() - began, time.process_time() - cpu)
                spent[name].append((row[0] * 1e3, row[1] * 1e3))
    return spent


def _images(rng: np.random.Generator, n: int, height: int, width: int) -> list[NDArray[np.uint8]]:
    return list(rng.integers(0, 256, (n, height, width, 3), dtype=np.uint8))


def table(figures: dict[str, Any]) -> str:
    """A row for each model, size and batch."""
    rows = [
        (name, size, n, *(f"{row[key]:.{digits}f}" for key, digits in _COLUMNS), row["outside_cores"])
        for name, sizes in figures.items()
        if isinstance(sizes, dict)
        for size, batches in sizes.items()
        for n, row in batches.items()
    ]
    head = (
        "model",
        "size",
        "batch",
        "embed",
        "ONNX Runtime",
        "ratio",
        "CPU ratio",
        "of 640 x 480",
        "its ratio",
        "its CPU ratio",
        "outside cores",
    )
    about = f"ms a frame, medians of {figures['repeats']} runs in turn, {figures['threads']} thread(s)"
    return f"{about}\n\n{markdown_table(head, rows)}"
