"""Constants of a camera node that no scenario sets; those of the doctor, arms and sources are in their folders."""

from __future__ import annotations

# --- frames and their outcomes (capture, node, sender) ---
SHOT_CACHE_BYTES = 64 * 2**20  # of compressed shots that repeat, of all cameras of a process
STATUS_PERIOD_S = 1.0  # between two writes of the status file
# How long a clean exit waits for the answers to frames already sent, and the polling interval.
LAST_ANSWERS_S, LAST_ANSWERS_POLL_S = 1.0, 0.01
READY_POLL_S = 0.01  # polling interval of the wait for all senders to connect, before a recording starts
FIRST_BACKOFF_S = 0.2  # first pause between attempts to connect
MAX_BACKOFF_S = 1.0  # the longest pause
# How long one attempt waits for a peer that cannot be reached.
CONNECT_S = 6.0
# How long the first frame waits for the first clock exchange, and the polling interval; it waits only once for a peer
# that does not answer clock exchanges.
OFFSET_WAIT_S, OFFSET_POLL_S = 2.0, 0.01
# An answer may take ANSWER_PATIENCE times as long as the slowest recent one, at least LEAST_PATIENCE_S, and at most
# ANSWER_TIMEOUT_S, after which a stream counts as dead.
ANSWER_PATIENCE, LEAST_PATIENCE_S, ANSWER_TIMEOUT_S = 8.0, 1.25, 5.0
SLOWEST_ANSWER_DECAY = 0.95  # per answer, of the slowest recent answer's time

# --- the peer's clock and a device's (clock_offset, clocks) ---
OFFSET_PERIOD_S = 1.0  # between two exchanges
# The first exchanges follow each other quickly, so that early frames get a good estimate too.
FIRST_OFFSETS, FIRST_OFFSETS_PERIOD_S = 4, 0.05
KEPT_OFFSETS = 16  # latest exchanges, of which the one with the smallest error bound counts
OFFSET_DRIFT_PPM = 50.0  # by which an exchange's error bound grows with its age
ARRIVAL_WINDOW_NS = 5_000_000_000  # in which the fastest sample of a device gives the offset of its clock

# --- poses from a tracker, an arm or a file (pose.pairing, pose.tracker, pose.providers) ---
# Samples older than the newest by more than KEPT_POSES_NS are dropped; RESTART_POSES of them in a row replace the
# others: the sender's clock was set back.
KEPT_POSES_NS, RESTART_POSES = 2_000_000_000, 8
# Polling interval of a tracker's file: a quarter of the 20 ms between poses of a typical tracker.
TRACKER_LOOKS_S = 0.005
# How long a frame waits for its pose: trackers take 20 to 60 ms, and captures are 67 ms apart.
TRACKER_LATE_S = 0.1
# Bytes compared again later, and longest line that is kept; a line has some 100.
TRACKER_LINE_BYTES = 4096
TRACKER_TAIL_BYTES = 65_536  # per read, and of a longer file the first read: over KEPT_POSES_NS at 300 poses a second
TRACKER_STEP_NS = 1_000_000  # smallest difference between two clocks of a machine that means one of them stepped
TRACKER_JOIN_S = 2.0  # for its thread to end
# Absolute value of a time stamp in a file: the difference of two fits in 64 bits of nanoseconds. Counted from 1970 it
# is the year 2115; larger ones have another unit.
MAX_STAMP_S = 4.6e9
MAX_GAP_MS = 3.6e6  # between a frame and its pose sample: poses an hour away belong to another recording

# --- the folder of rendered frames (synthetic.frame_cache) ---
# Here because the contents of the files of ``synthetic`` are part of the key of rendered frames.
RENDERED_DISK_BYTES = 2 << 30
