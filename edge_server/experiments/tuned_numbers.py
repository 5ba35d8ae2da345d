"""Numbers of experiments whose place no file's name tells; those of one command or statistic stand in its file."""

from __future__ import annotations

from typing import Any

# What is scored in virtual time.
SCORED_EVERY_MS = 250.0
"""Publications, and what is shown at random instants, in ``simulate`` and the study of depth."""
CYCLE_MS = 250.0
"""Most between two decisions of ``simulate`` where updates follow a cycle."""
SHOWN_EVERY_MS = 125.0
"""Period of the random instants in ``compare``, ``frontier`` and trainings of running deployments."""
MARKS_S = 2.0
"""Period in which the frames of held-out cameras that move are scored anew."""
SINCE_S = 4.0
"""From which on their scores count: the first seconds are of a field that has seen next to nothing."""
NOISE_FRAMES = 8
"""Of a real camera, whose noise bounds what moves."""

# Training of schedulers.
QUICK_SPLAT: dict[str, Any] = {"gaussians": 4096, "start": 2048}
"""Options with which ``splat`` learns the small images of a training faster than with its defaults: half of its
Gaussians, as many as an image of 64 x 64 has pixels."""

FITS = 2
"""Of every choice, whose mean is less noisy."""

SMOOTHED_BATCHES = 9
"""Batches averaged in a point of the drawn learning curve: single ones differ by more than training changes them."""

# ``frontier``: virtual seconds in which costs are measured, and until what is shown counts.
COSTS_S, LEAD_S = 1.0, 5.0
LAYERS_S = 0.02
"""Shortest update time of layers, as used in scenarios with layers."""
STATIC_STEPS_PER_S = 250.0
"""Of the static field of layers, whose steps run on another core."""

# Viewpoints.
HELD_OUT = 20
"""Held-out viewpoints of a synthetic scene, between the candidates in their sector."""
VIEWS = 8
"""Of a reconstruction that is compared with others, if the budget is only in meters."""
