"""A simulated controller of a Universal Robots arm, to which the real client library connects as to a robot.

``joint_motion`` moves the joints, ``rtde_protocol`` is the binary protocol, ``controller`` executes commands,
``server`` serves the ports.
"""

TRUTH_PORT = 30010
"""Tells the arm's true joint angles. No real controller has it."""
