"""Calibration of a camera's lens and of its pose on an arm (thesis 4.3), with its uncertainty.

A node that streams runs none of this. It loads the files that these commands write.
"""

from __future__ import annotations

DEFAULT_METHOD = "refined"  # here because the command line shows it without scipy


class CalibrationError(ValueError):
    """The data do not determine a calibration. The message says why and what to do."""
