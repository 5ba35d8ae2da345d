"""Time of scoring one image: PSNR, SSIM, moving pixels, LPIPS and all of them together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from edge_server.experiments.bench.run import BenchRun
from edge_server.experiments.common.machine_speed import median_s
from edge_server.fidelity.lpips import Lpips
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.moving_pixels import moving_mask
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.scorer import Scorer
from edge_server.fidelity.ssim import ssim
from freshfield.machine_load import LoadMeter

SIZES = (128, 256)


def measure(run: BenchRun) -> dict[str, Any]:
    """Median milliseconds of each metric by image size."""
    metric, missing = open_lpips(run.lpips)
    found = {str(size): _by_metric(size, metric, 5 if run.quick else 25) for size in SIZES}
    return {"lpips_missing": missing, **found}


def _by_metric(size: int, metric: Lpips | None, repeats: int) -> dict[str, Any]:
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
    load = LoadMeter()
    found: dict[str, Any] = {name: 1e3 * median_s(repeats, task) for name, task in work.items()}
    return {**found, "outside_cores": load.outside_cores()}
