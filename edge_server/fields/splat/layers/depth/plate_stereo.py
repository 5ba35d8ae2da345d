"""Depth of plates by stereo, where no sensor measures it: see ``kernels.semi_global``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.layers.depth import settings as tuned
from edge_server.fields.splat.layers.depth.depth_plate import smooth
from edge_server.fields.splat.layers.depth.kernels.semi_global import (
    UNKNOWN,
    aggregate_paths,
    choose_depths,
    match_costs,
)
from edge_server.fields.splat.layers.depth.surfaces import Surface
from freshfield.geometry import Pinhole, se3_inverse

Image = NDArray[np.float32]


def fill_by_stereo(surfaces: Sequence[Surface], distance_m: float, pool: Pool) -> list[Surface] | None:
    """The surfaces with the depth that stereo finds where they have none; None where it cannot be believed: it finds
    little, or sensors measured something else at too many of its pixels. distance_m: see ``sweep_plates``."""
    swept = sweep_plates(surfaces, distance_m, pool)
    if sum(map(np.count_nonzero, swept)) < tuned.SWEEP_LEAST * sum(np.count_nonzero(s.known) for s in surfaces):
        return None
    pairs = [np.stack([s.inverse, found])[:, (s.inverse > 0) & (found > 0)] for s, found in zip(surfaces, swept)]
    measured, ours = np.concatenate(pairs, axis=1)
    agree = np.count_nonzero(np.abs(np.log(ours / measured)) < tuned.SWEEP_AGREE)
    if agree < tuned.SWEEP_TRUSTED * len(ours):
        return None
    out, noise = [], tuned.SWEEP_NOISE / (tuned.SWEEP_STEPS * tuned.SWEEP_NEAR * distance_m)
    for surface, found in zip(surfaces, swept):
        inverse, slope = smooth(found, surface.color, pool, noise)
        known = surface.inverse > 0
        inverse = np.where(known, surface.inverse, inverse)
        out.append(replace(surface, inverse=inverse, slope=np.where(known[..., None], surface.slope, slope)))
    return out


def sweep_plates(surfaces: Sequence[Surface], distance_m: float, pool: Pool) -> list[Image]:
    """Inverse depth of each plate from the other plates, float32 (H, W), 1 / m along the optical axis; 0 where the
    plate is unknown, where no depth fits best, or where no other plate's depth confirms it.

    surfaces: plates; what they know of depth is not used. Those of more than ``SWEEP_PIXELS`` are matched smaller.
    distance_m: of the cameras to the scene.
    """
    lenses, poses = [_lens(s) for s in surfaces], [s.pose for s in surfaces]
    images = [_prepare(s, lens) for s, lens in zip(surfaces, lenses)]
    nearest_m = tuned.SWEEP_NEAR * distance_m
    steps = np.linspace(0.0, 1.0 / nearest_m, tuned.SWEEP_STEPS).astype(np.float32)
    flat = np.zeros((len(images), 3, max(image[0].size for image in images)), np.float32)
    for row, image in zip(flat, images):
        row[:, : image[0].size] = image.reshape(3, -1)
    found = []
    for k, (lens, image) in enumerate(zip(lenses, images)):
        parallax_px = [_parallax_px(pose, poses[k], its) / nearest_m for pose, its in zip(poses, lenses)]
        others = [j for j, most in enumerate(parallax_px) if most >= tuned.SWEEP_LEAST_PX]
        inverse = np.zeros(image.shape[1:], np.float32)
        if others:
            here = se3_inverse(poses[k])
            cameras = camera_rows([here @ poses[j] for j in others], [lenses[j] for j in others], UNIT_BOX)
            inverse = _match(image, flat[others], cameras, lens, steps, pool)
        found.append(inverse)
    confirmed = [_confirmed(k, lenses, poses, found) for k in range(len(surfaces))]
    sizes = [s.known.shape[::-1] for s in surfaces]
    out = [cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image, size in zip(confirmed, sizes)]
    return [np.where(s.known, inverse, 0.0).astype(np.float32) for s, inverse in zip(surfaces, out)]


def _lens(surface: Surface) -> Pinhole:
    """The plate's lens, at the resolution at which it is matched."""
    factor = np.sqrt(tuned.SWEEP_PIXELS / surface.known.size)
    return surface.lens.scaled(factor) if factor < 1.0 else surface.lens


def _prepare(surface: Surface, lens: Pinhole) -> Image:
    """The plate's colors in [0, 1], or UNKNOWN, float32 (3, H, W), blurred as interpolation will blur the others'."""
    known = surface.known & np.isfinite(surface.color).all(axis=2)
    rgba = np.dstack([np.where(known[..., None], np.clip(surface.color / 255.0, 0.0, 1.0), 0.0), known])
    small = cv2.resize(rgba.astype(np.float32), (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    color = np.clip(cv2.GaussianBlur(small[..., :3], (0, 0), tuned.SWEEP_BLUR_PX), 0.0, 1.0)
    color[cv2.blur(small[..., 3], (3, 3)) < 1.0 - 1e-3] = UNKNOWN
    return np.ascontiguousarray(color.transpose(2, 0, 1), dtype=np.float32)


def _parallax_px(a: NDArray[np.float64], b: NDArray[np.float64], lens: Pinhole) -> float:
    """Parallax of a point 1 m away from cameras at poses a and b; 0 for images of one row or column."""
    wide = min(lens.width, lens.height) > 1
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])) * lens.fx if wide else 0.0


def _match(image: Image, others: Image, cameras: Image, lens: Pinhole, steps: Image, pool: Pool) -> Image:
    """Inverse depth of one image, float32 (H, W), 1 / m, 0 where none fits best. See ``match_costs``."""
    rays = lens.rays()
    ray_x, ray_y = (np.ascontiguousarray(rays[..., k] / rays[..., 2], dtype=np.float32) for k in (0, 1))
    cost = np.empty((*ray_x.shape, steps.size), np.uint8)
    pool.run(match_costs, image, others, cameras, ray_x, ray_y, steps, cost)
    total = np.empty((2, *cost.shape), np.uint16)
    pool.run(aggregate_paths, cost, np.minimum(image.max(axis=0), 1.0), total)
    found = np.empty(ray_x.shape, np.float32)
    pool.run(choose_depths, total, steps, found)
    return np.where((found > 0.5 * steps[1]) & (image[0] <= 1.0), found, 0.0).astype(np.float32)


def _confirmed(k: int, lenses: Sequence[Pinhole], poses: Sequence[NDArray], inverses: Sequence[Image]) -> Image:
    """Inverse depth k where another camera's depth agrees within ``SWEEP_AGREE``, else 0. One so near to camera k that
    it would see no difference cannot."""
    there, rays = inverses[k] > 0, lenses[k].rays()
    depth = np.where(there, 1.0 / np.where(there, inverses[k], 1.0), 0.0)
    points = (rays * (depth / rays[..., 2])[..., None]) @ poses[k][:3, :3].T + poses[k][:3, 3]
    agree = np.zeros(depth.shape, bool)
    for j, (lens, pose) in enumerate(zip(lenses, poses)):
        if j == k:
            continue
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(invalid="ignore"):
            at = lens.project(local)
            inside = there & np.all((at >= 0) & (at < (lens.width, lens.height)), axis=-1)
        column, row = np.where(inside[..., None], at, 0.0).astype(np.int64).transpose(2, 0, 1)
        ratio = np.where(inside, local[..., 2], 1.0) * inverses[j][row, column]
        near = np.abs(np.log(np.maximum(ratio, 1e-9))) < tuned.SWEEP_AGREE
        agree |= inside & near & (depth <= _parallax_px(poses[k], pose, lens) / tuned.SWEEP_FAR_PX)
    return np.where(agree, inverses[k], np.float32(0.0))
