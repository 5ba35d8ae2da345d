"""Constants of the report."""

from __future__ import annotations

# --- statistics and conclusion of a run (run_statistics, conclusion) ---
# Last share of a run, and its name in texts: ``final`` and ``shown`` are means over it.
FINAL_SHARE, FINAL_PART = 0.2, "last fifth"
LITTLE_DB = 3.0  # above an image of one mean color: a field that gains less shows a blur, whatever the age
# Share of frames or updates below which the conclusion does not mention what was lost or left out.
WORTH_SAYING = 0.05
TOO_SHORT = "too short a run for this machine"  # a likely cause of a poor picture, here and on the live page

# --- events (events) ---
SILENT_MS = 3000.0  # a camera counts as gone from this age on: longer than any frame of the shipped channels takes
TOGETHER_S = 1.0  # cameras that fall silent within this time are one event: a blackout, or a node that ended
MOST_EVENTS = 40  # that are listed: a link that comes and goes would make the curves unreadable
NAMED_CAMERAS = 3  # most cameras that the line of an event names

# --- a run's files, and whether they account for every frame (run_files, frame_accounting) ---
# A row that is earlier than the one before by more than this counts from zero again: its process restarted. Rows of one
# process are in order except for scores of what was shown, which wait for held-out frames; a process takes longer than
# this to start.
LATE_S = 1.0
# A killed process takes with it the frames that it wrote about in its last moments. The thesis's links hold a frame
# for a second or two; a frame without a line this near to the end was cut off, any other was lost by something else.
CUT_OFF_NS = 10 * 10**9
MOST_CONTRADICTIONS = 20  # that are listed, enough to see the problem; the count gives the total

# --- figures (figures, explain_command) ---
MOST_LABELS = 24  # most cameras with individual labels
MOST_BARS = 20  # most cameras with individual bars in the explanation of a decision
