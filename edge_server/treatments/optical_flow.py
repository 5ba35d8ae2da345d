"""How the pixels of a camera's newest frame are moving, by optical flow from the frame before, and how far
that is to be believed.

Dense inverse search (Kroeger et al. 2016) in both directions on the part of the pictures where something
changed. Two tests that need no truth say what to believe: going there and back must end where it began
(Sundaram et al. 2010), and the motion must explain the newest frame better than no motion does. What fails
them moves as its neighbours do.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.treatments.change_detection import Changes, blurred, difference, dilated

_ENLARGE_TO = 384  # pixels a side that a crop is enlarged to, as long as that is no more than _ENLARGE times
_ENLARGE = 3.0  # DIS matches 8 x 8 patches: on small pictures these span whole limbs
_MARGIN_PX = 12  # around what changed: where the motion came from
_SPREAD_PX = 2.0  # over which neighbours agree on their motion
_DOUBTED = 1e-3  # share of a flow that is not believed, for where there is no other
_STILL_PX = 0.3  # less than this between two frames is no motion


@dataclass(frozen=True)
class Motion:
    """speed: float32 (H, W, 2), pixels a millisecond right and down, 0 where nothing moves. moving: bool
    (H, W)."""

    speed: NDArray[np.float32]
    moving: NDArray[np.bool_]

    @property
    def length(self) -> NDArray[np.float32]:
        """float32 (H, W), pixels a millisecond."""
        found: NDArray[np.float32] = np.linalg.norm(self.speed, axis=-1).astype(np.float32)
        return found


def motion_of(before: View, now: View, changes: Changes) -> Motion:
    """The motion in ``now``, from two views that ``changes`` compared."""
    shape = now.image.shape[:2]
    speed, moving = np.zeros((*shape, 2), np.float32), np.zeros(shape, bool)
    if not changes.changed.any():
        return Motion(speed, moving)
    crop = _crop(changes.changed)
    a, b = before.image[crop], now.image[crop]
    back, forth = _flows(a, b)
    there = _moving(back, changes.changed[crop])
    moving[crop] = there
    back = _agreed(back, _confidence(a, b, back, forth, changes), there)
    speed[crop] = back * np.float32(-1.0 / changes.gap_ms)
    return Motion(speed, moving)


def _crop(changed: NDArray[np.bool_]) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    (h, w), m = changed.shape, _MARGIN_PX
    return (
        slice(max(int(rows[0]) - m, 0), min(int(rows[-1]) + m + 1, h)),
        slice(max(int(columns[0]) - m, 0), min(int(columns[-1]) + m + 1, w)),
    )


def _flows(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Flow from b to a on b's raster, and from a to b on a's: float32 (h, w, 2), pixels."""
    h, w = a.shape[:2]
    scale = min(_ENLARGE, max(1.0, _ENLARGE_TO / max(h, w)))
    size = (max(round(w * scale), 16), max(round(h * scale), 16))
    gray = [
        cv2.resize(cv2.cvtColor(np.ascontiguousarray(x[..., :3]), cv2.COLOR_RGB2GRAY), size,
                   interpolation=cv2.INTER_CUBIC)
        for x in (a, b)
    ]  # fmt: skip
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    # Stripes are searched side by side, as many as there are threads, and each begins anew: with one thread
    # the result is the same on every machine.
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        room = np.zeros((*gray[0].shape, 2), np.float32)  # no first guess
        flows = [search.calc(x, y, room.copy()) for x, y in ((gray[1], gray[0]), (gray[0], gray[1]))]
    finally:
        cv2.setNumThreads(threads)
    unit = np.array([w / size[0], h / size[1]], np.float32)
    back, forth = (cv2.resize(flow, (w, h), interpolation=cv2.INTER_AREA) * unit for flow in flows)
    return back, forth


def grid(shape: tuple[int, int]) -> NDArray[np.float32]:
    """float32 (H, W, 2), each pixel's own x and y, as ``cv2.remap`` counts them."""
    y, x = np.indices(shape, dtype=np.float32)
    return np.stack([x, y], axis=-1)


def sample(image: NDArray, at: NDArray[np.float32]) -> NDArray:
    """``image`` at points (H, W, 2), bilinear; beyond its edge, the edge."""
    found: NDArray = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    return found


def _confidence(
    a: NDArray[np.uint8],
    b: NDArray[np.uint8],
    back: NDArray[np.float32],
    forth: NDArray[np.float32],
    changes: Changes,
) -> NDArray[np.float32]:
    """float32 (h, w) in [0, 1]."""
    origin = grid(a.shape[:2]) + back
    miss = np.linalg.norm(back + sample(forth, origin), axis=-1)
    length = np.linalg.norm(back, axis=-1)
    returns = np.exp(-((miss / (0.5 + 0.15 * length)) ** 2))
    soft_a, soft_b = blurred(a), blurred(b)
    left = difference(soft_b, sample(soft_a, origin))
    explains = np.exp(-((np.maximum(left - changes.bound, 0.0) / changes.bound) ** 2))
    worse = left > difference(soft_b, soft_a) + changes.bound
    believed: NDArray[np.float32] = (returns * explains * ~worse).astype(np.float32)
    return believed


def _agreed(
    flow: NDArray[np.float32], confidence: NDArray[np.float32], moving: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """The flow of what moves as its surroundings have it, each as far as it is believed; 0 elsewhere. What
    was hidden in the frame before, and has no flow of its own, goes with the body it belongs to; and small
    errors must not tear apart what is carried several times as far as it was seen to go."""
    share = (np.maximum(confidence, _DOUBTED) * moving).astype(np.float32)
    total = np.maximum(cv2.GaussianBlur(share, (0, 0), _SPREAD_PX), np.float32(1e-9))
    sums = cv2.GaussianBlur(flow * share[..., None], (0, 0), _SPREAD_PX)
    agreed: NDArray[np.float32] = np.where(moving[..., None], sums / total[..., None], np.float32(0.0))
    return agreed


def _moving(back: NDArray[np.float32], changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels that move and hang together with some that changed: a plain shirt moves as a whole though its
    inside looks the same, while flow far from any change is noise."""
    fast = (np.linalg.norm(back, axis=-1) > _STILL_PX) & dilated(changed, _MARGIN_PX)
    count, label = cv2.connectedComponents(fast.astype(np.uint8), connectivity=4)
    touched = np.bincount(label[fast & changed], minlength=count) > 0
    touched[0] = False
    return touched[label]
