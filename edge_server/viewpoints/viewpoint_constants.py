"""Numbers of planning viewpoints, and of learning what somebody prefers."""

from __future__ import annotations

# --- candidates (candidates) ---
MOST_CANDIDATES = 10_000  # of a plan
CANDIDATE_ELEVATIONS_DEG = 12.0, 80.0  # between which they lie

# --- the policy over candidates, by PPO (policy) ---
POLICY_VIEWS = 8  # of an episode
POLICY_UPDATES, POLICY_EPISODES = 60, 16  # updates of a training; episodes for each
# Cost of a way as long as the candidates' mean distance from the target, in standard deviations of a step's reward.
WAY = 0.4
POLICY_HIDDEN, POLICY_RATE = 32, 3e-3  # width of all layers; learning rate of Adam
# Passes over a batch of captures, fewer than the schedulers' 10: new captures cost predictions of the reward, no fits.
PASSES = 4
ENTROPY = 0.01  # weight of the policy's entropy in the loss, where rewards are in standard deviations of a step's
ANY_KL = 1e9  # nats that a pass may move the policy: passes never end early
STEP_MS = 1000.0  # age of a view after one step, in the unit of the schedulers' state
CLOSED = -1e9  # logit of a candidate that was visited or cannot be reached: its probability is 0 in float32

# --- geometric coverage of an object (geometric) ---
SAMPLES_A_SIDE = 8  # points along each side of a face of the object's box
ALIKE_RAD = 0.5  # the likeness of two views this far apart is exp(-1), for small angles
MOST_WANTED = 128  # directions to cover; with more candidates, only every second, third, ... counts
# How far an object of unknown size reaches from the target, as a share of the distance to the nearest camera.
UNKNOWN_SIZE = 0.3

# --- Fisher information of splats (fisher) ---
# Random images from whose gradients the information is estimated; each takes a step's time. With 8 of them candidates
# are ordered as by the exact information (rank correlation .94 and .99 after 2 and 5 views of ``tile``, with 4 .82 and
# .98).
RANDOM_IMAGES = 8
# Prior information about a parameter, as a share of what the views give on average over all Gaussians: that has the
# parameter's unit, and bounds the value of an unseen Gaussian. With a share of .01 the views go to the edge of the
# dome: on four captures of ``tile``, 8 views gave 19.8 dB, and with 1, 22.2 dB.
PRIOR = 1.0

# --- how people are asked for preferences (preference_session) ---
# After so many questions an earlier pair is repeated with its sides swapped: that reveals who answers by the side, or
# by chance.
REPEAT_EVERY = 6
REMEMBERED = 2  # latest pairs, which people remember: none of them is repeated

# --- what their answers tell (preference_model) ---
# Widths of the prior (standard deviations of the weights) that the evidence chooses from. By the scale of the features,
# a width is also the standard deviation of the reward difference of a usual pair.
WIDTHS = (0.1, 0.3, 1.0, 3.0, 10.0)
NEWTON_STEPS = 50  # at most, to the most probable weights
# Odds against a coin from which on answers count as informative. Answers by a coin reach them at most once in so many
# times (Markov's inequality, for exact evidence).
LEAST_ODDS = 10.0

# --- what step features and simulated experts look at (features, experts) ---
# Widths of the likeness of two directions, exp(-(angle / width)^2): fine detail needs near views, the whole any.
LIKENESS_RAD = (0.25, 0.5, 1.0)
OBJECT_DIFFERS = 0.08  # a pixel shows the object if its color differs from the background's by more, of [0, 1]
DETAIL_PX = 2.0  # sigma of a Gaussian blur: what it removes is fine detail
