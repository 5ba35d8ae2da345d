"""Intrinsic calibration of a lens from pictures of a target."""
