"""What cannot be right of a carried camera's frames: things that move, a covered lens, and poses that drift."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections
from edge_server.fields.splat.scan import settings as tuned
from edge_server.fields.splat.scan.scan_field import Shown
from edge_server.fields.splat.scan.tracking import gray
from freshfield.geometry import se3_inverse

Array = NDArray[np.float64]


def moved_in(now: View, pose: Array, before: View, before_pose: Array) -> NDArray[np.bool_]:
    """Pixels, bool (H, W), of surfaces where an earlier frame saw through: they have come since. What stands still is
    never there, however new it is to the camera. Both views have depth; poses: camera to world (4, 4)."""
    assert now.depth is not None and before.depth is not None
    every, lens, other = tuned.MOVED_EVERY, now.intrinsics, before.intrinsics
    z = now.depth[::every, ::every].astype(np.float64)
    y, x = np.mgrid[: z.shape[0], : z.shape[1]] * every
    ray = lens.rays(np.stack([x + 0.5, y + 0.5], axis=-1))
    to_other = se3_inverse(before_pose) @ pose
    points = ray / ray[..., 2:] * z[..., None] @ to_other[:3, :3].T + to_other[:3, 3]
    ahead = points[..., 2]
    safe = np.maximum(ahead, 1e-6)
    u = np.floor(other.fx * points[..., 0] / safe + other.cx).astype(np.int64)
    v = np.floor(other.fy * points[..., 1] / safe + other.cy).astype(np.int64)
    there = (z > 0) & (ahead > 1e-3) & (u >= 0) & (v >= 0) & (u < other.width) & (v < other.height)
    # The nearest surface around: edges, and errors of poses, are no free space.
    known = np.where(before.depth > 0, before.depth, np.float32(0.0))
    nearest = cv2.erode(known, np.ones((2 * every + 1, 2 * every + 1), np.uint8))
    seen = nearest[np.clip(v, 0, other.height - 1), np.clip(u, 0, other.width - 1)]
    through = there & (seen > ahead * (1.0 + tuned.MOVED_SHARE) + tuned.MOVED_M)
    kernel = np.ones((3, 3), np.uint8)
    found = cv2.dilate(cv2.morphologyEx(through.astype(np.uint8), cv2.MORPH_OPEN, kernel), kernel)
    size = (now.image.shape[1], now.image.shape[0])
    return cv2.resize(found, size, interpolation=cv2.INTER_NEAREST).astype(bool)


def agreeing(view: View, shown: Shown, gain: Array, bias: Array) -> float:
    """The share of a view's pixels, of those where the field shows a surface, that look as expected."""
    expected = shown.color * gain.astype(np.float32) + bias.astype(np.float32)
    surface = shown.opacity[::2, ::2] >= tuned.ALIGNED_OPACITY
    error = np.abs(gray(expected[::2, ::2]) - gray(view.image[::2, ::2]))[surface]
    return float((error < tuned.SOFT).mean()) if error.size else 1.0


def flat(view: View, shown: Shown) -> bool:
    """Whether a view shows hardly anything where the field shows something: its lens is covered, or it is dark. An
    exposure could be found by which it agrees."""
    surface = shown.opacity >= tuned.ALIGNED_OPACITY
    if surface.mean() < tuned.LEAST_OVERLAP:
        return False
    contrast, expected = (float(gray(each)[surface].std()) for each in (view.image, shown.color))
    return contrast < tuned.FLAT * expected


def troubles(poses: PoseCorrections) -> list[str]:
    """What corrections of poses say that is wrong with them, a line each."""
    found = []
    for track in poses.tracks():
        newest = poses.newest(track, tuned.JUDGED)
        if len(newest) < tuned.JUDGED:
            continue
        shift_m = float(np.median([np.linalg.norm(c.shift_m) for c in newest]))
        turn_rad = float(np.median([np.linalg.norm(c.rotation) for c in newest]))
        if shift_m > tuned.DRIFT_SHARE * poses.most_m or turn_rad > tuned.DRIFT_SHARE * poses.most_rad:
            off = f"{100 * shift_m:.1f} cm and {np.rad2deg(turn_rad):.1f} degrees"
            found.append(f"{track}: its poses drift: the picture asks for {off} (median); ask camera-node doctor")
    return found
