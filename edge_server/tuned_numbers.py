"""Numbers of the edge server whose folder has no such file of its own."""

from __future__ import annotations

from typing import Any

# --- what the edge does where a scenario leaves it open (settings) ---
# Of a field in layers that follows arrivals; of everything else.
ARRIVALS: dict[str, Any] = {"updates": "arrivals", "update_ms": 20.0, "steps": 10}
CYCLE: dict[str, Any] = {"updates": "cycle", "update_ms": 800.0, "steps": 100}
# Of a scan by cameras that move: a third of what a keyframe gets, so that a new one shows as soon as it is seeded.
CARRIED: dict[str, Any] = {"updates": "cycle", "update_ms": 80.0, "steps": 8}
# Cameras: photos that are dealt to twelve (``fox``) are no tracks, and read 8 dB less as a scan (19 against 27).
MOST_CARRIED = 4

# --- how far a command is (progress) ---
LONG_WORK_S = 10.0  # of a stage of a command that is announced in a pipe, too: nobody wonders about less
REDRAWN_S = 1.0  # between two drawings of a command's progress: the seconds that it tells change no faster

# --- networks in ONNX (embed) ---
# Images per run if the model takes any number: larger batches exceed the caches and take longer per image.
EMBEDDING_BATCH = 4
DEPTH_MOST_ASPECT = 2.5  # of the depth network's input: attention's memory grows with the square of the pixels

# --- the foreground's detector (foreground) ---
NMS_IOU = 0.6
NMS_BOXES = 300  # that enter non-maximum suppression, by score
