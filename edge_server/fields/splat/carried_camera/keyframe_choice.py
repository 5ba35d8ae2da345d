"""Which views of a carried camera become keyframes, which ones stay, and which one a step learns from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned


def due(steps: int, cameras: int, taken: int) -> int:
    """How many more keyframes may be taken: the first of each of ``cameras``, then one in so many steps, less those
    that were ``taken``."""
    return steps // tuned.STEPS_A_KEYFRAME + cameras - taken


def next_keyframes(views: Sequence[View], seen: Mapping[str, View], most: int) -> list[View]:
    """The views that become keyframes: of each camera the newest, of those with depth if there are any, as only they
    seed. All of cameras that have none yet, and of the others at most ``most``, longest without one first.

    seen: the last view of each camera that became a keyframe.
    """
    best = {}
    for view in sorted(views, key=lambda view: (view.depth is not None, view.generated_ns)):
        best[view.camera] = view
    first = [view for view in best.values() if view.camera not in seen]
    waiting = [view for view in best.values() if view.camera in seen]
    waiting.sort(key=lambda view: seen[view.camera].generated_ns)
    return [*first, *waiting[: max(most, 0)]]


def most_kept(pixels: int) -> int:
    """The most keyframes of ``pixels`` each."""
    return min(max(tuned.KEPT_PIXELS // pixels, tuned.LEAST_KEPT), tuned.MOST_KEPT)


def least_needed(poses: Sequence[NDArray[np.float64]], distance_m: float) -> int:
    """The older of the two keyframes that were taken nearest to each other, the newest ones apart.

    poses: (4, 4) of each keyframe, oldest first. distance_m: of the scene; so much of a shift counts as a turn of one
    radian.
    """
    place, old = np.stack(poses), len(poses[: -tuned.NEWEST])
    apart = np.linalg.norm(place[:, None, :3, 3] - place[None, :, :3, 3], axis=2) / distance_m
    apart += np.linalg.norm(place[:, None, :3, 2] - place[None, :, :3, 2], axis=2)
    apart[np.arange(len(apart)), np.arange(len(apart))] = np.inf
    apart = np.triu(apart)[:old] + np.where(np.tri(len(apart), k=0)[:old] > 0, np.inf, 0.0)
    return int(np.argmin(apart.min(axis=1)))


def next_view(rng: np.random.Generator, count: int, cameras: int, steps_since: int) -> int:
    """The newest of ``count`` keyframes while it is fresh, else one of the newest, or any of them.

    cameras: how many there are. steps_since: the newest keyframe.
    """
    if steps_since < tuned.FRESH_STEPS:
        return count - 1
    newest = min(tuned.NEWEST * cameras, count)
    if rng.random() < tuned.NEWEST_SHARE:
        return count - 1 - int(rng.integers(newest))
    return int(rng.integers(count))
