"""Depth of a hand-held camera's frame from neighboring frames, if no sensor measures it: see ``stereo``.

Images are compared by their local contrast, so that their exposures do not matter.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.background import foreground_mask
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.kernels.semi_global import UNKNOWN
from edge_server.fields.splat.stereo import match_depths
from freshfield.geometry import Pinhole

Array = NDArray[np.float64]


def neighbors(pose: Array, others: Sequence[Array], distance_m: float) -> list[int]:
    """Indices of the other cameras with a baseline to ``pose`` that see the same surfaces: at most ``SWEPT_WITH``, best
    first.

    pose, others: camera to world (4, 4). distance_m: from the camera to the surfaces that it sees.
    """
    if not others:
        return []
    poses = np.stack(others)
    here, axis = pose[:3, 3], pose[:3, 2]
    seen = here + distance_m * axis
    away = poses[:, :3, 3] - seen
    cosine = away @ -axis / np.maximum(np.linalg.norm(away, axis=1), 1e-12)
    angle_deg = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    facing = poses[:, :3, 2] @ axis
    low, best, high = tuned.SWEPT_ANGLES_DEG
    cost = np.abs(np.log(np.maximum(angle_deg, 1e-6) / best)) + tuned.SWEPT_TURNED * (1.0 - facing)
    cost[~((angle_deg >= low) & (angle_deg <= high) & (facing >= tuned.SWEPT_FACING))] = np.inf
    order = np.argsort(cost, kind="stable")[: tuned.SWEPT_WITH]
    return [int(k) for k in order if np.isfinite(cost[k])]


def sweep_depth(view: View, others: Sequence[View], distance_m: float, pool: Pool) -> NDArray[np.float32] | None:
    """Depth of a view, float32 (H, W), meters along the optical axis, 0 where it is unknown; None if no other view
    shows the same from elsewhere.

    view, others: at their estimated poses. distance_m: see ``neighbors``; surfaces nearer than ``SWEPT_NEAR`` of it
        are not found.
    """
    near = neighbors(view.camera_to_world, [other.camera_to_world for other in others], distance_m)
    if not near:
        return None
    image, lens = _prepare(view)
    prepared = [_prepare(others[k]) for k in near]
    flat = np.zeros((len(near), 3, max(other[0].size for other, _ in prepared)), np.float32)
    for row, (other, _) in zip(flat, prepared):
        row[:, : other[0].size] = other.reshape(3, -1)
    cameras = [(others[k].camera_to_world, its) for k, (_, its) in zip(near, prepared)]
    steps = np.linspace(0.0, 1.0 / (tuned.SWEPT_NEAR * distance_m), tuned.SWEPT_STEPS).astype(np.float32)
    inverse = match_depths(image, view.camera_to_world, lens, flat, cameras, steps, pool)
    depth = np.where(inverse > 0, 1.0 / np.where(inverse > 0, inverse, 1.0), 0.0).astype(np.float32)
    size = (view.intrinsics.width, view.intrinsics.height)
    return np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)


def _prepare(view: View) -> tuple[NDArray[np.float32], Pinhole]:
    """The local contrast of a view's image, float32 (3, H, W), in [0, 1] or UNKNOWN, and the lens of that size."""
    lens = view.intrinsics.scaled(min(np.sqrt(tuned.SWEPT_PIXELS / view.image[..., 0].size), 1.0))
    size, sigma = (lens.width, lens.height), tuned.CONTRAST_PX
    image = cv2.resize(view.image[..., :3].astype(np.float32) / 255.0, size, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), tuned.SWEPT_BLUR_PX)
    mean = cv2.GaussianBlur(image, (0, 0), sigma)
    variance = np.maximum(cv2.GaussianBlur(image * image, (0, 0), sigma) - mean * mean, 0.0).mean(axis=2)
    contrast = (image - mean) / (np.sqrt(variance) + tuned.CONTRAST_NOISE)[..., None]
    out = np.clip(0.5 + tuned.CONTRAST_GAIN * contrast, 0.0, 1.0)
    there = foreground_mask(view.image, None)
    if view.weight is not None:
        there &= view.weight > 0
    out[cv2.resize(there.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0] = UNKNOWN
    return np.ascontiguousarray(out.transpose(2, 0, 1), dtype=np.float32), lens
