"""Selects the views of a hand-held camera that become keyframes, those that are kept, and the view of each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned


def due(steps: int, cameras: int, taken: int) -> int:
    """Number of keyframes that are due: the first of each of ``cameras``, then one per STEPS_A_KEYFRAME steps, minus
    those already ``taken``."""
    return steps // tuned.STEPS_A_KEYFRAME + cameras - taken


def next_keyframes(views: Sequence[View], seen: Mapping[str, View], most: int) -> list[View]:
    """The views that become keyframes: each camera's newest, among those with depth if any, as only these seed. All
    for cameras without a keyframe, and at most ``most`` of the others, longest without one first.

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
    """Largest number of keyframes with ``pixels`` each."""
    return min(max(tuned.KEPT_PIXELS // pixels, tuned.LEAST_KEPT), tuned.MOST_KEPT)


def least_needed(poses: Sequence[NDArray[np.float64]], distance_m: float) -> int:
    """Index of the older of the two keyframes nearest to each other, excluding the newest ones.

    poses: (4, 4) of each keyframe, oldest first. distance_m: of the scene; a shift by it counts as a turn of one
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

    cameras: their number. steps_since: steps since the newest keyframe.
    """
    if steps_since < tuned.FRESH_STEPS:
        return count - 1
    newest = min(tuned.NEWEST * cameras, count)
    if rng.random() < tuned.NEWEST_SHARE:
        return count - 1 - int(rng.integers(newest))
    return int(rng.integers(count))
