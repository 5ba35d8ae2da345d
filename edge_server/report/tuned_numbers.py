"""Numbers of the report."""

from __future__ import annotations

FINAL_SHARE = 0.2
"""Of a run, its last: ``final`` and ``shown`` are means over it."""
LITTLE_DB = 3.0
"""Above an image of one mean color: below that, a field shows a blur, whatever the age."""
WORTH_SAYING = 0.05
"""Share of frames or updates: below that, what was lost or left out is not worth a clause of the conclusion."""

SILENT_MS = 3000.0
"""Age from which on a camera counts as gone: longer than any frame of the shipped channels takes."""
TOGETHER_S = 1.0
"""Cameras that fall silent within that time are one event: a blackout, or a node that ended."""
MOST_EVENTS = 40
"""Events that are listed: a link that comes and goes would make the curves unreadable."""

LATE_S = 1.0
"""Rows of one process are written in order but for the scores of what was shown: they wait for their held-out
cameras' frames. A process that starts again counts from zero, and takes longer than this to start."""
CUT_OFF_NS = 10 * 10**9
"""A killed process takes with it the frames that it wrote about in its last moments. The thesis's links hold a
frame for a second or two; a frame without a line this near to the end was lost by something else."""
MOST_CONTRADICTIONS = 20
"""That are listed, enough to see what went wrong; the count says how often."""
NAMED_CAMERAS = 3
"""In a line of an event."""

# --- figures (style, figures, explain_command) ---
FIGURE_WIDTH_INCH, FIGURE_DPI = 8.4, 110
FIGURE_COLORS = 64
"""In a file: a quarter of the bytes, without a visible difference in curves."""
PICTURE_COLORS, PICTURE_MEANS = 256, 3
"""The same of pictures, and rounds of k-means that keep their rare colors: a third."""
LEGEND_IN_A_ROW, LEGEND_ROW_PT = 4, 20.0
"""Entries of a legend, and height of the row."""
ERROR_GAIN = 4.0
"""Factor by which errors are brightened to be visible."""
MOST_LABELS = 24
"""Cameras with a label of their own."""
MOST_BARS = 20
"""Cameras with a bar of their own where a decision is explained."""
