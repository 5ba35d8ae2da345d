"""Depth plates as surfaces: any view of what stands still, drawn from the cameras' plates without training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.camera import LENS, ORIGIN
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.kernels.surfaces import Meshes, draw_meshes, shade_surfaces
from freshfield.geometry import Pinhole

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """What stands still before one camera.

    lens, pose: of the camera; pose: camera-to-world (4, 4), meters.
    color: float32 (H, W, 3), steps of 255. known: bool (H, W), where it is the plate's.
    inverse: float32 (H, W), 1 / depth along the axis, 1 / m, 0 unknown. slope: float32 (H, W, 2), see ``smooth``.
    """

    lens: Pinhole
    pose: Array
    color: NDArray[np.float32]
    known: NDArray[np.bool_]
    inverse: NDArray[np.float32]
    slope: NDArray[np.float32]

    def depth(self) -> NDArray[np.float32]:
        """Depth along the axis, float32 (H, W), meters; 0 where plate or depth are unknown."""
        return np.where(self.known & (self.inverse > 0), 1.0 / np.maximum(self.inverse, 1e-9), 0.0).astype(np.float32)

    def rays(self) -> Array:
        """Of each pixel's center, in camera axes, scaled to a depth of 1: (H, W, 3)."""
        rays = self.lens.rays()
        return rays / np.maximum(rays[..., 2:], 1e-6)

    def points(self) -> Array:
        """Where the pixels' centers lie, world meters (H, W, 3); the camera's place where depth is unknown."""
        return (self.rays() * self.depth()[..., None]) @ self.pose[:3, :3].T + self.pose[:3, 3]

    def normals(self) -> Array:
        """Unit normals, towards the camera, world axes (H, W, 3).

        A surface of inverse depth q = q0 + g . (u, v) is the plane n . p = 1 with n . ray = q: its gradient in pixels
        is n's along the axes of the image, scaled by the focal lengths. Distortion is ignored here.
        """
        x, y = self.slope[..., 0] * self.lens.fx, self.slope[..., 1] * self.lens.fy
        rays = self.rays()
        normal = np.stack([x, y, self.inverse - x * rays[..., 0] - y * rays[..., 1]], axis=-1)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        return -normal @ self.pose[:3, :3].T

    def joined(self) -> NDArray[np.bool_]:
        """See ``Meshes``, (H, W)."""
        q = np.where(self.depth() > 0, self.inverse, np.nan)
        out, worst = np.zeros(q.shape, bool), np.zeros((q.shape[0] - 1, q.shape[1] - 1))
        for down, right in ((0, 1), (1, 0), (1, 1)):
            there = np.s_[down : q.shape[0] - 1 + down, right : q.shape[1] - 1 + right]
            step = np.array([right, down], np.float32)
            jump = q[there] - q[:-1, :-1]
            off = np.minimum(np.abs(jump - self.slope[:-1, :-1] @ step), np.abs(jump - self.slope[there] @ step))
            worst = np.maximum(worst, off)  # NaN stays
        out[:-1, :-1] = worst < tuned.CUT
        return out


def _trust(depth: NDArray[np.float32], joined: NDArray[np.bool_]) -> NDArray[np.float32]:
    """See ``Meshes``, (H, W)."""
    around = np.pad(joined[:-1, :-1], 1, mode="edge")  # of the four squares at a pixel
    inside = around[:-1, :-1] & around[1:, :-1] & around[:-1, 1:] & around[1:, 1:]
    return np.where(depth > 0, np.where(inside, 1.0, tuned.MIXED), 0.0).astype(np.float32)


@dataclass(frozen=True)
class SurfaceScene:
    """The surfaces of all cameras, ready to be drawn; never written after construction.

    center: (3,), world meters, from which ``meshes`` are measured.
    """

    center: Array
    meshes: Meshes

    @classmethod
    def of(cls, surfaces: Sequence[Surface]) -> SurfaceScene:
        """surfaces: of at least one camera."""
        center = np.mean([s.pose[:3, 3] for s in surfaces], axis=0)
        sizes = np.array([(s.lens.width, s.lens.height) for s in surfaces], np.int64)
        depths, joined = [s.depth() for s in surfaces], [s.joined() for s in surfaces]
        trust = [_trust(depth, j) for depth, j in zip(depths, joined)]

        def one_list(arrays: Sequence[NDArray], dtype: type, *shape: int) -> NDArray:
            return np.concatenate([np.asarray(a, dtype).reshape(-1, *shape) for a in arrays])

        meshes = Meshes(
            first=np.concatenate([[0], np.cumsum(sizes.prod(axis=1))]).astype(np.int64),
            size=sizes,
            cams=_rows([s.pose for s in surfaces], [s.lens for s in surfaces], center),
            points=one_list([s.points() - center for s in surfaces], np.float32, 3),
            depth=one_list(depths, np.float32),
            normal=one_list([s.normals() for s in surfaces], np.float32, 3),
            color=one_list([s.color / np.float32(255.0) for s in surfaces], np.float32, 3),
            joined=one_list(joined, np.bool_),
            trust=one_list(trust, np.float32),
        )
        return cls(center, meshes)

    def unseen(self, pose: Array, lens: Pinhole, pool: Pool) -> NDArray[np.bool_]:
        """The pixels that no camera says anything about, bool (H, W), from a pose, camera-to-world (4, 4)."""
        (agreement,) = self.render([pose], replace(lens, distortion=(0.0, 0.0, 0.0, 0.0)), pool)[1]
        return np.asarray(agreement <= tuned.SURE)

    def unseen_points(self, points_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which points (N, 3), world meters, lie before no camera's measured surface nor on it, bool (N,). Distortion
        is ignored."""
        unseen = np.ones(len(points_m), np.bool_)
        local = (np.asarray(points_m, np.float64) - self.center).astype(np.float32)
        for row, (width, height), first in zip(self.meshes.cams, self.meshes.size, self.meshes.first):
            x, y, z = row[:ORIGIN].reshape(3, 3) @ (local - row[ORIGIN:LENS]).T
            fx, fy, cx, cy = row[LENS : LENS + 4]
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = np.floor(fx * x / z + cx), np.floor(fy * y / z + cy)
            inside = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
            pixel = first + v[inside].astype(np.int64) * width + u[inside].astype(np.int64)
            depth = self.meshes.depth[pixel]
            unseen[inside[(depth > 0) & (z[inside] <= depth * np.float32(1.0 + tuned.BEHIND))]] = False
        return unseen

    def render(
        self, poses: Sequence[Array], lens: Pinhole, pool: Pool
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Draw the surfaces from each pose, camera-to-world (4, 4). lens: without distortion.

        Returns color, float32 (B, H, W, 3) in [0, 1]; agreement, float32 (B, H, W) in [0, 1]: how far the cameras say
        what is there, 0 where none does; and inverse depth of the nearest surface that one puts there, float32
        (B, H, W), 1 / m, 0 where none does.
        """
        targets = _rows(poses, [lens] * len(poses), self.center)
        shape = len(poses), lens.height, lens.width
        inverse = np.empty((shape[0], len(self.meshes.size), *shape[1:]), np.float32)
        color, agreement = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        pool.run(draw_meshes, self.meshes, targets, inverse)
        pool.run(shade_surfaces, self.meshes, targets, inverse, color, agreement)
        return color, agreement, inverse.max(axis=1)


def _rows(poses: Sequence[Array], lenses: Sequence[Pinhole], center: Array) -> NDArray[np.float32]:
    x, y, z = map(float, center)
    return camera_rows(poses, lenses, replace(UNIT_BOX, center_m=(x, y, z)))
