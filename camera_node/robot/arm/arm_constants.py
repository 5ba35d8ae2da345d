"""Numbers of driving an arm: when its state is too old, how it is stopped, which postures and moves are allowed."""

from __future__ import annotations

# --- joint states (joint_states, rtde_process, control) ---
# PROBE_S: a controller answers within it. CONNECT_S: the first state comes within it. STALE_S: an older state is not
# believed. SIMULATED_STALE_S: the same of a simulated arm, which hits nothing, and whose machine may be busy.
PROBE_S, CONNECT_S, STALE_S, SIMULATED_STALE_S = 2.0, 2.5, 0.5, 10.0
BACKOFF_S = (0.25, 0.5, 1.0, 2.0, 5.0)  # pauses between attempts to connect: after the first failure, the second, ...
POLL_SHARE = 0.25  # of the time between two states: how often the library is asked for a new one
# Longest wait for the state after a frame, which interpolation needs, and time between two looks for it.
NEXT_STATE_S, NEXT_STATE_POLL_S = 0.03, 0.001
JOIN_S = 2.0  # for the reading thread to end
DRIVE_HZ = 50.0  # joint states a second of an arm that is driven through a tour

# --- moving (control, drive_arm_command, camera_node.robot.teleop.sinks) ---
# CONTROL_S: the control interface has to connect within it. STOPPING_S: a stop is waited for so long.
CONTROL_S, STOPPING_S = 8, 5.0
STOP_RAD_S2 = 2.0  # deceleration of every stop
# A goal is reached when no joint is farther from it than ARRIVED_RAD. POLL_S: time between two looks at that.
ARRIVED_RAD, POLL_S = 1e-3, 0.05
# An arm stands still if no joint turns by more than STALLED_RAD for STALLED_S: in this time even a slow arm turns by
# more than its encoder noise.
STALLED_S, STALLED_RAD = 5.0, 1e-3
# Largest turn of a joint by hand that is tolerated between what was shown to the operator and the answer.
MOVED_RAD = 0.01

# --- tours of viewpoints (tour_planning, drive_arm_command, kinematics) ---
FARTHEST_RAD = 2.0  # largest turn of a joint in one move
CHECKED_POSTURES = 24  # along a path, ends included, that have to be free
LEAST_VIEWPOINTS = 3  # that a tour has to reach
TOOL_M, TOOL_RADIUS_M = 0.08, 0.04  # length and radius of the camera and its mount, as in TeleopConfig
MARGIN_M = 0.01  # least gap between parts of the arm, whose capsules are rounded up
SINGULAR_DEG, SINGULAR_M = 5.0, 0.02  # nearness: of elbow and wrist; of the wrist's center to the base's axis
