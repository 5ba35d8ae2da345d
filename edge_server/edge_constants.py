"""Numbers of the edge server's folders that have no such file of their own."""

from __future__ import annotations

from typing import Any

# --- what the edge does where a scenario leaves it open (settings) ---
# When it updates, milliseconds and optimizer steps of an update: of a field in layers that follows arrivals
# (ARRIVALS); of every other field (CYCLE); of a scan by cameras that move (CARRIED), where an update takes a third of
# what a keyframe gets, so that a new one shows as soon as it is seeded.
ARRIVALS: dict[str, Any] = {"updates": "arrivals", "update_ms": 20.0, "steps": 10}
CYCLE: dict[str, Any] = {"updates": "cycle", "update_ms": 800.0, "steps": 100}
CARRIED: dict[str, Any] = {"updates": "cycle", "update_ms": 80.0, "steps": 8}
# Most cameras of such a scan: photos that are dealt to twelve (``fox``) are no tracks, and read 8 dB less as a scan (19
# against 27).
MOST_CARRIED = 4
# Options of the field of such a scan; few pixels bound the Gaussians further.
CARRIED_OPTIONS: dict[str, Any] = {"scan": True, "refine": True, "carried": True, "gaussians": 60_000}

# --- how far a command is (progress) ---
LONG_WORK_S = 10.0  # a stage that takes longer is announced in a pipe, too: nobody wonders about less
REDRAWN_S = 1.0  # between two drawings of a command's progress: the seconds that it tells change no faster

# --- figures of reports, studies and trainings (matplotlib_figures) ---
FIGURE_WIDTH_INCH, FIGURE_DPI = 8.4, 110  # width and resolution of every figure
FIGURE_COLORS = 64  # in a file with curves alone: a quarter of the bytes, without a visible difference
# Colors in a file with pictures, and rounds of k-means that keep their rare colors: a third of the bytes.
PICTURE_COLORS, PICTURE_MEANS = 256, 3
# Factor by which errors are brightened, in figures and on the page: one of 10 % of the range is plain to see.
ERROR_GAIN = 4.0
# A legend of up to so many entries stands in a row above the axes; height of that row, in points.
LEGEND_IN_A_ROW, LEGEND_ROW_PT = 4, 20.0

# --- networks in ONNX (embed.embedder, embed.depth_network) ---
# Images per run if the model takes any number: larger batches exceed the caches and take longer per image.
EMBEDDING_BATCH = 4
# Most that the depth network's input is longer than wide: attention's memory grows with the square of the pixels.
DEPTH_MOST_ASPECT = 2.5

# --- the foreground's detector (foreground.detector) ---
NMS_IOU = 0.6  # non-maximum suppression: two boxes of a class with a larger intersection over union are one object
NMS_BOXES = 300  # most boxes that enter it, those with the highest scores

# --- what files and scenarios may ask for at most (embed, foreground, fields.checkpoint, scheduler, settings) ---
# Memory for all ONNX models of a process together: four times the need of the largest YOLO11 for a batch. A larger
# allocation fails, whatever sizes the file states.
MAX_MODEL_BYTES = 4 * 2**30
MAX_MODEL_FILE_BYTES = 512 * 2**20  # of an ONNX model's file: twice the largest detectors of the family, 230 MB
# Nodes of an ONNX model: three times the largest of the family, quantized. ONNX Runtime takes 1 s to load a chain of so
# many, 12 s of 30,000.
MAX_GRAPH_NODES = 10_000
# Largest tensor of an ONNX model per image: six times the largest of YOLO11x at 640 pixels.
MAX_TENSOR_ELEMENTS = 2**26
MAX_MODEL_SIDE_PX = 2048  # width and height of the images that an ONNX model takes
MAX_POLICY_CHARS = 1024  # of a policy's name, which may contain a file's path
LONGEST_MS = 3_600_000.0  # wait, period, deadline or update: in an hour every scene has changed
