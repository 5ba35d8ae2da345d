"""Numbers of the report."""

from __future__ import annotations

# --- what is said of a run (run_statistics, conclusion) ---
# Last share of a run, and what people call it: ``final`` and ``shown`` are means over it.
FINAL_SHARE, FINAL_PART = 0.2, "last fifth"
LITTLE_DB = 3.0  # above an image of one mean color: a field that gains less shows a blur, whatever the age
# Share of frames or updates: below that, what was lost or left out is not worth a clause of the conclusion.
WORTH_SAYING = 0.05
TOO_SHORT = "too short a run for this machine"  # a likely cause of a poor picture, here and on the live page

# --- events (events) ---
SILENT_MS = 3000.0  # a camera counts as gone from this age on: longer than any frame of the shipped channels takes
TOGETHER_S = 1.0  # cameras that fall silent within this time are one event: a blackout, or a node that ended
MOST_EVENTS = 40  # that are listed: a link that comes and goes would make the curves unreadable
NAMED_CAMERAS = 3  # most cameras that the line of an event names

# --- a run's files, and whether they account for every frame (run_files, frame_accounting) ---
# A row that counts from zero again is of a process that started again, if it is earlier by more than this. Rows of one
# process are in order but for the scores of what was shown, which wait for their held-out cameras' frames; a process
# takes longer than this to start.
LATE_S = 1.0
# A killed process takes with it the frames that it wrote about in its last moments. The thesis's links hold a frame
# for a second or two; a frame without a line this near to the end was cut off, any other was lost by something else.
CUT_OFF_NS = 10 * 10**9
MOST_CONTRADICTIONS = 20  # that are listed, enough to see what went wrong; the count says how often

# --- figures (figures, explain_command) ---
MOST_LABELS = 24  # most cameras that have a label of their own
MOST_BARS = 20  # most cameras that have a bar of their own where a decision is explained
