"""What scoring one image costs: PSNR, SSIM, moving pixels, LPIPS and all of them together."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.experiments.common.machine_load import Usage
from edge_server.fidelity.lpips import Lpips
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.moving_pixels import moving_mask
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.scorer import Scorer
from edge_server.fidelity.ssim import ssim

SIZES = (128, 256)


def measure(quick: bool, folder: Path, lpips: Path | None = None) -> dict[str, Any]:
    """Median milliseconds of each metric by image size."""
    del folder
    metric, missing = open_lpips(lpips)
    found = {str(size): _of_size(size, metric, 5 if quick else 25) for size in SIZES}
    return {"lpips_missing": missing, **found}


def _of_size(size: int, metric: Lpips | None, repeats: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (size, size, 3), dtype=np.uint8)
    earlier = [rng.integers(0, 256, truth.shape, dtype=np.uint8) for _ in range(4)]
    shown = np.clip(truth / 255.0 + rng.normal(0, 0.05, truth.shape), 0, 1).astype(np.float32)
    scorer = Scorer(metric)
    work: dict[str, Callable[[], Any]] = {
        "psnr_ms": lambda: psnr(shown, truth),
        "ssim_ms": lambda: ssim(shown, truth),
        "moving_mask_ms": lambda: moving_mask(truth, earlier),
        "score_ms": lambda: scorer.score("c", shown, 0, truth, 0, earlier),
    }
    if metric is not None:
        work["lpips_ms"] = lambda: metric(shown, truth)
    usage = Usage("bench")
    found: dict[str, Any] = {name: _median_ms(task, repeats) for name, task in work.items()}
    return {**found, "outside_cores": usage.outside(usage.row(0.0))}


def _median_ms(task: Callable[[], Any], repeats: int) -> float:
    task()  # libraries load and allocate at the first call
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        task()
        spent.append((time.perf_counter() - began) * 1e3)
    return statistics.median(spent)
