"""Calibration of a camera's lens and of its place on an arm (thesis 4.3), and what it is worth.

Nothing here runs in a node that streams: the node loads the files that these commands write.
"""

from __future__ import annotations


class CalibrationError(ValueError):
    """Data that no calibration can come from; the message says why and what to do."""


class ArmStopped(Exception):
    """An arm that a session moved and that moves no more; the message says why."""
