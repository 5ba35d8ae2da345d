"""An immutable picture of both layers, at any instant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.motion import Motion
from edge_server.fields.splat.layers.moving_set import MovingSet
from edge_server.fields.splat.snapshot import SplatSnapshot
from freshfield.geometry import Pinhole

if TYPE_CHECKING:
    from edge_server.fields.splat.layers.depth.surfaces import SurfaceScene


@dataclass(frozen=True)
class MovingSnapshot:
    """The moving set, never written after construction.

    params: float32 (N, P), where displacements are 0. anchor, share: (N, 3), see ``Motion.attach``.
    motion: a separate copy.
    origin_ns: zero of the motion's seconds. newest_s: instant of the newest frame.
    """

    params: NDArray[np.float32]
    anchor: NDArray[np.int64]
    share: NDArray[np.float32]
    motion: Motion
    origin_ns: int
    newest_s: float

    @classmethod
    def of(cls, moving: MovingSet, origin_ns: int, newest_s: float) -> MovingSnapshot:
        """A copy of the current moving set."""
        arrays = moving.cloud.params.copy(), moving.anchor.copy(), moving.share.copy()
        return cls(*arrays, moving.motion.copy(), origin_ns, newest_s)

    def ahead_s(self, present_ns: int | None) -> float:
        """Time after the newest frame to show, at most as far as motion can be extrapolated."""
        if present_ns is None:
            return 0.0
        return min((present_ns - self.origin_ns) / 1e9 - self.newest_s, tuned.MAX_AHEAD_S)

    def params_at(self, ahead_s: float) -> NDArray[np.float32]:
        """Parameters, float32 (N, P), ``ahead_s`` after the newest frame."""
        params = self.params.copy()
        params[:, :3] = self.motion.displaced(self.params[:, :3], self.anchor, self.share, self.newest_s + ahead_s)
        return params


@dataclass(frozen=True)
class LayeredSnapshot(SplatSnapshot):
    """The static field and the moving set at one instant; ``at`` shows another.

    static: float32 (N, P), the Gaussians of the static field. moving: None where nothing moves.
    surfaces: static surfaces from the cameras' depth; None without depth.
    """

    static: NDArray[np.float32] | None = None
    moving: MovingSnapshot | None = None
    surfaces: SurfaceScene | None = None

    def unseen(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> NDArray[np.bool_] | None:
        """The pixels of a rendering whose background no camera has measured, bool (H, W), where the rendering is a
        guess; None without depth. Distortion is ignored. Takes some milliseconds."""
        return None if self.surfaces is None else self.surfaces.unseen(camera_to_world, intrinsics, self.pool)

    def at(self, present_ns: int | None) -> LayeredSnapshot:
        """The snapshot of another instant; None: that of the newest frame."""
        if self.moving is None or self.static is None:
            return self
        ahead_s = self.moving.ahead_s(present_ns)
        params = np.concatenate([self.static, self.moving.params_at(ahead_s)])
        return replace(self, params=params)
