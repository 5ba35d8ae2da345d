"""Numbers of the training of schedulers."""

from __future__ import annotations

from typing import Any

QUICK_SPLAT: dict[str, Any] = {"gaussians": 4096, "start": 2048}
"""Options with which ``splat`` learns the small images of a training faster than with its defaults: half of its
Gaussians, as many as an image of 64 x 64 has pixels."""

FITS = 2
"""Of every choice, whose mean is less noisy."""

SMOOTHED_BATCHES = 9
"""Batches averaged in a point of the drawn learning curve: single ones differ by more than training changes them."""
