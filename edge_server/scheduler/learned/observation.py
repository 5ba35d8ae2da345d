"""The state of what the edge has: ages and poses of the newest frames, embeddings where somebody asks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.live.buffer import BufferedFrame
from edge_server.scheduler.learned.state import PARTS, POSE_WIDTH, State
from freshfield.geometry import quaternion_normalize

# A rig of one camera, or of several at one point, has no size to scale by.
_SMALLEST_RIG_M = 1e-6


class Embeddings(Protocol):
    """What computes z = F_e(frame) (6.31) and remembers it per frame (edge_server.embed)."""

    def of(self, items: Sequence[BufferedFrame]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Embeddings (n, d), and (n,) which of the frames have one."""
        ...


def observe(
    cameras: Sequence[str],
    newest: Mapping[str, BufferedFrame],
    now_ns: int,
    embeddings: Embeddings | None = None,
    parts: Sequence[str] = PARTS,
    keep_frames: bool = False,
) -> State:
    """The state at ``now_ns`` of ``cameras``, of which ``newest`` holds those that have reported. Only the
    ``parts`` asked for are computed; poses that are not are zero, embeddings None. keep_frames: with the
    frames that were embedded."""
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
            frames = {item.frame.camera: item.frame for item in items}
    return State(ages, poses, z, reported, tuple(cameras), frames)


def relative_poses(items: Sequence[BufferedFrame]) -> NDArray[np.float64]:
    """(n, 6): translation from the cameras' centre in units of their mean distance from it, so that neither
    where a rig stands nor how large it is matters; rotation vector in radians, world axes."""
    positions = np.array([item.frame.pose.translation_m for item in items], np.float64)
    centred = positions - positions.mean(axis=0)
    size = float(np.linalg.norm(centred, axis=1).mean())
    q = quaternion_normalize([item.frame.pose.quaternion for item in items])
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    # Twice the half angle over its sine; 2 where there is no turn to speak of.
    per_sine = np.where(sine > 1e-12, 2.0 * np.arctan2(sine, q[:, :1]) / np.maximum(sine, 1e-12), 2.0)
    return np.concatenate([centred / max(size, _SMALLEST_RIG_M), per_sine * q[:, 1:]], axis=1)
