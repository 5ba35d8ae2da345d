"""Numbers of the training of schedulers."""

from __future__ import annotations

from typing import Any

QUICK_FIELDS: dict[str, dict[str, Any]] = {
    "splat": {"gaussians": 4096, "start": 2048},
    "ngp": {"levels": 6, "log2_table": 14, "batch_samples": 8192, "samples": 96},
}
"""Field -> options with which it learns the small images of a training faster than with its defaults: half of
``splat``'s Gaussians, as many as an image of 64 x 64 has pixels, and a quarter of ``ngp``'s work a step."""

FITS = 2
"""Of every choice, whose mean is less noisy."""

SMOOTHED_BATCHES = 9
"""Batches averaged in a point of the drawn learning curve: single ones differ by more than training changes them."""
