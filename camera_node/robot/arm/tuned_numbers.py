"""The numbers of driving an arm: when its state is too old, how it is stopped, which postures and moves are allowed."""

from __future__ import annotations

# Joint states. PROBE_S: a controller answers within it. CONNECT_S: it sends states. STALE_S: an older state is not
# believed; a simulated arm hits nothing, and its machine may be busy.
PROBE_S, CONNECT_S, STALE_S, SIMULATED_STALE_S = 2.0, 2.5, 0.5, 10.0
BACKOFF_S = (0.25, 0.5, 1.0, 2.0, 5.0)  # pauses between attempts to connect

POLL_SHARE = 0.25  # of the time between two states: how often the library is asked for a new one
NEXT_STATE_S, NEXT_STATE_POLL_S = 0.03, 0.001  # wait for the state after a frame, which interpolation needs
JOIN_S = 2.0  # for the reading thread to end
DRIVE_HZ = 50.0  # joint states a second of an arm that is driven through a tour

# Moving. CONTROL_S: longest connection of the control interface. STOPPING_S: a stop is waited for so long.
CONTROL_S, STOPPING_S = 8, 5.0
STOP_RAD_S2 = 2.0  # deceleration of every stop
ARRIVED_RAD, POLL_S = 1e-3, 0.05
STALLED_S, STALLED_RAD = 5.0, 1e-3  # within this time even a slow arm turns by more than its encoder noise
MOVED_RAD = 0.01  # by hand, between what was shown to the operator and the answer

# Tours of viewpoints.
FARTHEST_RAD = 2.0  # largest turn of a joint in one move
CHECKED_POSTURES = 24  # along a path
LEAST_VIEWPOINTS = 3
TOOL_M, TOOL_RADIUS_M = 0.08, 0.04  # as in TeleopConfig: the camera and its mount
MARGIN_M = 0.01  # between parts of the arm, whose capsules are rounded up
SINGULAR_DEG, SINGULAR_M = 5.0, 0.02  # of the elbow and the wrist; of the wrist's center from the base's axis

# camera-node doctor.
LISTEN_S = 0.5
LEAST_STATES = 0.8  # of the joint states asked for; with fewer, the network or the machine is busy
LEAST_REACHED = 0.6  # of a tour's viewpoints; with fewer, a side of the target stays unseen
