"""Numbers of real cameras."""

LIVE_FPS = 15.0
"""Captures a second where a scenario gives no rate."""
REOPEN_AFTER_S = (0.25, 0.5, 1.0, 2.0, 5.0)
"""Pauses before a camera that failed is opened again: after the first failure, the second, ..."""
