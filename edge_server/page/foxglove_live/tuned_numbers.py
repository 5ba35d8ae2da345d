"""Times and sizes of the server for Foxglove."""

from __future__ import annotations

TICK_S = 0.05
"""Between two looks at what is new, while somebody has subscribed: half a period of ten images a second."""
IDLE_S = 0.5
"""The same while nobody has: so long a new subscriber waits."""
RENDER_EVERY_S = 0.2
"""Between two renderings: as many as a visitor of the page gets."""
RENDER_SHARE = 0.2
"""Most of the time that renderings take: the field needs the rest."""
MOST_ROWS = 240
"""Of a rendering: at rest the page shows twice that, in five times the time."""
POINTS_EVERY_S = 2.0
"""Between two sets of points: 100,000 are 1.6 MB."""
MOST_POINTS = 100_000
"""Those of largest weight; fields of the shipped scenarios hold fewer."""
LEAST_OPACITY = 0.3
"""Gaussians below are haze rather than surface."""
JPEG_QUALITY = 85
"""As of the page."""
BACKLOG = 32
"""Messages that wait for a subscriber who reads slowly; then the oldest is left out."""
