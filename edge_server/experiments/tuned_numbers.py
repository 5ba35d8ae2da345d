"""Numbers of experiments; those of the engine and of studies stand in their folders."""

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

PROGRESS_EVERY_S = 1.0
"""Of virtual time, between two lines of progress of ``simulate``."""
FRAME_CACHE_BYTES = 512 * 2**20
"""Encoded frames kept in memory: in virtual time a minute of nineteen cameras passes in seconds."""
COMPARE_LEAD_S, COMPARE_SPAN_S = 5.0, 8.0
"""Of ``compare``, until what is shown counts, and for how long it does. Decisions have no effect until the layers of a
field have begun."""

# ``costs``.
COSTS_SHARES = (0.2, 0.6, 1.0)
"""Steps of an update, as shares of the scenario's."""
COSTS_SETTLED_SHARE, COSTS_SLOWEST_SHARE = 0.5, 0.1
"""The first part of a run builds the field; a busy machine's slowest updates are left out."""
COSTS_EPOCH_MS = 40.0

# Intervals and verdicts over seeds (common.statistics).
RESAMPLES = 2000
FEWEST_SEEDS = 5
"""For resampling; fewer say too little about how seeds differ."""
FALSE_DISCOVERY_RATE = 0.05
"""Expected share of wrong verdicts among those that are decided."""
DRAWN_HEIGHT_PX = 220
"""Of an image in a figure of images side by side."""

# ``fit``, and what it is fitted to.
FIT_MARKS_S, FIT_THEN_EVERY_S, FIT_LAST_SHARE = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0), 30.0, 0.4
"""Seconds after which to evaluate: dense while a field learns fastest, then every 30 s. The last slice is at least this
share of the whole: the learning rate falls within a slice, and a field needs a long one to converge."""
SHORTEST_SLICE_S = 0.05
SCORED_OF_TRAINING = 8
"""Number of training views that are scored if no view is held out."""
MISFIT_DB, MISFIT_DEVIATIONS, LOOKS_RIGHT_DB = 6.0, 4.0, 30.0
"""A view is named that reads so many dB less than the median, and so many standard deviations of them all: some views
of a recording are blurred or show more detail. What reads more than LOOKS_RIGHT_DB fits, whatever the others read."""
MISFITS_NAMED = 5
"""Views; of the others their number is said."""
STILL_SIZE_PX = 128
"""Image width and height of a synthetic scene, before its scale."""
NAMED_VIEWS = 6
"""In an error."""
LEAST_SCORED_WEIGHT = 0.5
"""A pixel whose weight is larger is scored: undistortion and shrinking leave some that are masked in part."""

# Training of schedulers.
INSTANT_GRID_MS = 10
"""Rendering a truth costs ten times a score. Instants lie on a grid that contains the lags of moving pixels (60, 120,
200, 300 ms), so that evaluations share renderings."""
TRUTHS_KEPT = 8192
"""Renderings of held-out cameras kept in memory."""
TRAINING_STEPS, SCRATCH_STEPS = 20, 50
"""Optimizer steps of an update, and of one that starts with an empty field."""

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
STAGE_EMBEDDING_DIM = 8
"""Numbers per image that policies over viewpoints are taught with."""
NEAR_OF_RADIUS = 0.3
"""Least distance of cameras for the field of a capture, in theirs from the target."""
PATH_FRAMES, PATH_COLUMNS = 24, 6
"""Number of images of a reconstruction along the path, and of columns in their common JPEG."""
PATH_WIDEST_PX = 320
PATH_FARTHEST_DEG = 60.0
"""From the middle of the path."""
PATH_JPEG_QUALITY = 92
"""So that its artifacts do not affect the comparison."""
PLAN_SHOWN_S = 10.0
"""Time that the page has to fetch the plan, before the server ends."""
