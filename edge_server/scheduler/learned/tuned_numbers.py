"""Numbers of learning to schedule that no specification sets."""

from __future__ import annotations

# --- rewards ---
# Weights of (6.37) as 6.5 prints them: PSNR per dB, SSIM, LPIPS, age per millisecond.
W_P, W_S, W_L, W_T = -0.02, 0.2, 0.3, 0.015
SET_P, SET_S, SET_L = 0.02, 0.5, -1.0  # of (5.19), as 5.6.2 has them: PSNR per dB, SSIM, LPIPS

# --- actions: thresholds and waits that are chosen from where a training is told none (learner_spec) ---
WAITS_MS = (0.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0, 120.0, 200.0, 300.0)
OMEGAS_MS = {
    "threshold": (20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 150.0, 200.0, 300.0, 500.0),
    "wait": WAITS_MS,
    "wait-arrived": WAITS_MS,
}

# --- features of a state (state) ---
# Features are clipped to this many standard deviations: what lies beyond is a broken value, not information.
FEATURE_LIMIT = 8.0
# A feature that hardly varied where it was standardized says nothing; scaling must not turn it into noise.
MIN_SPREAD = 1e-3

# --- learning (learner_spec, ppo) ---
HIDDEN = 64  # width of all layers
LEARNING_RATE, MINIBATCH, MAX_GRADIENT = 3e-3, 64, 0.5  # of Adam's steps; bound of the gradient's norm
CLIP = 0.2  # epsilon of (5.23): probability ratios are clipped to 1 - epsilon ... 1 + epsilon
PASSES, TARGET_KL = 10, 0.05  # over a batch; they end early once the policy has moved by so many nats
ENTROPY, VALUE = 0.003, 0.5  # weights of these terms of the loss
# Advantages that differ by less than this share of the rewards' standard deviation are errors of V.
# Normalization does not scale them up to 1.
MIN_ADVANTAGE_STD = 0.05
# Decisions that count in the running statistics, which follow a scene or a channel that changes.
REMEMBERED_DECISIONS = 4096

# --- decisions on disk, and what explains them (decision_record, explain) ---
KEPT_DECISIONS = 500
KEPT_DECISIONS_BYTES = 64_000_000
REGIONS_A_SIDE = 8  # of an image, whose shares are found by occluding them
