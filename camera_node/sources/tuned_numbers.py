"""Numbers of recorded data sets and of real cameras."""

PHOTO_FPS = 10.0
"""Captures a second of photos without times, where a scenario gives no rate."""
HOLD_OUT_EVERY = 8
"""Of so many photos the first is held out, where the data set has no test images of its own."""
SAME_SHAPE = 0.02
"""Tolerated difference of aspect ratio between an image and what it was calibrated as: both are in whole pixels."""
RECORDING_DEPTH_NEAR_NS = 20_000_000
"""Time within which an image of a recorded bag gets a depth image: less than half a period of 15 images a second."""
RECORDING_POSE_NEAR_NS = 50_000_000
"""Largest gap from such an image to a sample of its frame's own transform: half a period of 10 samples a second."""
RECORDING_PARENTS_NEAR_NS = 250_000_000
"""The same of the transforms above: robots correct map -> odom only some times a second, and by little."""

LIVE_FPS = 15.0
"""Captures a second of a device where a scenario gives no rate."""
REOPEN_AFTER_S = (0.25, 0.5, 1.0, 2.0, 5.0)
"""Pauses before a camera that failed is opened again: after the first failure, the second, ..."""
