"""Calibration of a camera's lens and of its pose on an arm (thesis 4.3), with its uncertainty.

A node that streams runs none of this. It loads the files that these commands write.
"""

from __future__ import annotations

# Defaults of the hand-eye calibration, here because the command line shows them without scipy.
DEFAULT_METHOD = "refined"
MAX_GAP_S = 0.05  # between a target pose and the nearest flange pose that it is paired with
WANT_MM = 0.5  # a guided session ends when the standard deviation of the translation is below this


class CalibrationError(ValueError):
    """The data do not determine a calibration. The message says why and what to do."""
