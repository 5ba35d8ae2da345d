"""Optical flow between the last two frames of a camera, with a confidence for each pixel.

Dense inverse search (Kroeger et al. 2016) runs in both directions on the part of the images where something
changed. Two tests that need no ground truth give the confidence: going there and back must end where it began
(Sundaram et al. 2010), and the motion must explain the newest frame better than no motion does. Pixels that
fail them move as their neighbors do.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.treatments.change_detection import Changes, blurred, difference, dilated

_UPSAMPLED_PX = 384  # side that a crop is enlarged to, but by no more than _MAX_UPSAMPLING
_MAX_UPSAMPLING = 3.0  # DIS matches 8 x 8 patches, which span whole limbs on small images
_MARGIN_PX = 12  # around changed pixels: where the motion came from
_SMOOTHING_PX = 2.0  # standard deviation over which neighboring motions are averaged
_LEAST_CONFIDENCE = 1e-3  # weight of a motion that failed the tests, for where there is no other
_STILL_PX = 0.3  # less than this between two frames is no motion


@dataclass(frozen=True)
class Motion:
    """speed: float32 (H, W, 2), right and down in pixels a millisecond, 0 where nothing moves. moving: bool
    (H, W)."""

    speed: NDArray[np.float32]
    moving: NDArray[np.bool_]

    @property
    def length(self) -> NDArray[np.float32]:
        """float32 (H, W), pixels a millisecond."""
        found: NDArray[np.float32] = np.linalg.norm(self.speed, axis=-1).astype(np.float32)
        return found


def estimate_motion(before: View, now: View, changes: Changes) -> Motion:
    """Motion of the pixels of ``now``. changes: what ``compare`` found between the two views."""
    shape = now.image.shape[:2]
    speed, moving = np.zeros((*shape, 2), np.float32), np.zeros(shape, bool)
    if not changes.changed.any():
        return Motion(speed, moving)
    crop = _crop(changes.changed)
    a, b = before.image[crop], now.image[crop]
    backward, forward = _flows(a, b)
    there = _moving(backward, changes.changed[crop])
    moving[crop] = there
    backward = _smoothed(backward, _confidence(a, b, backward, forward, changes), there)
    speed[crop] = backward * np.float32(-1.0 / changes.gap_ms)
    return Motion(speed, moving)


def _crop(changed: NDArray[np.bool_]) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    (h, w), m = changed.shape, _MARGIN_PX
    return (
        slice(max(int(rows[0]) - m, 0), min(int(rows[-1]) + m + 1, h)),
        slice(max(int(columns[0]) - m, 0), min(int(columns[-1]) + m + 1, w)),
    )


def _flows(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Flow from b to a on b's pixel grid, and from a to b on a's: float32 (h, w, 2), pixels."""
    h, w = a.shape[:2]
    scale = min(_MAX_UPSAMPLING, max(1.0, _UPSAMPLED_PX / max(h, w)))
    size = (max(round(w * scale), 16), max(round(h * scale), 16))
    gray = [
        cv2.resize(
            cv2.cvtColor(np.ascontiguousarray(x[..., :3]), cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_CUBIC
        )
        for x in (a, b)
    ]
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    # DIS searches one stripe a thread, and each stripe starts afresh: with one thread the result is the same
    # on every machine.
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        initial = np.zeros((*gray[0].shape, 2), np.float32)
        flows = [search.calc(x, y, initial.copy()) for x, y in ((gray[1], gray[0]), (gray[0], gray[1]))]
    finally:
        cv2.setNumThreads(threads)
    unit = np.array([w / size[0], h / size[1]], np.float32)
    backward, forward = (cv2.resize(flow, (w, h), interpolation=cv2.INTER_AREA) * unit for flow in flows)
    return backward, forward


def grid(shape: tuple[int, int]) -> NDArray[np.float32]:
    """float32 (H, W, 2): x and y of each pixel, as ``cv2.remap`` counts them."""
    y, x = np.indices(shape, dtype=np.float32)
    return np.stack([x, y], axis=-1)


def sample(image: NDArray, at: NDArray[np.float32]) -> NDArray:
    """``image`` at points (H, W, 2), bilinear; beyond its border, the border."""
    found: NDArray = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    return found


def _confidence(
    a: NDArray[np.uint8],
    b: NDArray[np.uint8],
    backward: NDArray[np.float32],
    forward: NDArray[np.float32],
    changes: Changes,
) -> NDArray[np.float32]:
    """Confidence in ``backward``: float32 (h, w) in [0, 1]."""
    origin = grid(a.shape[:2]) + backward
    mismatch = np.linalg.norm(backward + sample(forward, origin), axis=-1)
    length = np.linalg.norm(backward, axis=-1)
    returns = np.exp(-((mismatch / (0.5 + 0.15 * length)) ** 2))
    soft_a, soft_b = blurred(a), blurred(b)
    residual = difference(soft_b, sample(soft_a, origin))
    explains = np.exp(-((np.maximum(residual - changes.bound, 0.0) / changes.bound) ** 2))
    worse = residual > difference(soft_b, soft_a) + changes.bound
    confidence: NDArray[np.float32] = (returns * explains * ~worse).astype(np.float32)
    return confidence


def _smoothed(
    flow: NDArray[np.float32], confidence: NDArray[np.float32], moving: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Flow of the moving pixels averaged over their neighborhood by confidence; 0 elsewhere.

    Pixels that were hidden in the frame before have no flow of their own and take that of their body. A body
    is warped several times as far as it was seen to move: small errors must not tear it apart.
    """
    share = (np.maximum(confidence, _LEAST_CONFIDENCE) * moving).astype(np.float32)
    total = np.maximum(cv2.GaussianBlur(share, (0, 0), _SMOOTHING_PX), np.float32(1e-9))
    sums = cv2.GaussianBlur(flow * share[..., None], (0, 0), _SMOOTHING_PX)
    smoothed: NDArray[np.float32] = np.where(moving[..., None], sums / total[..., None], np.float32(0.0))
    return smoothed


def _moving(backward: NDArray[np.float32], changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Moving pixels that are connected to changed ones: a plain shirt moves as a whole though its inside
    looks the same, while flow far from any change is noise."""
    fast = (np.linalg.norm(backward, axis=-1) > _STILL_PX) & dilated(changed, _MARGIN_PX)
    count, label = cv2.connectedComponents(fast.astype(np.uint8), connectivity=4)
    touched = np.bincount(label[fast & changed], minlength=count) > 0
    touched[0] = False
    return touched[label]
