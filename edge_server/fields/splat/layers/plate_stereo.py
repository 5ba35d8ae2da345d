"""Depth of plates by stereo, where cameras have no depth sensor: see ``kernels.semi_global``."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import UNIT_BOX, SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.layers import settings as tuned
from edge_server.fields.splat.layers.kernels.semi_global import UNKNOWN, aggregate_paths, choose_depths, match_costs
from edge_server.fields.splat.layers.static_layer import PlateImage
from freshfield.geometry import Pinhole, se3_inverse

Depths = list[NDArray[np.float32]]


def sweep_plates(plates: Sequence[PlateImage], box: SceneBox, pool: Pool) -> Depths:
    """Depth of each plate from the other plates, float32 (H, W), meters along the optical axis; 0 where the plate is
    unknown, where no depth fits best, or where no other plate's depth confirms it.

    Plates of more than ``SWEEP_PIXELS`` are matched at a lower resolution. box: of the scene.
    """
    lenses = [_lens(plate) for plate in plates]
    images = [_prepare(plate, lens) for plate, lens in zip(plates, lenses)]
    poses = [np.asarray(plate.view.camera_to_world, np.float64) for plate in plates]
    nearest_m = tuned.SWEEP_NEAR * box.distance_m
    inverse = np.linspace(0.0, 1.0 / nearest_m, tuned.SWEEP_STEPS).astype(np.float32)
    flat = np.zeros((len(images), 3, max(image[0].size for image in images)), np.float32)
    for row, image in zip(flat, images):
        row[:, : image[0].size] = image.reshape(3, -1)
    found = []
    for k, (lens, image) in enumerate(zip(lenses, images)):
        parallax_px = [_parallax_px(pose, poses[k], its) / nearest_m for pose, its in zip(poses, lenses)]
        others = [j for j, most in enumerate(parallax_px) if most >= tuned.SWEEP_LEAST_PX]
        depth = np.zeros(image.shape[1:], np.float32)
        if others:
            here = se3_inverse(poses[k])
            cameras = camera_rows([here @ poses[j] for j in others], [lenses[j] for j in others], UNIT_BOX)
            depth = _match(image, flat[others], cameras, lens, inverse, pool)
        found.append(depth)
    confirmed = [_confirmed(k, lenses, poses, found) for k in range(len(plates))]
    sizes = [plate.known.shape[::-1] for plate in plates]
    out = [cv2.resize(d, size, interpolation=cv2.INTER_NEAREST) for d, size in zip(confirmed, sizes)]
    return [depth.astype(np.float32, copy=False) for depth in out]


def _lens(plate: PlateImage) -> Pinhole:
    """The plate's lens, at the resolution at which it is matched."""
    factor = np.sqrt(tuned.SWEEP_PIXELS / plate.known.size)
    return plate.view.intrinsics.scaled(factor) if factor < 1.0 else plate.view.intrinsics


def _prepare(plate: PlateImage, lens: Pinhole) -> NDArray[np.float32]:
    """The plate's colors in [0, 1], or UNKNOWN, float32 (3, H, W), blurred as interpolation will blur the others'."""
    known = (plate.known > 0) & np.isfinite(plate.color).all(axis=2)
    rgba = np.dstack([np.where(known[..., None], np.clip(plate.color / 255.0, 0.0, 1.0), 0.0), known])
    small = cv2.resize(rgba.astype(np.float32), (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    color = np.clip(cv2.GaussianBlur(small[..., :3], (0, 0), tuned.SWEEP_BLUR_PX), 0.0, 1.0)
    color[cv2.blur(small[..., 3], (3, 3)) < 1.0 - 1e-3] = UNKNOWN
    return np.ascontiguousarray(color.transpose(2, 0, 1), dtype=np.float32)


def _parallax_px(a: NDArray[np.float64], b: NDArray[np.float64], lens: Pinhole) -> float:
    """Parallax of a point 1 m away from cameras at poses a and b; 0 for images of one row or column."""
    wide = min(lens.width, lens.height) > 1
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])) * lens.fx if wide else 0.0


def _match(
    image: NDArray[np.float32],
    others: NDArray[np.float32],
    cameras: NDArray[np.float32],
    lens: Pinhole,
    inverse: NDArray[np.float32],
    pool: Pool,
) -> NDArray[np.float32]:
    """Depth of one image, float32 (H, W), meters, 0 where none fits best. See ``match_costs``."""
    rays = lens.rays()
    ray_x, ray_y = (np.ascontiguousarray(rays[..., k] / rays[..., 2], dtype=np.float32) for k in (0, 1))
    cost = np.empty((*ray_x.shape, inverse.size), np.uint8)
    pool.run(match_costs, image, others, cameras, ray_x, ray_y, inverse, cost)
    total = np.empty((2, *cost.shape), np.uint16)
    pool.run(aggregate_paths, cost, np.minimum(image.max(axis=0), 1.0), total)
    found = np.empty(ray_x.shape, np.float32)
    pool.run(choose_depths, total, inverse, found)
    usable = (found > 0.5 * inverse[1]) & (image[0] <= 1.0)
    return np.where(usable, 1.0 / np.where(usable, found, 1.0), 0.0).astype(np.float32)


def _confirmed(k: int, lenses: Sequence[Pinhole], poses: Sequence[NDArray], depths: Depths) -> NDArray[np.float32]:
    """Depth k where another camera's depth agrees within ``SWEEP_AGREE``, else 0. One so near to
    camera k that it would see no difference cannot."""
    depth, rays = depths[k], lenses[k].rays()
    points = (rays * (depth / rays[..., 2])[..., None]) @ poses[k][:3, :3].T + poses[k][:3, 3]
    agree = np.zeros(depth.shape, bool)
    for j, (lens, pose) in enumerate(zip(lenses, poses)):
        if j == k:
            continue
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(invalid="ignore"):
            at = lens.project(local)
            inside = (depth > 0) & np.all((at >= 0) & (at < (lens.width, lens.height)), axis=-1)
        column, row = np.where(inside[..., None], at, 0.0).astype(np.int64).transpose(2, 0, 1)
        shown = depths[j][row, column]
        inside &= (shown > 0) & (depth <= _parallax_px(poses[k], pose, lens) / tuned.SWEEP_FAR_PX)
        ratio = np.where(inside, local[..., 2], 1.0) / np.where(inside, shown, 1.0)
        agree |= inside & (np.abs(np.log(ratio)) < tuned.SWEEP_AGREE)
    return np.where(agree, depth, np.float32(0.0))
