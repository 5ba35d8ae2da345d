"""Observes the state of the edge's buffer: ages and poses of the newest frames, and their embeddings if asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned.state import POSE_WIDTH, State
from edge_server.scheduler.policy import STATE_PARTS
from freshfield.frame import Frame
from freshfield.geometry import quaternion_normalize

if TYPE_CHECKING:
    from edge_server.embed.cache import EmbeddingCache

# A rig of one camera, or of several at one point, has no size to scale by.
_MIN_RIG_RADIUS_M = 1e-6


def observe(
    cameras: Sequence[str],
    newest: Mapping[str, Frame],
    now_ns: int,
    embeddings: EmbeddingCache | None = None,
    parts: Sequence[str] = STATE_PARTS,
    keep_frames: bool = False,
) -> State:
    """The state of ``cameras`` at ``now_ns``.

    newest: the newest frame of each camera that has reported. embeddings: computes z = F_e(frame) (6.31). parts: those
    to compute; otherwise poses are zero and embeddings None. keep_frames: keep the embedded frames in the state.
    """
    n = len(cameras)
    rows = [i for i, camera in enumerate(cameras) if camera in newest]
    items = [newest[cameras[i]] for i in rows]
    reported = np.zeros(n, bool)
    reported[rows] = True
    ages = np.full(n, np.nan)
    ages[rows] = [item.age_ms(now_ns) for item in items]
    poses = np.zeros((n, POSE_WIDTH))
    if "pose" in parts and rows:
        poses[rows] = relative_poses(items)
    z, frames = None, {}
    if "semantics" in parts and embeddings is not None:
        found, ok = embeddings.of(items)
        z = np.full((n, found.shape[1]), np.nan, np.float32)
        z[np.array(rows, int)[ok]] = found[ok]
        if keep_frames:
            frames = {item.camera: item for item in items}
    return State(ages, poses, z, reported, tuple(cameras), frames)


def relative_poses(items: Sequence[Frame]) -> NDArray[np.float64]:
    """(n, 6): translation from the cameras' center in units of their mean distance from it, so that the rig's
    position and size do not matter; rotation vector in radians, world axes."""
    positions = np.array([item.pose.translation_m for item in items], np.float64)
    centered = positions - positions.mean(axis=0)
    radius = float(np.linalg.norm(centered, axis=1).mean())
    q = quaternion_normalize([item.pose.quaternion for item in items])
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    # The angle over the sine of half of it; 2 in the limit of no rotation.
    per_sine = np.where(sine > 1e-12, 2.0 * np.arctan2(sine, q[:, :1]) / np.maximum(sine, 1e-12), 2.0)
    return np.concatenate([centered / max(radius, _MIN_RIG_RADIUS_M), per_sine * q[:, 1:]], axis=1)
