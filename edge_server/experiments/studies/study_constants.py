"""Numbers of all studies; the sizes of a quick and a full pass stand in ``trial``, what a study sweeps in its file."""

from __future__ import annotations

# --- claims (verdicts, waiting_curves) ---
LEAST_DB = 0.1  # smallest difference of PSNR that supports a claim
# A curve is on its plateau if it is this near to its best value: dB, or the metric's own unit.
PLATEAU_NEAR = {
    "psnr_db": 0.3,
    "psnr_moving_db": 0.3,
    "shown_psnr_db": 0.3,
    "shown_psnr_moving_db": 0.3,
    "ssim": 0.01,
    "lpips": 0.01,
}

# --- trials (trial) ---
TRIAL_FPS = 100 / 3  # frames a second of synthetic scenes: the thesis's capture period of 30 ms
TRIAL_PATIENCE = 20  # a trial has failed after so many times ``every_ms``
FIRST_DECISION_MS = 900.0  # least instant of a trial's first decision
STAGGER_MS = 217.0  # between those of successive seeds; not whole frames, so seeds sample all capture phases
# Random instants at which a publication of a trial is scored, one in each equal part of the time it is shown.
SHOWN_INSTANTS = 3

# --- passes: True is the quick one, False the full one (depth_rate, learning) ---
DEPTH_SECONDS = {True: 6.0, False: 12.0}  # length of a run with depth
DEPTH_SCORED_FROM = 2.0 / 3.0  # share of such a run after which it is scored: layers have begun by then
TRAININGS = {True: 1, False: 3}  # repeated trainings; their spread is part of the interval
