"""Numbers of the exports."""

from __future__ import annotations

POINTS = 20_000
"""Of a sparse model of usual size: more only slows its readers."""
PIXELS_A_POINT = 1000
"""At most, of the depth that points are drawn from: 20 million pixels take 8 s of processor time."""

SAME = 0.01
"""Tolerance of depth within which two maps see the same point of a sparse model, share of the distance."""

DEFAULT_HEIGHT_PX = 480
"""Of a rendering, at the shape of the cameras' images."""
RENDERED_FPS = 25.0
"""Images a second, unless told otherwise."""
DEPTH_PERCENTILES, DEPTH_SCALE_OF = (2, 98), 8
"""Of nearness, that are the ends of the colors of depth, and images of a path that they are taken from."""
MOST_NAMED = 20
"""Cameras in an error."""

JPEG_QUALITY = 98
"""Of rendered images."""
WIDEST_GAP_DEG = 90.0
"""Largest angle without a camera that an orbit crosses: beyond it nobody saw what it would show."""
MOST_FRAMES = 20_000
"""Of a camera's path: ten minutes."""

FRAMES_PER_S = 30
"""At which players show a sequence, unless told otherwise."""
GAP_S = 5.0
"""Longer pauses between messages of a saved stream are left out."""
