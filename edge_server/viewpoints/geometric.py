"""Selectors that look at geometry only: random and coverage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.viewpoints.candidates import Candidates
from edge_server.viewpoints.registry import CaptureState
from edge_server.viewpoints.viewpoint_constants import ALIKE_RAD, MOST_WANTED, SAMPLES_A_SIDE, UNKNOWN_SIZE
from freshfield.geometry import seen_from

Array = NDArray[np.float64]


class RandomOrder:
    """Every open candidate is equally likely."""

    name = "random"

    def values(self, state: CaptureState) -> Array:
        return state.rng.random(len(state.candidates))


class Coverage:
    """How much of the object's box a view would newly cover. The coverage of a point of a face, for each
    direction from which some candidate sees it, is the likeness of the nearest direction from which a view
    saw the point; it is weighted by how squarely and closely that candidate sees it. Views therefore go into
    the middle of what is open (facility location), not to its edges."""

    name = "coverage"

    def values(self, state: CaptureState) -> Array:
        weight, toward = _sight(state.candidates)
        sees = weight > 0.0
        total = np.zeros(len(weight))
        usable = np.flatnonzero(state.candidates.reachable)
        for wanted in usable[:: max(len(usable) // MOST_WANTED, 1)]:
            cosine = np.einsum("npd,pd->np", toward, toward[wanted])
            alike = np.where(sees, np.exp(-2.0 * (1.0 - cosine) / ALIKE_RAD**2), 0.0)
            known = alike[state.order].max(axis=0, initial=0.0)
            total += np.maximum(alike - known, 0.0) @ weight[wanted]
        return total


def _sight(candidates: Candidates) -> tuple[Array, Array]:
    """(N, P) how well each candidate sees each point of the box: the cosine of the angle to its face, by the
    square of how much nearer than usual the camera is; 0 from behind and outside the image. And the
    directions (N, P, 3) from the points to the cameras."""
    points, normals = _box(candidates)
    ray = candidates.poses[:, None, :3, 3] - points
    far = np.maximum(np.linalg.norm(ray, axis=-1), 1e-9)
    toward = ray / far[..., None]
    inside = np.empty(far.shape, bool)
    for row, pose in zip(inside, candidates.poses):
        row[:] = seen_from(candidates.lens, pose, points)[2]
    squarely = np.maximum((toward * normals).sum(axis=-1), 0.0)
    return np.where(inside, squarely * (np.median(far) / far) ** 2, 0.0), toward


def _box(candidates: Candidates) -> tuple[Array, Array]:
    """Points (P, 3) on all faces of the object's box but the lower one, and their outward normals (P, 3)."""
    if candidates.bounds is not None:
        low, high = candidates.bounds
    else:
        nearest = np.linalg.norm(candidates.poses[:, :3, 3] - candidates.target, axis=1).min()
        low, high = candidates.target - UNKNOWN_SIZE * nearest, candidates.target + UNKNOWN_SIZE * nearest
    middles = (np.arange(SAMPLES_A_SIDE) + 0.5) / SAMPLES_A_SIDE
    u, v = (w.ravel() for w in np.meshgrid(middles, middles))
    points, normals = [], []
    for axis in range(3):
        for side in (0.0, 1.0) if axis < 2 else (1.0,):
            share = np.stack([u, v], axis=-1)
            share = np.insert(share, axis, side, axis=1)
            points.append(low + share * (high - low))
            normals.append(np.broadcast_to((2.0 * side - 1.0) * np.eye(3)[axis], share.shape))
    return np.concatenate(points), np.concatenate(normals)
