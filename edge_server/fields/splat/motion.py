"""What is done where the scene moved: carry the Gaussians of a moving body along, forget those that no longer
agree with the pictures, begin new ones where pictures are still wrong, look there more often.

A *guest* is a Gaussian begun where something moved. Guests have a velocity, so that views of different ages
each supervise the instant they were taken at, and what is shown may be carried on to the present.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.kernels.thread_pool import Pool
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud, prune_least_sensitive
from edge_server.fields.splat.kernels.optimizer_step import position_gradients
from edge_server.fields.splat.kernels.project import TILE, Gaussians
from edge_server.fields.splat.kernels.rasterize import Loss, compare_tiles, train_tiles
from edge_server.fields.splat.kernels.view_evidence import Evidence, collect_evidence
from edge_server.fields.splat.seeding import seed_gaussians
from edge_server.fields.splat.settings import SplatSettings

AGREE = 0.1  # a Gaussian whose colour is this near to the pixel's, channel by channel, may stay
AGREE_GUEST = 0.5  # the same for one that moves: carried along, it is a little off for a while
STAYS = 0.02  # by which a colour must agree better with where a guest was for it to stay there
OFF = 0.08  # a pixel this near to what it should be is shown well enough
MOST = 0.5  # of a picture: more is no body that moved, but another light or a broken frame
SEEDS_A_PIXEL = 0.1

LONGEST_S = 0.45  # after a longer pause, nothing is known of how things move: people turn
FASTEST_M_PER_S = 8.0
TRACKING_VIEWS = 6  # a step
LEFT = 4  # updates after which a guest that moves no more belongs to the scene
# Carrying: bodies first, then their limbs. Cells in pixels at the scene's distance; the first step in metres
# for each second since the last update.
CELLS_PX, FALL = (32.0, 8.0), 0.85
STEPS_M_PER_S = (0.25, 0.1)
_TO_VELOCITY = 0.7  # of a correction that is taken for a wrong velocity rather than a wrong place


@dataclass
class SceneChange:
    """One set of views and what changed in them.

    moved: for each view bool (H, W) or None, pixels of weight 0 left out; tiles: the same by tiles, uint8
    (T,), see ``changed_tiles``. cams: float32 (V, CAMERA), with the time each picture was taken. elapsed_s:
    since the last set. asked: how many of the views have pixels of more weight than 0.
    """

    box: SceneBox
    views: Sequence[View]
    data: Views
    moved: Sequence[NDArray[np.bool_] | None]
    tiles: Sequence[NDArray[np.uint8] | None]
    cams: NDArray[np.float32]
    background: NDArray[np.float32]
    elapsed_s: float
    asked: int

    def evidence(
        self, pool: Pool, gaussians: Gaussians, allowed: NDArray[np.float32] | None = None
    ) -> Evidence:
        """What the pictures say of each Gaussian. allowed: see ``collect_evidence``; none: nothing is ever wrong."""
        count, data = len(gaussians.params), self.data
        found = Evidence.zeros(count)
        marks = np.zeros(int(data.first[-1]), np.uint8)
        for mask, first in zip(self.moved, data.first):
            if mask is not None:
                marks[first : first + mask.size] = mask.reshape(-1)
        if allowed is None:
            allowed = np.full(count, np.inf, np.float32)
        pool.run(collect_evidence, self.cams, data, marks, gaussians, allowed, found)
        return found


def weighted_changes(
    moved: Sequence[NDArray[np.bool_] | None], data: Views
) -> list[NDArray[np.bool_] | None]:
    """``moved`` without pixels of weight 0; None for views of which nothing is left."""
    if data.weight.size == 0:
        return list(moved)
    left: list[NDArray[np.bool_] | None] = []
    for k, mask in enumerate(moved):
        if mask is not None:
            mask = mask & (data.weight[data.first[k] : data.first[k + 1]] > 0).reshape(mask.shape)
        left.append(mask if mask is not None and mask.any() else None)
    return left


def changed_tiles(moved: Sequence[NDArray[np.bool_] | None]) -> list[NDArray[np.uint8] | None]:
    """For each view the tiles with changed pixels, uint8 (tiles,), or None where nothing changed, or nearly
    everything: then there is no place to look at more often than at others."""
    masks: list[NDArray[np.uint8] | None] = []
    for mask in moved:
        if mask is None or not 0.0 < mask.mean() < MOST:
            masks.append(None)
            continue
        masks.append(_tile_mask(mask))
    return masks


def unweighted_tiles(data: Views) -> list[NDArray[np.uint8] | None]:
    """For each view the tiles with pixels of weight 0, uint8 (tiles,), or None where there are none."""
    masks: list[NDArray[np.uint8] | None] = [None] * len(data.size)
    if data.weight.size:
        for k, ((w, h), first) in enumerate(zip(data.size, data.first)):
            silent = data.weight[first : first + w * h].reshape(h, w) == 0
            masks[k] = _tile_mask(silent) if silent.any() else None
    return masks


def _tile_mask(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    h, w = mask.shape
    rows, columns = -(-h // TILE), -(-w // TILE)
    whole = np.zeros((rows * TILE, columns * TILE), np.uint8)
    whole[:h, :w] = mask
    tiles: NDArray[np.uint8] = whole.reshape(rows, TILE, columns, TILE).max(axis=(1, 3)).reshape(-1)
    return tiles


def extrapolate(cloud: GaussianCloud, elapsed_s: float, moves: bool) -> None:
    """Let every guest go on as it went, or back if the newest view is an older one; after a long pause, or
    where no camera sees anything move, none."""
    if not moves or not abs(elapsed_s) <= LONGEST_S:
        cloud.velocity[:] = 0.0
    cloud.params[:, :3] += cloud.velocity * np.float32(elapsed_s)


def track(
    settings: SplatSettings, raster: RasterBuffers, cloud: GaussianCloud, seen: SceneChange, steps: int
) -> Iterator[tuple[float, int, int]]:
    """Move the guests together until the pictures agree: first as whole bodies, then in smaller parts. Their
    velocities follow. Yields (squared error, pixels, pairs) of each of ``steps`` steps at most.

    A descent with the gradient of all Gaussians of a cell: alone, each would rather change its colour.
    """
    guests = np.flatnonzero(cloud.guest).astype(np.int64)
    slots = [k for k, t in enumerate(seen.tiles) if t is not None]
    if guests.size == 0 or len(slots) < min(2, seen.asked) or not 0 < seen.elapsed_s <= LONGEST_S:
        return
    loss = Loss(False, np.float32(0.0), seen.background, False, np.uint64(0))
    # Of the cloud, only what shows in the tiles that changed.
    raster.project_and_bin(np.ascontiguousarray(seen.cams[slots]), cloud.gaussians(settings.harmonics),
                [seen.tiles[k] for k in slots], differentiate=False)  # fmt: skip
    shows = np.asarray((raster.lists.own_count[: len(slots), : len(cloud)] > 0).any(axis=0))
    shows[guests] = True
    some, theirs = np.flatnonzero(shows), guests
    guests = np.searchsorted(some, theirs).astype(np.int64)
    gaussians = Gaussians(cloud.params[some], settings.harmonics, cloud.velocity[some])
    place, velocity = gaussians.params[:, :3], gaussians.velocity
    slope = np.zeros((guests.size, 3), np.float32)
    pixel = seen.box.pixel_m / seen.box.radius_m
    fastest = FASTEST_M_PER_S / seen.box.radius_m
    for level, (cell_px, step_m_per_s) in enumerate(zip(CELLS_PX, STEPS_M_PER_S)):
        step = step_m_per_s * seen.elapsed_s / seen.box.radius_m
        cell = _grid_cells(place[guests], cell_px * pixel)
        count = int(cell.max()) + 1
        m, v = np.zeros((count, 3)), np.zeros(count)
        for k in range((steps + 1 - level) // 2):
            turn = (steps - k) * TRACKING_VIEWS + level  # other views each time
            some_slots = [slots[(turn + j) % len(slots)] for j in range(min(TRACKING_VIEWS, len(slots)))]
            picked, cams = np.array(some_slots, np.int64), np.ascontiguousarray(seen.cams[some_slots])
            raster.project_and_bin(cams, gaussians, [seen.tiles[k] for k in some_slots])
            tasks = raster.tasks()
            losses = np.zeros((len(tasks), 3))
            raster.pool.run(
                train_tiles, seen.data, picked, tasks, raster.columns, raster.projected, raster.lists, loss,
                raster.memory, raster.saved, raster.sums, losses,
            )  # fmt: skip
            raster.pool.run(
                position_gradients, cams, gaussians, guests, raster.projected, raster.lists.own_first,
                raster.lists.own_count, raster.sums, slope,
            )  # fmt: skip
            total = np.stack([np.bincount(cell, slope[:, a], count) for a in range(3)], axis=-1)
            m, v = 0.6 * m + 0.4 * total, 0.8 * v + 0.2 * (total**2).sum(axis=1)
            length = np.sqrt(v / (1 - 0.8 ** (k + 1))) + 1e-12
            shift = -step * FALL**k * m / (1 - 0.6 ** (k + 1)) / length[:, None]
            mine = shift[cell].astype(np.float32)
            place[guests] += mine
            faster = velocity[guests] + mine * np.float32(_TO_VELOCITY / seen.elapsed_s)
            velocity[guests] = np.clip(faster, -fastest, fastest)
            cloud.params[theirs, :3], cloud.velocity[theirs] = place[guests], velocity[guests]
            yield (
                float(losses[:, 1].sum()),
                TILE * TILE * len(tasks),
                int(raster.lists.needed[: len(cams)].sum()),
            )


def release_left_behind(
    settings: SplatSettings, pool: Pool, cloud: GaussianCloud, seen: SceneChange, before: NDArray[np.float32]
) -> None:
    """Guests that agree better with the pictures where they were (before: (N, 3)) stay there, as a part
    of the scene: the body went on without them."""
    guests = np.flatnonzero(cloud.guest)
    if guests.size == 0:
        return
    moving = Gaussians(cloud.params[guests], settings.harmonics, cloud.velocity[guests])
    still = Gaussians(moving.params.copy(), settings.harmonics, np.zeros_like(moving.velocity))
    still.params[:, :3] = before[guests]
    here, there = (seen.evidence(pool, gaussians).error for gaussians in (moving, still))
    stay = guests[there + np.float32(STAYS) < here]
    cloud.params[stay, :3] = before[stay]
    cloud.velocity[stay] = 0.0
    cloud.guest[stay] = 0


def reseed(
    settings: SplatSettings,
    raster: RasterBuffers,
    cloud: GaussianCloud,
    seen: SceneChange,
    rng: np.random.Generator,
) -> None:
    """Remove the Gaussians in the hull of what changed that do not agree with it, and begin new ones where
    pictures are still wrong.

    The hull: most cameras that see the place see it change, two at least. Of what lies in it, a Gaussian is
    removed where its colour disagrees with most of the pixels that changed: the background behind a moving
    body stays.
    """
    views = seen.views
    needed = min(2, seen.asked)
    if sum(mask is not None for mask in seen.moved) < needed:
        _age_guests(cloud, np.zeros(len(cloud), bool))
        return  # what one camera alone sees change may be that camera
    hull, disagrees = _visual_hull(settings, raster.pool, cloud, seen)
    _age_guests(cloud, hull)
    cloud.keep(~(hull & disagrees))
    off = _unexplained(settings, raster, cloud, seen)
    pixels = sum(int(m.sum()) for m in off if m is not None)
    count = min(int(settings.reseed * settings.gaussians), int(SEEDS_A_PIXEL * pixels))
    new = GaussianCloud.new(
        seed_gaussians(settings, raster.pool, seen.box, views, off, seen.data.weight, count, rng, seen.moved)
    )
    new.keep(_visual_hull(settings, raster.pool, new, seen)[0])
    new.guest[:] = 1
    _inherit_velocity(cloud, new, CELLS_PX[0] * seen.box.pixel_m / seen.box.radius_m)
    prune_least_sensitive(cloud, len(cloud) + len(new) - settings.gaussians)
    cloud.add(new)


def _visual_hull(
    settings: SplatSettings, pool: Pool, cloud: GaussianCloud, seen: SceneChange
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which Gaussians lie in the hull of what changed, and which of them disagree with it: bool (N,) each."""
    allowed = np.where(cloud.guest > 0, AGREE_GUEST, AGREE).astype(np.float32)
    found = seen.evidence(pool, cloud.gaussians(settings.harmonics), allowed)
    hull = (found.changed >= min(2, seen.asked)) & (2 * found.changed >= found.seen)
    return hull, 2 * found.contradicted >= found.changed


def _age_guests(cloud: GaussianCloud, hull: NDArray[np.bool_]) -> None:
    guest = cloud.guest > 0
    cloud.guest[guest & hull] = 1
    rests = guest & ~hull
    cloud.guest[rests] += 1
    cloud.velocity[rests] = 0.0
    cloud.guest[cloud.guest > LEFT] = 0


def _inherit_velocity(cloud: GaussianCloud, new: GaussianCloud, size: float) -> None:
    """New guests move as the old ones around them do."""
    guests = np.flatnonzero(cloud.guest)
    if guests.size == 0 or len(new) == 0:
        return
    cell = _grid_cells(np.concatenate([cloud.params[guests, :3], new.params[:, :3]]), size)
    count = int(cell.max()) + 1
    old = cell[: guests.size]
    number = np.maximum(np.bincount(old, minlength=count), 1)
    for a in range(3):
        mean = np.bincount(old, cloud.velocity[guests, a], count) / number
        new.velocity[:, a] = mean[cell[guests.size :]]


def _grid_cells(points: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    """The number (N,), from 0, of the cube of that size each point (N, 3) lies in."""
    index = np.floor(points / size).clip(-1000, 1000).astype(np.int64) + 1000
    cell: NDArray[np.int64] = np.unique((index[:, 0] * 2001 + index[:, 1]) * 2001 + index[:, 2],
                                        return_inverse=True)[1]  # fmt: skip
    return cell.reshape(-1)


def _unexplained(
    settings: SplatSettings, raster: RasterBuffers, cloud: GaussianCloud, seen: SceneChange
) -> list[NDArray[np.bool_] | None]:
    """Of the pixels that changed, those that the cloud does not show as they are now: where a body has left,
    what is behind it is known already."""
    slots = [k for k, t in enumerate(seen.tiles) if t is not None]
    off = list(seen.moved)  # where nearly everything changed, all of it is wrong
    if not slots:
        return off
    raster.project_and_bin(np.ascontiguousarray(seen.cams[slots]), cloud.gaussians(settings.harmonics),
                [seen.tiles[k] for k in slots], differentiate=False)  # fmt: skip
    data, tasks = seen.data, raster.tasks()
    error = np.zeros(int(data.first[-1]), np.float32)
    raster.pool.run(
        compare_tiles, data, np.array(slots, np.int64), tasks, raster.columns, raster.projected, raster.lists,
        seen.background, raster.memory, raster.saved, error,
    )  # fmt: skip
    for k in slots:
        mask = seen.moved[k]
        assert mask is not None
        off[k] = mask & (error[data.first[k] : data.first[k + 1]] > OFF).reshape(mask.shape)
    return off
