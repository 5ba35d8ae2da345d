"""Constants of learned scheduling: defaults of a specification, and constants that no specification sets."""

from __future__ import annotations

# --- rewards (rewards) ---
# Weights of (6.37) as 6.5 prints them: PSNR per dB, SSIM, LPIPS, age per millisecond.
W_P, W_S, W_L, W_T = -0.02, 0.2, 0.3, 0.015
SET_P, SET_S, SET_L = 0.02, 0.5, -1.0  # weights of (5.19), from 5.6.2: PSNR per dB, SSIM, LPIPS

# --- default actions of a training (experiments.training, .studies, .rollouts) ---
WAITS_MS = (0.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0, 120.0, 200.0, 300.0)  # how long to wait, omega of (6.34)
# The same by the kind of action; omega of (6.39) is a threshold.
OMEGAS_MS = {
    "threshold": (20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 150.0, 200.0, 300.0, 500.0),
    "wait": WAITS_MS,
    "wait-arrived": WAITS_MS,
}

# --- features of a state (state) ---
# Features are clipped to this many standard deviations: values beyond are broken, not information.
FEATURE_LIMIT = 8.0
# Ages are clipped to OLDEST_MS and enter as log(1 + age / AGE_SCALE_MS): fine where they differ by a frame.
AGE_SCALE_MS, OLDEST_MS = 100.0, 60_000.0
# Least standard deviation that a feature is divided by, as a share of the largest feature, or of 1 if that is more:
# scaling must not amplify a feature that hardly varied in the data it was standardized on.
MIN_SPREAD = 1e-3

# --- learning: defaults of a specification (learner_spec) ---
HIDDEN = 64  # width of all layers
LEARNING_RATE, MINIBATCH = 3e-3, 64  # of a step of Adam: its rate, and decisions that it averages over
MAX_GRADIENT = 0.5  # bound of the gradient's norm
CLIP = 0.2  # epsilon of (5.23): probability ratios are clipped to 1 - epsilon ... 1 + epsilon
PASSES, TARGET_KL = 10, 0.05  # passes over a batch; they end early once the policy has moved by this many nats
ENTROPY, VALUE = 0.003, 0.5  # weights in the loss: of the policy's entropy, and of the value's error

# --- learning: what no specification sets (ppo) ---
# Advantages that differ by less than this share of the rewards' standard deviation are errors of V.
# Normalization does not scale them up to 1.
MIN_ADVANTAGE_STD = 0.05
# Number of decisions in the running statistics, which thereby follow a changing scene or channel.
REMEMBERED_DECISIONS = 4096

# --- limits of a policy's file (learner_spec, state, actor, ppo) ---
# Width of its layers, number of its waiting times, weights of its first layer: these bound what is allocated. With both
# networks and Adam's moments that is half a gigabyte, far more than a decision needs.
MAX_HIDDEN, MAX_OMEGAS, MAX_FIRST_WEIGHTS = 1024, 4096, 2**22
MAX_STATE_DIM = 4096  # width of the embedding in a state: the widest that can be configured
MAX_LEARNER_BYTES = 2**29  # its unpacked size: both networks and Adam's moments at their largest

# --- decisions on disk, and their explanation (decision_record, explain) ---
KEPT_DECISIONS = 500  # latest decisions of a run that stay on disk
KEPT_DECISIONS_BYTES = 64_000_000  # most that they take together: beyond it, fewer stay
REGIONS_A_SIDE = 8  # regions per image side, whose shares in a decision are found by occluding them
