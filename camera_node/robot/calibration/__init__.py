"""Calibration of a camera's lens and of its place on an arm (thesis 4.3), and what it is worth.

Nothing here runs in a node that streams: the node loads the files that these commands write.
"""

from __future__ import annotations

# Defaults of the hand-eye calibration, here because the command line shows them without scipy.
DEFAULT_METHOD = "refined"
MAX_GAP_S = 0.05  # between a target pose and the nearest hand pose that it is paired with
WANT_MM = 0.5  # a guided session ends when the standard deviation of the translation is below this


class CalibrationError(ValueError):
    """The data do not determine a calibration; the message says why and what to do."""


class ArmStopped(Exception):
    """The arm of a session stopped and cannot be moved on; the message says why."""
