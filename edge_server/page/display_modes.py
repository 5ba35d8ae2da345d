"""Display modes besides the picture: depth, age, truth beside rendering, and the error."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.edge_constants import ERROR_GAIN
from edge_server.fields import Rendering
from edge_server.live.state import CameraView, Comparison
from edge_server.page.colors import UNKNOWN, age_colors
from edge_server.page.page_constants import AGE_VIEW_LIGHT, AGE_VIEW_STEP, DEPTH_PERCENTILES, LABEL_PX, SOLID
from freshfield.geometry import Pinhole, seen_from, world_rays

PICTURE, DEPTH, AGE, TRUTH, ERROR = "picture", "depth", "age", "truth | picture", "error"
VIEWS = (PICTURE, DEPTH, AGE, TRUTH, ERROR)
HINT = (
    "depth: red is near, blue is far. age: of the newest frame whose camera faces a place; occlusion is ignored. "
    f"error: |truth - picture| at the held-out camera, {ERROR_GAIN:g} times brighter."
)
BACKDROP = np.array([18, 20, 24], np.float32) / 255

Image = NDArray[np.float32]


def depth_view(rendering: Rendering) -> Image:
    """Colors (H, W, 3) of depth, from the nearest (red) to the farthest (blue) of the picture."""
    known = (rendering.opacity > SOLID) & np.isfinite(rendering.depth) & (rendering.depth > 0)
    if not known.any():
        return np.broadcast_to(BACKDROP, rendering.color.shape)
    near, far = np.percentile(rendering.depth[known], DEPTH_PERCENTILES)
    share = np.clip((rendering.depth - near) / max(far - near, 1e-6), 0, 1)
    levels = (255 * (1 - np.where(known, share, 1))).astype(np.uint8)
    colors = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1] / np.float32(255)
    return np.where(known[..., None], colors, BACKDROP).astype(np.float32)


def age_view(
    rendering: Rendering, camera_to_world: NDArray[np.float64], lens: Pinhole, cameras: Sequence[CameraView]
) -> Image:
    """Colors (H, W, 3): the age of the newest training frame that contains each place, on the scale of the legend,
    shaded like the picture; gray where there is none. Occlusion is ignored. Computed at every AGE_VIEW_STEP-th pixel.

    rendering: the view of ``lens`` at ``camera_to_world``.
    """
    small = lens.scaled(1.0 / AGE_VIEW_STEP)
    origin, directions = world_rays(small, camera_to_world)
    depth = cv2.resize(rendering.depth, (small.width, small.height), interpolation=cv2.INTER_NEAREST)
    solid = cv2.resize(rendering.opacity, (small.width, small.height), interpolation=cv2.INTER_NEAREST) > SOLID
    there = solid & np.isfinite(depth) & (depth > 0)
    points = origin + directions[there] * depth[there][:, None]
    newest_ms = np.full(len(points), np.inf)
    for camera in cameras:
        if camera.newest is not None and camera.age_ms is not None and not camera.held_out:
            seen = seen_from(camera.newest.intrinsics, camera.newest.pose.matrix(), points)[2]
            newest_ms[seen] = np.minimum(newest_ms[seen], camera.age_ms)
    colors = np.empty((small.height, small.width, 3), np.float32)
    colors[:] = np.array(UNKNOWN, np.float32) / 255
    known = np.isfinite(newest_ms)
    colors[there] = np.where(known[:, None], age_colors(np.where(known, newest_ms, 0.0)), colors[there])
    light = AGE_VIEW_LIGHT + (1 - AGE_VIEW_LIGHT) * rendering.color.mean(axis=2, keepdims=True)
    size = rendering.color.shape[1::-1]
    return cv2.resize(colors, size, interpolation=cv2.INTER_NEAREST) * light


def compared(comparison: Comparison, width: int, height: int, error: bool, labeled: bool = True) -> Image:
    """Truth and rendering of the held-out camera, as large as they fit into (height, width, 3): side by side, or one
    above the other if that is larger.

    error: their absolute difference alone. labeled: whether labels are drawn on the image.
    """
    truth = comparison.truth.astype(np.float32) / 255
    rendered = cv2.resize(comparison.rendered, truth.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    rendered = rendered.astype(np.float32) / 255
    parts = [np.minimum(ERROR_GAIN * np.abs(truth - rendered), 1)] if error else [truth, rendered]
    row, column = np.concatenate(parts, axis=1), np.concatenate(parts, axis=0)

    def scale_of(image: Image) -> float:
        return min(width / image.shape[1], height / image.shape[0])

    shown = max(row, column, key=scale_of)
    size = [max(1, int(side * scale_of(shown))) for side in shown.shape[1::-1]]
    large = cv2.resize(shown, size, interpolation=cv2.INTER_AREA if scale_of(shown) < 1 else cv2.INTER_NEAREST)
    labels = ("error",) if error else ("truth", "what the field renders")
    for number, words in enumerate(labels if labeled else ()):
        x, y = (number * size[0] // 2, 0) if shown is row else (0, number * size[1] // 2)
        for color, thickness in ((0.0, 4), (1.0, 1)):  # an outline, so that it is readable on any image
            at = (x + LABEL_PX, y + 2 * LABEL_PX)
            cv2.putText(large, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (color,) * 3, thickness, cv2.LINE_AA)
    out = np.empty((height, width, 3), np.float32)
    out[:] = BACKDROP
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    out[top : top + size[1], left : left + size[0]] = large
    return out
