"""What is done where the scene moved: forget the Gaussians there, begin new ones, look there more often."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.kernels.pool import Pool
from edge_server.fields.kernels.splat_project import LENS, NEAR, OPACITY, ORIGIN, TILE
from edge_server.fields.scene_box import SceneBox
from edge_server.fields.splat_growth import Cloud, opacity
from edge_server.fields.splat_seeds import seeds
from edge_server.fields.splat_settings import SplatSettings

AGREE = 0.1  # a Gaussian whose colour is this near to the pixel's, channel by channel, may stay
MOST = 0.5  # of a picture: more is no body that moved, but another light or a broken frame
_SEEDS_A_PIXEL = 0.1


def changed_tiles(moved: Sequence[NDArray[np.bool_] | None]) -> list[NDArray[np.uint8] | None]:
    """For each view the tiles with changed pixels, uint8 (tiles,), or None where nothing changed, or nearly
    everything: then there is no place to look at more often than at others."""
    masks: list[NDArray[np.uint8] | None] = []
    for mask in moved:
        if mask is None or not 0.0 < mask.mean() < MOST:
            masks.append(None)
            continue
        h, w = mask.shape
        rows, columns = -(-h // TILE), -(-w // TILE)
        whole = np.zeros((rows * TILE, columns * TILE), np.uint8)
        whole[:h, :w] = mask
        masks.append(whole.reshape(rows, TILE, columns, TILE).max(axis=(1, 3)).reshape(-1))
    return masks


def forget_what_moved(
    settings: SplatSettings, pool: Pool, box: SceneBox, cloud: Cloud, views: Sequence[View],
    moved: Sequence[NDArray[np.bool_] | None], cams: NDArray[np.float32], rng: np.random.Generator,
) -> None:  # fmt: skip
    """Remove the Gaussians in the hull of what changed that no longer agree, and begin new ones there.

    The hull: most cameras that see the place see it change, two at least. Of what lies in it, a Gaussian is
    removed where its colour disagrees with most of the pixels that changed: the background behind a moving
    body stays.
    """
    needed = min(2, len(views))
    if sum(mask is not None for mask in moved) < needed:
        return  # what one camera alone sees change may be that camera
    sees = np.zeros(len(cloud), np.int32)
    marked, wrong = np.zeros_like(sees), np.zeros_like(sees)
    for view, mask, cam in zip(views, moved, cams):
        pixel = _pixels(cloud.params[:, :3], cam, view)
        inside = np.flatnonzero(pixel >= 0)
        sees[inside] += 1
        if mask is None:
            continue
        hit = inside[mask.reshape(-1)[pixel[inside]]]
        marked[hit] += 1
        colors = view.image.reshape(-1, view.image.shape[2])[pixel[hit]] / 255.0
        off = np.abs(colors[:, :3] - cloud.params[hit, OPACITY + 1 : OPACITY + 4]).max(axis=1) > AGREE
        if view.image.shape[2] == 4:
            off |= colors[:, 3] < 0.5
        wrong[hit] += off
    gone = (marked >= needed) & (2 * marked >= sees) & (2 * wrong >= marked)
    cloud.keep(~gone)
    pixels = sum(int(m.sum()) for m in moved if m is not None)
    most = int(settings.reseed * settings.gaussians)
    count = min(most, max(int(gone.sum()), int(_SEEDS_A_PIXEL * pixels)))
    over = len(cloud) + count - settings.gaussians
    if over > 0:  # room is made by the ones that show least
        keep = np.ones(len(cloud), bool)
        keep[np.argsort(opacity(cloud.params), kind="stable")[:over]] = False
        cloud.keep(keep)
    cloud.add(seeds(settings, pool, box, views, moved, count, rng))


def _pixels(points: NDArray[np.float32], cam: NDArray[np.float32], view: View) -> NDArray[np.int64]:
    """The pixel each point (N, 3) in scene units falls on, -1 outside the picture."""
    local = (points - cam[ORIGIN:LENS]) @ cam[:ORIGIN].reshape(3, 3).T
    lens = view.intrinsics
    front = local[:, 2] > cam[NEAR]
    safe = np.where(front[:, None], local, [0.0, 0.0, 1.0])
    u, v = np.floor(lens.project(safe)).clip(-1e6, 1e6).astype(np.int64).T
    inside = front & (u >= 0) & (v >= 0) & (u < lens.width) & (v < lens.height)
    return np.where(inside, v * lens.width + u, -1)
