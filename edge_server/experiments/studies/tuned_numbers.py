"""Numbers of all studies.

The sizes of a quick and a full pass stand in ``trial``, what a study of trials sweeps in its file.
"""

from __future__ import annotations

LEAST_DB = 0.1
"""Smallest difference that supports a claim."""

PLATEAU_NEAR = {
    "psnr_db": 0.3,
    "psnr_moving_db": 0.3,
    "shown_psnr_db": 0.3,
    "shown_psnr_moving_db": 0.3,
    "ssim": 0.01,
    "lpips": 0.01,
}
"""A curve is on its plateau if it is this near to its best value."""

TRIAL_FPS = 100 / 3
"""Of synthetic scenes: the thesis's capture period of 30 ms."""

TRIAL_PATIENCE = 20
"""Times ``every_ms``, until a trial has failed."""

FIRST_DECISION_MS = 900.0
"""Least instant of a trial's first decision."""

STAGGER_MS = 217.0
"""Between the decision instants of successive seeds; not whole frames, so seeds sample all capture phases."""

SHOWN_INSTANTS = 3
"""Random instants at which a publication of a trial is scored, one in each equal part of the time it is shown."""

DEPTH_SECONDS = {True: 6.0, False: 12.0}
"""Length of a run with depth, by whether it is a quick pass."""

DEPTH_SCORED_FROM = 2.0 / 3.0
"""Of such a run: layers have begun by then."""

TRAININGS = {True: 1, False: 3}
"""Repeated trainings, by whether it is a quick pass; their spread is part of the interval."""
