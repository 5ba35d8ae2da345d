"""Numbers of teleoperation that no scenario sets."""

from __future__ import annotations

# --- styluses (stylus, one_euro_filter) ---
STEP_M, STEP_RAD = 0.005, 0.02  # move and turn of one press of a key
FARTHEST_M = 10.0  # positions of a stylus farther from its origin are invalid
LEAST_NORM, MOST_NORM = 0.5, 2.0  # bounds of the length of a valid quaternion, which is then made to have length 1
MAX_MESSAGES = 64  # that are read of a network stylus at a tick, so that a flood does not delay the arm
OWNED_NS = 1_000_000_000  # silence after which another sender counts
SPEED_HZ = 2.0  # cutoff of the filter of the speed itself
LEAST_STEP_S, MOST_STEP_S = 1e-4, 0.5  # bounds of the time between two samples: others come from a faulty clock

# --- motion (damped_least_squares, limits) ---
# Damping distorts the flange's direction, so it is applied only near a singularity, where the Jacobian's least
# singular value falls below DAMPING_THRESHOLD (Maciejewski and Klein 1988).
DAMPING, DAMPING_THRESHOLD = 0.05, 0.08
STEP_FRACTIONS = (1.0, 0.5, 0.2)  # of the wanted change of speed, which are tried before the arm stops

# --- the arm and the operator (sinks, teleop_command) ---
# servoJ's own filter: lookahead time and gain (UR's script manual: 0.03 to 0.2 s, 100 to 2000). The gain is
# the lowest that still follows well, because the targets are smooth already.
LOOKAHEAD_S, SERVO_GAIN = 0.1, 300.0
MAX_LAG_RAD = 0.35  # an arm that is farther behind its target is held by something, or has stopped
SHOW_S = 0.5  # time between two lines for the operator
LONGEST_STOP_S = 3.0  # within the limits of ``TeleopConfig`` no stop takes longer
