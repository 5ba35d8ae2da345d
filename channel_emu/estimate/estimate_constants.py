"""Numbers of the fit of a channel to a recording."""

from __future__ import annotations

# --- what is fitted (fit, recording, two_states) ---
MIN_DELAYS = 20  # least number of delays that a fit needs; for two states it takes hundreds
MOST_OVERLAPPING = 0.02  # tolerated share of frames that seem to be offered to a busy drop-new link
# A state with fewer frames or fewer visits counts as outliers.
MIN_FRAMES, MIN_VISITS = 10.0, 3.0
# A camera is periodic if more than PERIODIC_SHARE of its gaps are within NEAR_MEDIAN of their median, relatively.
# Exponential gaps are so with probability .17, a periodic camera's nearly always.
NEAR_MEDIAN, PERIODIC_SHARE = 0.25, 0.5
CONSTANT_CV = 0.01  # standard deviation over mean, up to which delays count as constant
NO_LOSS = 1e-6  # a smaller chance of a loss is none
MIN_SHAPE, MAX_SHAPE = 0.05, 1e4  # bounds of the shape of the gamma distribution of delays

# --- what is said of it (fit, report) ---
BOOTSTRAP_SAMPLES = 40  # from which the intervals of the parameters are estimated
# Kolmogorov-Smirnov distance times sqrt(n) to the delays that the fit draws: the 1 % level, with a margin.
MISFIT = 2.0
# With a larger standard deviation of its logarithm (an interval of e^10 each way) a parameter has no interval.
MAX_LOG_SD = 5.0
DRAWN_FRAMES = 2000  # the picture shows at most so many frames, the first ones

# --- the search for two states (fit, two_states) ---
# Searches begin with sojourns of START_FRAMES frames, and take START_STEPS steps on the first START_SEGMENTS segments.
START_FRAMES, START_STEPS, START_SEGMENTS = (5, 50, 500), 8, 80
# They begin with means and losses of the two states that are START_CONTRAST times those of all frames; a loss is at
# most START_MOST_LOSS.
START_CONTRAST, START_MOST_LOSS = (0.6, 1.6), 0.99
SEGMENT_FRAMES = 256  # frames of a segment, taken as independent of those of the segment before
# Most steps, the gain of log likelihood that ends them, and how far a leap may go, in steps.
MOST_STEPS, TOLERANCE, MAX_REACH = 100, 3e-3, 64.0
SAMPLE_STEPS = 40  # most steps of each bootstrap sample, which starts at the fit
# Most frames of all samples together that are computed at once: some 200 MB.
MOST_AT_ONCE = 500_000
