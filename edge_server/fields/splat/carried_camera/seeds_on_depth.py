"""New Gaussians from an image with depth: flat discs on its surfaces, the smaller the more detail they show."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.densification import raw_opacity
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE
from freshfield.geometry import Pinhole, matrix_to_quaternion, quaternion_multiply

Array = NDArray[np.float64]


class Leaves(NamedTuple):
    """Leaves of a quadtree over an image: row and column of the first pixel, and side, int64 (N,)."""

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    side: NDArray[np.int64]


def quadtree(color: NDArray[np.float32], wanted: NDArray[np.bool_], cells: tuple[int, ...], detail: float) -> Leaves:
    """The leaves that cover the ``wanted`` pixels, bool (H, W), divided where the standard deviation of the color,
    float32 (H, W, 3), summed over channels, exceeds ``detail``, or where not all pixels are wanted.

    cells: sides in pixels, each half of the one before; the last are not divided.
    """
    high, wide = (-(-size // cells[0]) * cells[0] for size in wanted.shape)
    pads = ((0, high - wanted.shape[0]), (0, wide - wanted.shape[1]))
    there = np.pad(wanted, pads).astype(np.float32)
    padded = np.pad(color, (*pads, (0, 0)), mode="edge")
    open_ = np.ones((high // cells[0], wide // cells[0]), np.bool_)
    found = []
    for side in cells:
        size = (wide // side, high // side)
        share = cv2.resize(there, size, interpolation=cv2.INTER_AREA)
        mean = cv2.resize(padded, size, interpolation=cv2.INTER_AREA)
        square = cv2.resize(padded * padded, size, interpolation=cv2.INTER_AREA)
        spread = np.sqrt(np.maximum(square - mean * mean, 0.0).sum(axis=2))
        open_ &= share > tuned.MIXED[0]
        divided = open_ & ((spread > detail) | (share < tuned.MIXED[1])) & (side != cells[-1])
        row, column = np.nonzero(open_ & ~divided)
        found.append(Leaves(row * side, column * side, np.full(row.size, side)))
        open_ = divided.repeat(2, axis=0).repeat(2, axis=1)
    return Leaves(*(np.concatenate(parts) for parts in zip(*found)))


def usable_depth(depth: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Depth (H, W), meters, 0 where it is unknown, cannot be, or lies between two surfaces; None if nothing is left."""
    if depth is None or min(depth.shape) < tuned.LEAST_SIDE:
        return None
    depth = np.where((depth > tuned.DEPTH_M[0]) & (depth < tuned.DEPTH_M[1]), depth, np.float32(0.0))
    kernel = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), kernel)
    span = cv2.dilate(depth, kernel) - nearest
    depth = np.where(span > tuned.JUMP_SHARE * depth + tuned.JUMP_M, np.float32(0.0), depth)
    return depth if depth.any() else None


def filled(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth (H, W) whose unknown pixels have that of the nearest known one; all 0 if none is known."""
    unknown = (depth <= 0).astype(np.uint8)
    if not unknown.any() or unknown.all():
        return depth
    _, label = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros(int(label.max()) + 1, np.float32)
    known = unknown == 0
    by_label[label[known]] = depth[known]
    return by_label[label]


def discs(
    color: NDArray[np.float32],
    depth: NDArray[np.float32],
    leaves: Leaves,
    lens: Pinhole,
    pose: Array,
    width: float,
    opacity: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Parameters (N, BASE) of a Gaussian for each leaf, in meters.

    color: float32 (H, W, 3). depth: float32 (H, W), along the optical axis, meters, > 0 at every leaf.
    pose: camera to world (4, 4). width: standard deviation in sides of a leaf. opacity: float32 (N,).
    """
    h, w = depth.shape
    side = leaves.side.astype(np.float64)
    y, x = np.minimum(leaves.row + side / 2, h), np.minimum(leaves.column + side / 2, w)
    smooth = cv2.blur(depth, (5, 5))
    iy, ix = np.clip(y.astype(np.int64), 2, h - 3), np.clip(x.astype(np.int64), 2, w - 3)
    z = depth[np.minimum(y.astype(np.int64), h - 1), np.minimum(x.astype(np.int64), w - 1)].astype(np.float64)

    def point(dx: int, dy: int) -> Array:
        ray = lens.rays(np.stack([ix + dx + 0.5, iy + dy + 0.5], axis=-1))
        return np.asarray(ray / ray[:, 2:] * smooth[iy + dy, ix + dx, None])

    ray = lens.rays(np.stack([x, y], axis=-1))
    normal = np.cross(point(2, 0) - point(-2, 0), point(0, 2) - point(0, -2))
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 1e-12, normal / np.maximum(length, 1e-12), ray)
    normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0)
    facing = (normal * ray).sum(axis=1)
    normal = np.where((facing < 0.5 * tuned.STEEPEST)[:, None], ray, normal)
    params = np.zeros((len(z), BASE), np.float32)
    params[:, :3] = (ray / ray[:, 2:] * z[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    sigma = width * side * z / lens.fx
    tilt = np.maximum((normal * ray).sum(axis=1), tuned.STEEPEST)
    params[:, SCALE : SCALE + 3] = np.log(np.stack([sigma, sigma / tilt, tuned.FLATNESS * sigma], axis=1))
    params[:, QUATERNION : QUATERNION + 4] = quaternion_multiply(matrix_to_quaternion(pose[:3, :3]), _tilts(normal))
    params[:, OPACITY] = raw_opacity(opacity)
    params[:, COLOR:BASE] = _means(color, leaves)
    return params


def _tilts(normal: Array) -> Array:
    """Quaternions (N, 4) that turn the third axis to unit vectors (N, 3) in front of it, and keep the first one at a
    right angle to the tilt."""
    tilt = np.hypot(normal[:, 0], normal[:, 1])
    half = 0.5 * np.arctan2(tilt, normal[:, 2])
    spin = 0.5 * np.arctan2(normal[:, 0], -normal[:, 1])  # from the first axis to the axis of the tilt
    zero = np.zeros_like(half)
    axis = np.stack([np.cos(2.0 * spin), np.sin(2.0 * spin), zero], axis=1) * np.sin(half)[:, None]
    arc = np.concatenate([np.cos(half)[:, None], axis], axis=1)
    return quaternion_multiply(arc, np.stack([np.cos(spin), zero, zero, np.sin(spin)], axis=1))


def _means(color: NDArray[np.float32], leaves: Leaves) -> NDArray[np.float32]:
    """The mean color (N, 3) of each leaf, as far as it lies within the image."""
    total = cv2.integral(color)
    h, w = color.shape[:2]
    y0, x0 = leaves.row, leaves.column
    y1, x1 = np.minimum(y0 + leaves.side, h), np.minimum(x0 + leaves.side, w)
    sums = total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0]
    return (sums / np.maximum((y1 - y0) * (x1 - x0), 1)[:, None]).astype(np.float32)
