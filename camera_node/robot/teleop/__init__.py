"""Teleoperation: an operator moves the arm with a stylus (thesis 4.2.1, 4.4.1).

stylus -> filter -> scaled map with clutch -> joint speeds -> limits -> arm

No input is trusted: ``limits`` allows only joint speeds from which the arm can still stop within all of its
limits.
"""
