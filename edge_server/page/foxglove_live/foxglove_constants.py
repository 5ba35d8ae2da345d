"""Constants of the server for Foxglove.

The edge renders and encodes for it while it learns, so each constant bounds a rate or an amount.
"""

from __future__ import annotations

# --- how often it works, and how much it sends (__init__) ---
TICK_S = 0.05  # polling interval with subscribers: half a period of ten images a second
IDLE_S = 0.5  # polling interval without subscribers: a new one waits this long
BACKLOG = 32  # messages that wait for a slow subscriber; beyond that, the oldest is dropped

# --- renderings (__init__) ---
RENDER_EVERY_S = 0.2  # interval of renderings: a subscriber gets as many as a visitor of the page
RENDER_SHARE = 0.2  # largest share of the time that renderings take: the field needs the rest
MOST_ROWS = 240  # of a rendering: at rest the page shows twice as many, in five times the time

# --- points (__init__) ---
POINTS_EVERY_S = 2.0  # between two sets of points: 100,000 are 1.6 MB
MOST_POINTS = 100_000  # of a set, those of largest weight; fields of the shipped scenarios hold fewer
LEAST_OPACITY = 0.3  # of a Gaussian that is sent: those below are haze, not surface
