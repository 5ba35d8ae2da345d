"""Numbers of the simulated controller that no option sets.

Its steps are of ``joint_motion.STEP_S``, as the real controller's.
"""

from __future__ import annotations

# --- motion (joint_motion) ---
MAX_ACCELERATION_RAD_S2 = 40.0  # bound of every command; UR's default for moveJ is 1.4
STOP_RAD_S2 = 10.0  # deceleration of a stop that gives none
SERVO_WITHOUT_COMMAND_S = 0.2  # after which an arm that follows targets stops

# --- time (controller) ---
HISTORY_STEPS = 10_000  # of true joint angles that are kept: 20 s
# Steps that are made up for. After a longer pause of the machine the arm continues from where it was.
MAX_CATCH_UP_STEPS = 5_000

# --- ports (server, camera_node.robot.flange_camera) ---
IDLE_STEPS = 4  # most steps between two looks at the clock; fewer where a client asks for states more often
MAX_WAITING_BYTES = 1 << 20  # for a client that does not read; beyond them it loses samples
READ_BYTES = 1 << 16  # read at once of a program, which is not interpreted
TRUTH_TIMEOUT_S = 1.0  # longest wait for the answer to a question for the true joint angles
