"""Calibration of several fixed cameras by one target that is held where they see it: lenses and poses."""
