"""Calibration of a camera's lens and of its pose on an arm (thesis 4.3), with its uncertainty.

A node that streams runs none of this. It loads the files that these commands write.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from freshfield import payload as payload  # sets OpenCV's size limit before what reads pictures imports cv2

DEFAULT_METHOD = "refined"  # here because the command line shows it without scipy


class CalibrationError(ValueError):
    """The data do not determine a calibration. The message says why and what to do."""


def require_one_input(args: Any, inputs: Mapping[str, str], goes_with: Mapping[str, Sequence[str]]) -> str:
    """The input that is given, of ``inputs`` (its option -> its name in the help). Raises CalibrationError unless one
    is, and only options that it uses. goes_with: option -> inputs that use it."""
    given = [name for name in inputs if getattr(args, name) is not None]
    if len(given) != 1:
        raise CalibrationError(f"expected one of {', '.join(inputs.values())}")
    for option, used_by in goes_with.items():
        if getattr(args, option) is not None and given[0] not in used_by:
            names = " or ".join(inputs[name] for name in used_by)
            raise CalibrationError(f"--{option}: goes with {names}, not with {inputs[given[0]]}")
    return given[0]
