"""Numbers of planning viewpoints and of learning what somebody prefers."""

from __future__ import annotations

# Candidates.
MOST_CANDIDATES = 10_000
CANDIDATE_ELEVATIONS_DEG = 12.0, 80.0
"""Between which they lie."""

# The policy over candidates (PPO).
PASSES = 4
"""Over a batch of captures, fewer than the schedulers' 10: new captures cost predictions of the reward, no fits."""
ENTROPY = 0.01
"""Its weight in the loss, where rewards are in standard deviations of a step's."""
ANY_KL = 1e9
"""Nats that a pass may move the policy: passes never end early."""
STEP_MS = 1000.0
"""Age of a view after one step, in the unit of the schedulers' state."""
CLOSED = -1e9
"""Logit of a candidate that was visited or cannot be reached: its probability is 0 in float32."""

# Geometric coverage of an object.
SAMPLES_A_SIDE = 8
"""Points along each side of a face of the object's box."""
ALIKE_RAD = 0.5
"""The likeness of two views this far apart is exp(-1), for small angles."""
MOST_WANTED = 128
"""Directions to cover; with more candidates, only every second, third, ... counts."""
UNKNOWN_SIZE = 0.3
"""An object of unknown size is assumed to reach this far from the target, as a share of the distance to the nearest
camera."""

# Fisher information of splats.
RANDOM_IMAGES = 8
"""From whose gradients the information is estimated, each of which takes a step's time. With 8 of them candidates are
ordered as by the exact information (rank correlation .94 and .99 after 2 and 5 views of ``tile``, with 4 .82 and
.98)."""
PRIOR = 1.0
"""Prior information about a parameter, as a share of what the views give on average over all Gaussians: that has the
parameter's unit, and bounds the value of an unseen Gaussian. With a share of .01 the views go to the edge of the dome:
on four captures of ``tile``, 8 views gave 19.8 dB, and with 1, 22.2 dB."""

# Preferences: how people are asked, and what their answers tell.
REPEAT_EVERY = 6
"""After so many questions an earlier pair is repeated with its sides swapped: that reveals who answers by the side, or
by chance."""
REMEMBERED = 2
"""Of the latest pairs, which people remember, none is repeated."""
WIDTHS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Of the prior (standard deviations of the weights), that the evidence chooses from. By the scale of the features, a
width is also the standard deviation of the reward difference of a usual pair."""
NEWTON_STEPS = 50
"""At most, to the most probable weights."""
LEAST_ODDS = 10.0
"""Against a coin, from which on answers count as informative. Answers by a coin reach them at most once in so many
times (Markov's inequality, for exact evidence)."""

# What step features and simulated experts look at.
LIKENESS_RAD = (0.25, 0.5, 1.0)
"""Widths of the likeness of two directions, exp(-(angle / width)^2): fine detail needs near views, the whole any."""
OBJECT_DIFFERS = 0.08
"""Difference of a color from the background's, from which a pixel shows the object."""
DETAIL_PX = 2.0
"""What a blur of this width removes is fine detail."""
