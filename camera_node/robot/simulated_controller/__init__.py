"""A simulated controller of a Universal Robots arm: the real client library connects to it as to a robot.

``motion`` moves the joints, ``recipes`` speaks the binary protocol, ``controller`` answers what a client
asks, ``server`` holds the ports.
"""

TRUTH_PORT = 30010
"""Says where the arm really was; no real controller has it."""
