"""Motion: track the Gaussians of a moving body, remove those that contradict the new views, and seed new ones
where the rendering is still wrong.

A *guest* is a Gaussian that was seeded where something moved. Guests have a velocity: views of different ages
then each supervise the instant at which they were taken, and rendering can extrapolate to the present.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud, prune_least_sensitive
from edge_server.fields.splat.kernels.optimizer_step import position_gradients
from edge_server.fields.splat.kernels.project import TILE, Gaussians
from edge_server.fields.splat.kernels.rasterize import Loss, compare_tiles, train_tiles
from edge_server.fields.splat.kernels.view_evidence import Evidence, collect_evidence
from edge_server.fields.splat.seeding import seed_gaussians
from edge_server.fields.splat.settings import SplatSettings

MAX_ERROR = 0.1  # color error, in the worst channel, above which a view contradicts a Gaussian
MAX_ERROR_GUEST = 0.5  # the same for a guest: while it is tracked, it is a little off
STAYS = 0.02  # a guest stays behind where the color error there is smaller by this
MAX_PIXEL_ERROR = 0.08  # pixels of less error need no new Gaussians
MAX_CHANGED = 0.5  # share of an image: more is a change of light or a broken frame, not motion
SEEDS_A_PIXEL = 0.1

LONGEST_S = 0.45  # after a longer pause velocities are unknown: people turn
FASTEST_M_PER_S = 8.0
TRACKING_VIEWS = 6  # views a tracking step
STATIC_AFTER = 4  # updates without motion after which a guest is static
# Tracking moves bodies first, then their limbs: cells in pixels at the scene's distance, and the first step
# in meters for each second since the last update.
CELLS_PX, FALL = (32.0, 8.0), 0.85
STEPS_M_PER_S = (0.25, 0.1)
_TO_VELOCITY = 0.7  # share of a correction of position that is attributed to a wrong velocity


@dataclass
class SceneChange:
    """A set of V views, and what changed in them since the last set.

    data: the views as the kernels read them.
    moved: for each view bool (H, W), the changed pixels of positive weight, or None.
    tiles: for each view uint8 (T,), the tiles of these, or None: see ``changed_tiles``.
    cams: float32 (V, CAMERA), with the time at which each view was taken.
    background: float32 (3,).
    elapsed_s: seconds since the last set.
    asked: how many of the views have pixels of positive weight.
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

    @property
    def witnesses(self) -> int:
        """How many views must see a change at least: a single one may have changed itself."""
        return min(2, self.asked)

    @property
    def slots(self) -> list[int]:
        """The views that have changed tiles."""
        return [k for k, tiles in enumerate(self.tiles) if tiles is not None]

    def project(self, raster: RasterBuffers, cloud: GaussianCloud) -> None:
        """Project the Gaussians into the changed tiles of ``slots``, for rendering."""
        slots = self.slots
        raster.project_and_bin(
            np.ascontiguousarray(self.cams[slots]),
            cloud.gaussians(),
            [self.tiles[k] for k in slots],
            differentiate=False,
        )

    def evidence(self, pool: Pool, gaussians: Gaussians, allowed: NDArray[np.float32] | None = None) -> Evidence:
        """Evidence for each Gaussian. allowed: see ``collect_evidence``; None: no view contradicts."""
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


def weighted_changes(moved: Sequence[NDArray[np.bool_] | None], data: Views) -> list[NDArray[np.bool_] | None]:
    """``moved`` without pixels of weight 0; None for views without any changed pixel left, or with so many
    that it is no motion."""
    left: list[NDArray[np.bool_] | None] = []
    for k, mask in enumerate(moved):
        if mask is not None and data.weight.size:
            mask = mask & (data.weight[data.first[k] : data.first[k + 1]] > 0).reshape(mask.shape)
        left.append(mask if mask is not None and 0.0 < mask.mean() < MAX_CHANGED else None)
    return left


def changed_tiles(moved: Sequence[NDArray[np.bool_] | None]) -> list[NDArray[np.uint8] | None]:
    """For each view the tiles with changed pixels, uint8 (tiles,), or None where nothing changed."""
    return [None if mask is None else _tile_mask(mask) for mask in moved]


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
    """Move the guests by their velocities for ``elapsed_s``, which is negative if the newest view is older
    than the last one. After a long pause, or without ``moves`` (no camera sees motion), stop them."""
    if not moves or not abs(elapsed_s) <= LONGEST_S:
        cloud.velocity[:] = 0.0
    cloud.params[:, :3] += cloud.velocity * np.float32(elapsed_s)


def track(raster: RasterBuffers, cloud: GaussianCloud, change: SceneChange, steps: int) -> Iterator[tuple[int, int]]:
    """Move the guests, and update their velocities, until rendering agrees with the views: first whole
    bodies, then smaller parts. Gradient descent with one gradient for all Gaussians of a cell: alone, a
    Gaussian would rather change its color. Yields pixels and pairs of each step, ``steps`` at most.
    """
    guests = np.flatnonzero(cloud.guest).astype(np.int64)
    slots = change.slots
    if guests.size == 0 or len(slots) < change.witnesses or not 0 < change.elapsed_s <= LONGEST_S:
        return
    loss = Loss(False, np.float32(0.0), change.background, False, np.uint64(0))
    # Only Gaussians that are in changed tiles are rendered.
    change.project(raster, cloud)
    shows = np.asarray((raster.lists.own_count[: len(slots), : len(cloud)] > 0).any(axis=0))
    shows[guests] = True
    shown, in_cloud = np.flatnonzero(shows), guests
    guests = np.searchsorted(shown, in_cloud).astype(np.int64)
    gaussians = cloud.gaussians(shown)
    place, velocity = gaussians.params[:, :3], gaussians.velocity
    slope = np.zeros((guests.size, 3), np.float32)
    pixel = change.box.pixel_m / change.box.radius_m
    fastest = FASTEST_M_PER_S / change.box.radius_m
    for level, (cell_px, step_m_per_s) in enumerate(zip(CELLS_PX, STEPS_M_PER_S)):
        step = step_m_per_s * change.elapsed_s / change.box.radius_m
        cell = _grid_cells(place[guests], cell_px * pixel)
        count = int(cell.max()) + 1
        m, v = np.zeros((count, 3)), np.zeros(count)
        for k in range((steps + 1 - level) // 2):
            start = (steps - k) * TRACKING_VIEWS + level  # other views at each step
            some_slots = [slots[(start + j) % len(slots)] for j in range(min(TRACKING_VIEWS, len(slots)))]
            picked, cams = np.array(some_slots, np.int64), np.ascontiguousarray(change.cams[some_slots])
            raster.project_and_bin(cams, gaussians, [change.tiles[k] for k in some_slots])
            tasks = raster.tasks()
            losses = np.zeros((len(tasks), 3))
            raster.pool.run(
                train_tiles,
                change.data,
                picked,
                tasks,
                raster.columns,
                raster.projected,
                raster.lists,
                loss,
                raster.memory,
                raster.saved,
                raster.sums,
                losses,
            )
            raster.pool.run(
                position_gradients,
                cams,
                gaussians,
                guests,
                raster.projected,
                raster.lists.own_first,
                raster.lists.own_count,
                raster.sums,
                slope,
            )
            total = np.stack([np.bincount(cell, slope[:, a], count) for a in range(3)], axis=-1)
            m, v = 0.6 * m + 0.4 * total, 0.8 * v + 0.2 * (total**2).sum(axis=1)
            length = np.sqrt(v / (1 - 0.8 ** (k + 1))) + 1e-12
            shift = -step * FALL**k * m / (1 - 0.6 ** (k + 1)) / length[:, None]
            mine = shift[cell].astype(np.float32)
            place[guests] += mine
            faster = velocity[guests] + mine * np.float32(_TO_VELOCITY / change.elapsed_s)
            velocity[guests] = np.clip(faster, -fastest, fastest)
            cloud.params[in_cloud, :3], cloud.velocity[in_cloud] = place[guests], velocity[guests]
            yield TILE * TILE * len(tasks), int(raster.lists.needed[: len(cams)].sum())


def release_left_behind(pool: Pool, cloud: GaussianCloud, change: SceneChange, before: NDArray[np.float32]) -> None:
    """Make guests static at their positions ``before``, (N, 3), where the views agree better with that: the
    body moved on without them."""
    guests = np.flatnonzero(cloud.guest)
    if guests.size == 0:
        return
    moving = cloud.gaussians(guests)
    still = moving._replace(params=moving.params.copy(), velocity=np.zeros_like(moving.velocity))
    still.params[:, :3] = before[guests]
    here, there = (change.evidence(pool, gaussians).error for gaussians in (moving, still))
    stay = guests[there + np.float32(STAYS) < here]
    cloud.params[stay, :3] = before[stay]
    cloud.velocity[stay] = 0.0
    cloud.guest[stay] = 0


def reseed(
    settings: SplatSettings, raster: RasterBuffers, cloud: GaussianCloud, change: SceneChange, rng: np.random.Generator
) -> None:
    """Remove contradicted Gaussians from the visual hull of what changed, and seed new ones where the
    rendering is still wrong.

    The hull is where most cameras that see the place see it change, two at least. A Gaussian in it is
    contradicted if its color differs from most of the changed pixels: the background behind a moving body
    stays.
    """
    if sum(mask is not None for mask in change.moved) < change.witnesses:
        _age_guests(cloud, np.zeros(len(cloud), bool))
        return
    hull, contradicted = _visual_hull(raster.pool, cloud, change)
    _age_guests(cloud, hull)
    cloud.keep(~(hull & contradicted))
    wrong = _wrong_pixels(raster, cloud, change)
    pixels = sum(int(m.sum()) for m in wrong if m is not None)
    count = min(int(settings.reseed * settings.gaussians), int(SEEDS_A_PIXEL * pixels))
    seeds = seed_gaussians(
        settings, raster.pool, change.box, change.views, wrong, change.data.weight, count, rng, change.moved
    )
    new = GaussianCloud.new(seeds)
    new.keep(_visual_hull(raster.pool, new, change)[0])
    new.guest[:] = 1
    _inherit_velocity(cloud, new, CELLS_PX[0] * change.box.pixel_m / change.box.radius_m)
    prune_least_sensitive(cloud, len(cloud) + len(new) - settings.gaussians)
    cloud.add(new)


def _visual_hull(pool: Pool, cloud: GaussianCloud, change: SceneChange) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which Gaussians lie in the hull of what changed, and which are contradicted there: bool (N,) each."""
    allowed = np.where(cloud.guest > 0, MAX_ERROR_GUEST, MAX_ERROR).astype(np.float32)
    found = change.evidence(pool, cloud.gaussians(), allowed)
    hull = (found.changed >= change.witnesses) & (2 * found.changed >= found.seen)
    return hull, 2 * found.contradicted >= found.changed


def _age_guests(cloud: GaussianCloud, hull: NDArray[np.bool_]) -> None:
    """Stop the guests outside the hull, and make them static after a while."""
    guest = cloud.guest > 0
    cloud.guest[guest & hull] = 1
    rests = guest & ~hull
    cloud.guest[rests] += 1
    cloud.velocity[rests] = 0.0
    cloud.guest[cloud.guest > STATIC_AFTER] = 0


def _inherit_velocity(cloud: GaussianCloud, new: GaussianCloud, size: float) -> None:
    """Give new guests the mean velocity of the old ones in their cell."""
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
    """The index (N,) of the cube of side ``size`` that each point (N, 3) lies in, counted from 0."""
    index = np.floor(points / size).clip(-1000, 1000).astype(np.int64) + 1000
    cell: NDArray[np.int64] = np.unique((index[:, 0] * 2001 + index[:, 1]) * 2001 + index[:, 2], return_inverse=True)[1]
    return cell.reshape(-1)


def _wrong_pixels(raster: RasterBuffers, cloud: GaussianCloud, change: SceneChange) -> list[NDArray[np.bool_] | None]:
    """The changed pixels that are not rendered as they are now. Where a body has left, the background behind
    it may be known already."""
    slots = change.slots
    wrong = list(change.moved)  # all of them in views without tiles
    if not slots:
        return wrong
    change.project(raster, cloud)
    data, tasks = change.data, raster.tasks()
    error = np.zeros(int(data.first[-1]), np.float32)
    raster.pool.run(
        compare_tiles,
        data,
        np.array(slots, np.int64),
        tasks,
        raster.columns,
        raster.projected,
        raster.lists,
        change.background,
        raster.memory,
        raster.saved,
        error,
    )
    for k in slots:
        mask = change.moved[k]
        assert mask is not None
        wrong[k] = mask & (error[data.first[k] : data.first[k + 1]] > MAX_PIXEL_ERROR).reshape(mask.shape)
    return wrong
