"""Numbers of the exports."""

from __future__ import annotations

# --- points of a sparse model (export_command, exporter, point_cloud) ---
POINTS = 20_000  # unless told otherwise, as in a sparse model of usual size: more only slows its readers
# Most pixels of depth for each point that is drawn from it: 20 million pixels take 8 s of processor time.
PIXELS_A_POINT = 1000
# Spacing of 32-bit positions above which an export warns, as a share of the cameras' spread; at 5,000,000 m it is .5 m.
COARSE_SHARE = 1e-3
SAME = 0.01  # two depth maps see the same point if depth differs by less, as a share of the distance

# --- renderings (viewed_field, images_and_video, render_command, camera_paths) ---
DEFAULT_HEIGHT_PX = 480  # of a rendering, at the shape of the cameras' images
RENDERED_FPS = 25.0  # images a second of a film, unless told otherwise
# Percentiles of nearness (1 / depth) that are the ends of the colors of depth, and number of images of a path that they
# are taken from.
DEPTH_PERCENTILES, DEPTH_SCALE_OF = (2, 98), 8
MOST_NAMED = 20  # most cameras that an error names
JPEG_QUALITY = 98  # of rendered images, from 0 to 100
# Largest angle without a camera that an orbit crosses: beyond it nobody saw what it would show.
WIDEST_GAP_DEG = 90.0
MOST_FRAMES = 20_000  # of a camera's path: ten minutes

# --- sequences of splats from a saved stream (splat_sequence) ---
FRAMES_PER_S = 30  # at which players show a sequence, unless told otherwise
GAP_S = 5.0  # longer pauses between messages of the stream are left out
