"""Plausibility of a hand-held camera's frames: detects moving objects, covered lenses and late or drifting poses."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.cameras.mount_error import constant_correction
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.carried_camera.pose_alignment import gray
from edge_server.fields.splat.carried_camera.scan_field import Shown
from freshfield.geometry import se3_inverse, seen_from, so3_log

Array = NDArray[np.float64]


def moved_in(now: View, pose: Array, before: View, before_pose: Array) -> NDArray[np.bool_]:
    """Pixels, bool (H, W), of surfaces in space that an earlier frame saw as free: they have appeared since. This holds
    for no static surface, even one new to the camera. Both views have depth; poses: camera to world (4, 4)."""
    assert now.depth is not None and before.depth is not None
    every, lens, other = tuned.MOVED_EVERY, now.intrinsics, before.intrinsics
    z = now.depth[::every, ::every].astype(np.float64)
    y, x = np.mgrid[: z.shape[0], : z.shape[1]] * every
    ray = lens.rays(np.stack([x + 0.5, y + 0.5], axis=-1))
    points = (ray / ray[..., 2:] * z[..., None]).reshape(-1, 3)
    local, at, inside = seen_from(other, se3_inverse(pose) @ before_pose, points)
    ahead = local[:, 2].reshape(z.shape)
    there = (z > 0) & (ahead > 1e-3) & inside.reshape(z.shape)
    u, v = np.where(inside[:, None], at, 0.0).astype(np.int64).T.reshape(2, *z.shape)
    # The nearest surface in the neighborhood: edges and pose errors do not count as free space.
    known = np.where(before.depth > 0, before.depth, np.float32(0.0))
    nearest = cv2.erode(known, np.ones((2 * every + 1, 2 * every + 1), np.uint8))
    through = there & (nearest[v, u] > ahead * (1.0 + tuned.MOVED_SHARE) + tuned.MOVED_M)
    kernel = np.ones((3, 3), np.uint8)
    found = cv2.dilate(cv2.morphologyEx(through.astype(np.uint8), cv2.MORPH_OPEN, kernel), kernel)
    size = (now.image.shape[1], now.image.shape[0])
    return cv2.resize(found, size, interpolation=cv2.INTER_NEAREST).astype(bool)


def agreeing(view: View, shown: Shown, gain: Array, bias: Array) -> float:
    """The share of consistent pixels of a view, among those where the field shows a surface."""
    expected = shown.color * gain.astype(np.float32) + bias.astype(np.float32)
    surface = shown.opacity[::2, ::2] >= tuned.ALIGNED_OPACITY
    error = np.abs(gray(expected[::2, ::2]) - gray(view.image[::2, ::2]))[surface]
    return float((error < tuned.SOFT).mean()) if error.size else 1.0


def flat(view: View, shown: Shown) -> bool:
    """Whether a view has hardly any contrast where the field has some: its lens is covered, or it is dark. Otherwise an
    exposure could be found that makes it consistent."""
    surface = shown.opacity >= tuned.ALIGNED_OPACITY
    if surface.mean() < tuned.LEAST_OVERLAP:
        return False
    contrast, expected = (float(gray(each)[surface].std()) for each in (view.image, shown.color))
    return contrast < tuned.FLAT * expected


def unturned(before: View, now: View) -> bool:
    """Whether two views of a camera are reported with the same rotation, and their images contradict that: most
    corners do not move as the reported translation would move them at any depth."""
    turned = np.abs(now.camera_to_world[:3, :3] - before.camera_to_world[:3, :3]).max()
    if turned > tuned.SAME_TURN or before.image.shape != now.image.shape:
        return False
    shift = now.camera_to_world[:3, :3].T @ (now.camera_to_world - before.camera_to_world)[:3, 3]
    first, second = (cv2.cvtColor(np.ascontiguousarray(v.image[..., :3]), cv2.COLOR_RGB2GRAY) for v in (before, now))
    corners = cv2.goodFeaturesToTrack(first, tuned.CORNERS, tuned.CORNER_QUALITY, tuned.CORNERS_APART_PX)
    if corners is None or second.std() < 255.0 * tuned.BARE:
        return False
    found, known, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, np.zeros_like(corners))
    here, there = (each[known.ravel() == 1].reshape(-1, 2).astype(np.float64) + 0.5 for each in (corners, found))
    if len(here) < tuned.LEAST_CORNERS:
        return False
    rays, others = before.intrinsics.rays(here), now.intrinsics.rays(there)
    at, flow = rays[:, :2] / rays[:, 2:], others[:, :2] / others[:, 2:] - rays[:, :2] / rays[:, 2:]
    way = at * shift[2] - shift[:2]  # away from the focus of expansion, farther the nearer a corner is
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    beside = flow - np.maximum((flow * way).sum(axis=1, keepdims=True), 0.0) * way
    moved_px, beside_px = (now.intrinsics.fx * np.median(np.linalg.norm(each, axis=1)) for each in (flow, beside))
    return bool(beside_px > max(tuned.BESIDE_PX, tuned.BESIDE_SHARE * moved_px))


def troubles(poses: PoseCorrections) -> list[str]:
    """Problems of poses that follow from their corrections, a line each."""
    found = []
    for track in poses.tracks():
        newest = poses.newest(track, tuned.JUDGED)
        if len(newest) < tuned.JUDGED:
            continue
        late_s = _lateness_s(newest)
        if late_s is not None:
            word = "late" if late_s > 0 else "early"
            least = f"by some {1e3 * abs(late_s):.0f} ms or more"  # corrections cover only a part of a delay
            found.append(f"{track}: its poses are {word} {least}: camera-node doctor measures it in a recording")
        shift_m = float(np.median([np.linalg.norm(c.shift_m) for c in newest]))
        turn_rad = float(np.median([np.linalg.norm(c.rotation) for c in newest]))
        if shift_m > tuned.DRIFT_SHARE * poses.most_m or turn_rad > tuned.DRIFT_SHARE * poses.most_rad:
            off = f"{100 * shift_m:.1f} cm and {np.rad2deg(turn_rad):.1f} degrees"
            found.append(f"{track}: its poses drift: the picture asks for {off} (median)")
        path = poses.newest(track, tuned.MOUNT_POSES)
        mount = constant_correction([c.given for c in path], [c.pose for c in path])
        if mount is not None and mount.sure and late_s is None:
            found.append(f"{track}: {mount.words}")
    return found


def _lateness_s(views: Sequence) -> float | None:
    """By how much poses lag behind images, if that explains their corrections; None if not. views: corrections in the
    order of time."""
    moves, corrections = [], []
    scale = np.array([1.0 / tuned.PRIOR_RAD] * 3 + [1.0 / tuned.PRIOR_M] * 3)
    for before, now, after in zip(views, views[1:], views[2:]):
        seconds = (after.at_ns - before.at_ns) / 1e9
        if not 0.0 < seconds < tuned.LONGEST_GAP_S:
            continue
        axes = now.given[:3, :3]
        turn = so3_log(before.given[:3, :3].T @ after.given[:3, :3])
        shift = axes.T @ (after.given[:3, 3] - before.given[:3, 3])
        moves.append(np.concatenate([turn, shift]) * scale / seconds)
        corrections.append(np.concatenate([axes.T @ now.rotation, axes.T @ now.shift_m]) * scale)
    if len(moves) < tuned.JUDGED // 2:
        return None
    v, c = np.stack(moves), np.stack(corrections)
    v, c = v - v.mean(axis=0), c - c.mean(axis=0)  # a constant part is a calibration error
    if not (v * v).sum() > 0.0:
        return None
    late_s = float((v * c).sum() / (v * v).sum())
    explained = 1.0 - float(((c - late_s * v) ** 2).sum()) / max(float((c * c).sum()), 1e-12)
    return late_s if explained > tuned.LATE_EXPLAINS and abs(late_s) > tuned.LATE_S else None
