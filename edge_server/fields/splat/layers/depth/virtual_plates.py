"""Plates of cameras that are not there: views from between the real ones, drawn from depth plates.

Few cameras leave a field free to explain each of them alone. Views from between them bind it: it then learns Gaussians
that hold from anywhere between the cameras, as it does from many real ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.scene_box import converging_point
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.surfaces import Surface, SurfaceScene
from edge_server.fields.splat.layers.static_layer import PlateImage
from freshfield.geometry import look_at

Array = NDArray[np.float64]

NAME = "virtual {}"  # of a virtual camera; no real one's name has a space


def poses_between(poses: Sequence[Array], surfaces: Sequence[Surface], count: int) -> list[Array]:
    """Camera-to-world poses (4, 4) on a sphere about what the cameras look at, spread evenly over the angles that they
    span and MARGIN_DEG more.

    poses: of all cameras. surfaces: of those with depth, which say how far the scene is where axes do not meet.
    """
    stack = np.stack(poses)
    origins, axes = stack[:, :3, 3], stack[:, :3, 2]
    target = converging_point(origins, axes) if len(poses) > 1 else None
    if target is None:
        depths = [s.depth() for s in surfaces]
        ahead_m = float(np.median(np.concatenate([depth[depth > 0] for depth in depths])))
        target = origins.mean(axis=0) + ahead_m * axes.mean(axis=0)
    away: Array = origins - target
    radius = float(np.median(np.linalg.norm(away, axis=1)))
    own_up = -stack[:, :3, 1].mean(axis=0)
    axis = int(np.argmax(np.abs(own_up)))  # a world's z need not point up
    up, north = np.eye(3)[axis] * (np.sign(own_up[axis]) or 1.0), np.eye(3)[axis - 1]
    east, height = np.cross(north, up), away @ up
    azimuth = np.arctan2(away @ east, away @ north)
    middle = np.angle(np.exp(1j * azimuth).mean())
    azimuth = np.angle(np.exp(1j * (azimuth - middle)))
    elevation = np.arcsin(np.clip(height / np.maximum(np.linalg.norm(away, axis=1), 1e-9), -1.0, 1.0))
    margin = np.deg2rad(tuned.MARGIN_DEG)
    low = np.array([azimuth.min() - margin, max(elevation.min() - margin / 2, -1.5)])
    high = np.array([azimuth.max() + margin, min(elevation.max() + margin, 1.5)])
    out = []
    for k in range(count):
        a, e = low + (high - low) * np.array([_halton(k + 1, 2), _halton(k + 1, 3)])
        a += middle
        way = np.cos(e) * (np.sin(a) * east + np.cos(a) * north) + np.sin(e) * up
        out.append(look_at(target + radius * way, target, up))
    return out


def _halton(number: int, base: int) -> float:
    """The radical inverse: a sequence that fills [0, 1] evenly (Halton 1960)."""
    value, digit = 0.0, 1.0
    while number > 0:
        digit /= base
        value += digit * (number % base)
        number //= base
    return value


def virtual_plates(
    scene: SurfaceScene, surfaces: Sequence[Surface], poses: Sequence[Array], fill: bool, pool: Pool
) -> list[PlateImage]:
    """What cameras between the real ones would see, with weights: how sure that is, and little beside silhouettes.
    There sensors measure what is behind, and smoothing mixes both, so that the cameras' own plates know better.

    scene: of ``surfaces``. poses: of all cameras. fill: whether pixels that no camera sees get a color, and little
        weight, or none: a camera without depth may see them.
    """
    lens = replace(surfaces[0].lens, distortion=(0.0, 0.0, 0.0, 0.0))
    between = poses_between(poses, surfaces, tuned.VIRTUAL_PLATES)
    plates = []
    drawn = zip(between, *scene.render(between, lens, pool), strict=True)
    for k, (pose, color, agreement, inverse) in enumerate(drawn):
        picture = np.float32(255.0) * np.clip(fill_unseen(color, agreement), 0.0, 1.0)
        weight = np.maximum(agreement, tuned.UNSEEN_WEIGHT) if fill else agreement
        weight = np.where(beside_silhouettes(inverse), tuned.UNSEEN_WEIGHT * weight, weight)
        view = View(NAME.format(k), np.zeros(picture.shape, np.uint8), pose, lens)
        plates.append(PlateImage(view, picture, weight.astype(np.float32)))
    return plates


def beside_silhouettes(inverse: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The pixels near a jump of depth, bool (H, W): inverse depth bends there by more than CUT, on a plane not at all.
    None in a small picture, of which little else would be left. inverse: float32 (H, W), 1 / m, 0 unknown."""
    near = min(tuned.RADIUS, inverse.shape[1] // tuned.SILHOUETTE_SHARE)
    if near == 0:
        return np.zeros(inverse.shape, bool)
    wide = np.pad(inverse, 1, mode="edge")
    across = wide[1:-1, :-2] + wide[1:-1, 2:] - 2.0 * inverse
    down = wide[:-2, 1:-1] + wide[2:, 1:-1] - 2.0 * inverse
    jumps = (np.maximum(np.abs(across), np.abs(down)) > tuned.CUT).astype(np.uint8)
    return np.asarray(cv2.dilate(jumps, np.ones((2 * near + 1, 2 * near + 1), np.uint8)) > 0)


def fill_unseen(color: NDArray[np.float32], agreement: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give pixels that no camera sees a color: that of what is around, and farther away the mean color, which is the
    smallest mistake where nothing is known.

    color: float32 (H, W, 3). agreement: float32 (H, W) in [0, 1]. Returns float32 (H, W, 3).
    """
    seen = agreement > tuned.SURE
    if seen.all() or not seen.any():
        return color
    filled = _pull_push(color, agreement)
    distance = cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, 3)
    near = np.exp(-distance / np.float32(tuned.FADE_PX * color.shape[1] / 128.0))[..., None]
    return (filled * near + color[seen].mean(axis=0) * (1.0 - near)).astype(np.float32)


def _pull_push(color: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill by a pyramid of weighted means, down and back up (Gortler et al. 1996). The color where the weight is 1, the
    mean of what is known around where it is 0, in between the blend."""
    height, width = weight.shape
    weighted = color * weight[..., None]
    if min(height, width) <= 1:
        return weighted
    size = (width + 1) // 2, (height + 1) // 2
    low_weight = np.asarray(cv2.resize(weight, size, interpolation=cv2.INTER_AREA), np.float32)
    low = cv2.resize(weighted, size, interpolation=cv2.INTER_AREA)
    mean = np.asarray(low / np.maximum(low_weight, 1e-6)[..., None], np.float32)
    low = _pull_push(mean, np.asarray(np.minimum(4.0 * low_weight, 1.0), np.float32))
    up = cv2.resize(low, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(weighted + up * (1.0 - weight)[..., None], np.float32)
