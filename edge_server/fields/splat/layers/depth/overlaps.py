"""What cameras with depth see of one another's surfaces: whether they contradict each other, how exposures differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import converging_point
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.surfaces import Surface
from edge_server.fields.splat.layers.layer_constants import BRIGHT, DARK
from freshfield.geometry import seen_from


class Overlap(NamedTuple):
    """Points of one camera's surface, N of them, in the image of another camera.

    of, seen_by: numbers of the two cameras.
    depth, measured: (N,), meters along the second camera's axis: of the point, and as it measures there; 0 unknown.
    colors: (2, N, 3), the plates of both, steps of 255. pixels: (2, N), columns and rows in the second camera's image.
    """

    of: int
    seen_by: int
    depth: NDArray[np.float64]
    measured: NDArray[np.float64]
    colors: NDArray[np.float32]
    pixels: NDArray[np.int64]


def overlaps(surfaces: Sequence[Surface]) -> list[Overlap]:
    """Of all pairs of cameras that have such points. Those without depth give none, but see others'."""
    found, depths = [], [s.depth() for s in surfaces]
    for i, ours in enumerate(surfaces):
        stride = max(1, round(np.sqrt(depths[i].size / tuned.OVERLAP_POINTS)))
        step = np.s_[stride // 2 :: stride, stride // 2 :: stride]
        there = depths[i][step] > 0
        points, color = ours.points()[step][there], ours.color[step][there]
        for j, theirs in enumerate(surfaces):
            if i == j or not len(points):
                continue
            with np.errstate(invalid="ignore", over="ignore"):
                local, at, inside = seen_from(theirs.lens, theirs.pose, points)
            inside &= local[:, 2] > tuned.NEAREST_M
            x, y = at[inside].astype(int).T
            use = theirs.known[y, x]
            x, y = x[use], y[use]
            if len(x):
                colors = np.stack([color[inside][use], theirs.color[y, x]])
                measured, pixels = depths[j][y, x].astype(float), np.stack([x, y])
                found.append(Overlap(i, j, local[inside][use][:, 2], measured, colors, pixels))
    return found


def contradicting(surfaces: Sequence[Surface]) -> list[int]:
    """The numbers of the cameras whose depth cannot be true, if the others' is.

    Half of the depths of such a camera are far off where the cameras look (another unit). Or of the points that it
    shares with another one, most lie before what the other one measures, or nearly all behind it. The worst camera is
    taken out until the others agree; where several are equally bad, all of them: of two nobody knows which one is
    wrong.
    """
    count = len(surfaces)
    # By pair: points that both measure, those that agree, and those that count against it.
    shared, agree, against = np.zeros((3, count, count))
    for pair in overlaps(surfaces):
        ratio = pair.depth[pair.measured > 0] / pair.measured[pair.measured > 0]
        at = pair.of, pair.seen_by
        shared[at], agree[at] = ratio.size, np.count_nonzero(np.abs(ratio - 1.0) <= tuned.CONTRADICTS)
        hidden = np.count_nonzero(ratio > 1.0 + tuned.CONTRADICTS)
        against[at] = ratio.size - agree[at] - (1.0 - tuned.HIDDEN_WEIGHT) * hidden
    shared, agree, against, wrong = shared + shared.T, agree + agree.T, against + against.T, list[int]()
    worst = _of_another_unit(surfaces)
    while True:
        wrong += worst
        for array in (shared, agree, against):
            array[worst], array[:, worst] = 0.0, 0.0
        enough = shared.sum(axis=1) >= tuned.OVERLAP_LEAST
        share = np.where(enough, agree.sum(axis=1) / np.maximum((agree + against).sum(axis=1), 1e-9), 1.0)
        if share.min(initial=1.0) >= tuned.LEAST_AGREE:
            return sorted(wrong)
        worst = np.flatnonzero(share <= share.min() + 1e-9).tolist()


def _of_another_unit(surfaces: Sequence[Surface]) -> list[int]:
    """The numbers of the cameras half of whose depths are far before or beyond where the cameras look."""
    poses = np.stack([s.pose for s in surfaces])
    origins, axes = poses[:, :3, 3], poses[:, :3, 2]
    point = converging_point(origins, axes)
    if point is None or (axes @ axes.T).min() > np.cos(np.deg2rad(tuned.LEAST_ANGLE_DEG)):
        return []
    distance = np.linalg.norm(origins - point, axis=1)
    depths = [s.inverse[s.inverse > 0] for s in surfaces]
    shares = [np.median(1.0 / depth) / far if depth.size else 1.0 for depth, far in zip(depths, distance)]
    return [k for k, share in enumerate(shares) if not tuned.RANGE[0] < share < tuned.RANGE[1]]


def exposures(surfaces: Sequence[Surface]) -> NDArray[np.float64]:
    """Log of each camera's exposure over the mean of all, (N, 3), one a channel, from points that two cameras see.

    0 for cameras that share none with others.
    """
    count = len(surfaces)
    rows, logs = [], []
    for pair in overlaps(surfaces):
        visible = (pair.measured <= 0) | (np.abs(pair.depth / np.maximum(pair.measured, 1e-9) - 1.0) < tuned.AGREE)
        usable = visible & (pair.colors.min(axis=(0, 2)) > DARK) & (pair.colors.max(axis=(0, 2)) < BRIGHT)
        if np.count_nonzero(usable) >= tuned.OVERLAP_LEAST:
            row = np.zeros(count)
            row[pair.of], row[pair.seen_by] = 1.0, -1.0
            rows.append(row)
            logs.append(np.median(np.log(pair.colors[0, usable] / pair.colors[1, usable]), axis=0))
    if not rows:
        return np.zeros((count, 3))
    found = np.linalg.lstsq(np.stack(rows), np.stack(logs), rcond=None)[0]  # of least norm: the mean stays
    return np.asarray(found, np.float64)
