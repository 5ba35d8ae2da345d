"""An operator's hand moves the arm (thesis 4.2.1, 4.4.1).

stylus -> filter -> scaled map with clutch -> joint speeds -> limits -> arm

What the operator or the stylus does is never trusted: whatever comes in, ``limits`` lets through only joint
speeds from which the arm can still come to rest within all of its limits.
"""

from __future__ import annotations


class TeleopError(ValueError):
    """A stylus, setting or start that teleoperation cannot work with: one line, with what to do."""
