"""Numbers of fidelity."""

from __future__ import annotations

# --- scores (psnr) ---
# PSNR of equal images: (3.31) is infinite there, and an infinity would spoil every mean. An error below 1e-10
# of the squared range is far below the resolution of 8-bit images.
PSNR_CEILING_DB = 100.0

# --- which pixels move (moving_pixels, scorer) ---
MOVING_LAGS_MS = (60.0, 120.0, 200.0, 300.0)  # an image is compared with those so much earlier
MOVING_BOUND = 0.03  # difference in some channel, of [0, 1], beyond which a pixel moves, on truth without noise
# On real video the bound is so many standard deviations of the camera's noise, if that is more.
MOVING_NOISE_SIGMAS = 4.0
# Largest standard deviation of noise, of [0, 1]; larger estimates count as this one. No usable camera is noisier: a
# larger estimate means that the camera itself moves.
NOISE_LIMIT = 0.05
NOISE_PAIRS = 32  # newest pairs of frames from which noise is estimated

# --- a moving held-out camera's frames so far (so_far) ---
SO_FAR_FRAMES = 64  # that are kept: at the end of a run each is rendered, 10 ms at 320 x 240
