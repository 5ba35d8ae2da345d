"""Constants of the channel model, of simulations and of tests; those of the live emulator and of fits are in their
folders."""

from __future__ import annotations

# --- the model (model.chain, model.trace) ---
# The emulator visits every jump. A chain with more jumps a millisecond than this is refused.
MAX_JUMPS_PER_MS = 1_000.0
CHECKED_JUMPS = 100_000  # between two checks that a chain does not jump ten times as often
FORGOTTEN_JUMPS = 1024  # fewest that are dropped from a live chain's path at once: fewer are not worth the copy
TRACE_BUFFER_BYTES = 1 << 16  # of lines that are written to a trace at once

# --- simulations (virtual.simulate) ---
MOST_FRAMES = 2e7  # minutes of computing, and some 10 GB
MOST_CAMERAS = 10_000  # 25 kB each, and ten times as many as a scenario has
FRAME_PERIOD_MS, FRAME_BYTES = 1000 / 30, 20_000  # defaults
AGES_EVERY_MS = 10.0  # sampling interval of reported ages

# --- links in tests (testing) ---
PATIENCE_S = 30.0  # for the thread of a link to answer
SETTLE_S = 10.0  # until no message is inside a link
