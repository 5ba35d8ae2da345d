"""Rigid motions, pinhole cameras and the conventions of axes.

Conventions of the whole project (loaders convert to them when they read):

* poses are **camera-to-world** (``T_W^C``), in meters;
* camera axes are **OpenCV's**: x right, y down, z forward;
* quaternions are **w first**, unit length;
* pixel coordinates have their origin at the **corner** of the top-left pixel, so the center of that
  pixel is (0.5, 0.5) and a centered principal point is (width / 2, height / 2). OpenCV calibrations,
  whose pixel centers are integers, gain 0.5 when they are read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from freshfield.limits import MAX_LENS_ERROR_PX, MAX_QUATERNION_ERROR

Array = NDArray[np.float64]

# Right-multiplying a camera-to-world matrix with this turns OpenGL axes (x right, y up, z backward)
# into OpenCV axes and back: it is its own inverse.
OPENGL_TO_OPENCV: Array = np.diag([1.0, -1.0, -1.0, 1.0])
_LAST_ROW: Array = np.array([0.0, 0.0, 0.0, 1.0])

# Below this angle the closed forms divide by nearly nothing; their Taylor series is exact to fp64.
_SMALL_ANGLE = 1e-4


class GeometryError(ValueError):
    """A pose or camera that no real camera can have; the message says which part and why."""


# --- quaternions ------------------------------------------------------------------------------


def quaternion_normalize(q: ArrayLike) -> Array:
    """Unit quaternions (..., 4) with w >= 0. Raises GeometryError for a zero or non-finite one."""
    given = np.asarray(q, dtype=np.float64)
    scale = np.max(np.abs(given), axis=-1, keepdims=True)
    if not np.all(np.isfinite(given)) or np.any(scale == 0.0):
        raise GeometryError("quaternion has no direction: zero or non-finite")
    scaled = given / scale  # first, so that squaring can neither overflow nor underflow
    unit = scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.where(unit[..., :1] < 0.0, -unit, unit)


def quaternion_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Hamilton product of (..., 4) quaternions: rotation b first, then a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, dtype=np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, dtype=np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quaternion_to_matrix(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4); normalizes first."""
    w, x, y, z = np.moveaxis(quaternion_normalize(q), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def matrix_to_quaternion(rotation: ArrayLike) -> Array:
    """Unit quaternion (4,) of one rotation matrix (3, 3), stable at every angle (Shepperd's method)."""
    m = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(m)
    # The largest of the four squared components is the one that can be divided by.
    choice = int(np.argmax([trace, m[0, 0], m[1, 1], m[2, 2]]))
    if choice == 0:
        q = [1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
    else:
        i = choice - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = [0.0] * 4
        q[0] = m[k, j] - m[j, k]
        q[1 + i] = 1 + m[i, i] - m[j, j] - m[k, k]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + k] = m[k, i] + m[i, k]
    return quaternion_normalize(q)


def slerp(a: ArrayLike, b: ArrayLike, fraction: float) -> Array:
    """Quaternion (4,) at ``fraction`` of the shorter way from a to b; exact at 0 and 1."""
    a, b = quaternion_normalize(a), quaternion_normalize(b)
    dot = float(np.dot(a, b))
    if dot < 0.0:
        b, dot = -b, -dot
    angle = np.arccos(np.clip(dot, -1.0, 1.0))
    if angle < _SMALL_ANGLE:
        return quaternion_normalize((1 - fraction) * a + fraction * b)
    q = np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b
    return quaternion_normalize(q)


# --- SO(3) and SE(3) --------------------------------------------------------------------------


def so3_exp(omega: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues' formula)."""
    w = np.asarray(omega, dtype=np.float64)
    angle = float(np.linalg.norm(w))
    k = cross_matrix(w)
    if angle < _SMALL_ANGLE:
        a, b = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    return np.eye(3) + a * k + b * (k @ k)


def so3_log(rotation: ArrayLike) -> Array:
    """Rotation vector (3,) in radians, norm <= pi. Stable near 0 and near pi (through the quaternion)."""
    q = matrix_to_quaternion(rotation)
    s = float(np.linalg.norm(q[1:]))
    if s < 1e-12:
        return 2.0 * q[1:]
    return (2.0 * np.arctan2(s, q[0]) / s) * q[1:]


def se3(rotation: ArrayLike, translation_m: ArrayLike) -> Array:
    """Rigid transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    r, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation_m, dtype=np.float64)
    out = np.zeros((*np.broadcast_shapes(r.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = r, t, 1.0
    return out


def se3_inverse(transform: ArrayLike) -> Array:
    """Inverses of rigid transforms (..., 4, 4)."""
    t = np.asarray(transform, dtype=np.float64)
    rotation = np.swapaxes(t[..., :3, :3], -1, -2)
    return se3(rotation, -(rotation @ t[..., :3, 3:])[..., 0])


def cross_matrix(w: Array) -> Array:
    """The skew-symmetric matrix (3, 3) of ``w`` (3,): its product with v is the cross product of w and v."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


# --- poses ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pose:
    """A camera-to-world pose: unit quaternion (4,), w first, and translation (3,) in meters."""

    quaternion: tuple[float, float, float, float]
    translation_m: tuple[float, float, float]

    @staticmethod
    def from_matrix(camera_to_world: ArrayLike) -> Pose:
        """Pose of a rigid (4, 4) or (3, 4) matrix. Raises GeometryError unless it is finite, orthonormal to
        1e-3 (real calibrations are; a sheared or mirrored matrix is a mistake), and its last row 0 0 0 1."""
        m = np.asarray(camera_to_world, dtype=np.float64)
        if m.shape not in ((4, 4), (3, 4)) or not np.all(np.isfinite(m)):
            raise GeometryError("pose must be a finite 3 x 4 or 4 x 4 matrix")
        if np.abs(m[3:] - _LAST_ROW).max(initial=0.0) > 1e-6:
            raise GeometryError("the pose's last row is not 0 0 0 1: is it transposed?")
        r = m[:3, :3]
        # Elements first: the products of huge ones overflow.
        sheared = np.abs(r).max() > 2.0 or np.abs(r @ r.T - np.eye(3)).max() > MAX_QUATERNION_ERROR
        if sheared or np.linalg.det(r) < 0:
            raise GeometryError("the pose's rotation is not orthonormal and right-handed")
        q = matrix_to_quaternion(r)
        return Pose(tuple(map(float, q)), tuple(map(float, m[:3, 3])))  # type: ignore[arg-type]

    def matrix(self) -> Array:
        """Camera-to-world matrix (4, 4)."""
        out = np.eye(4)
        out[:3, :3] = quaternion_to_matrix(self.quaternion)
        out[:3, 3] = self.translation_m
        return out

    def interpolate(self, other: Pose, fraction: float) -> Pose:
        """Pose at ``fraction`` (0 to 1) of the way to ``other``: slerp for the rotation, a straight line for
        the translation."""
        q = slerp(self.quaternion, other.quaternion, fraction)
        a, b = np.array(self.translation_m), np.array(other.translation_m)
        t = (1 - fraction) * a + fraction * b
        return Pose(tuple(map(float, q)), tuple(map(float, t)))  # type: ignore[arg-type]


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Camera-to-world matrix (4, 4) of a camera at ``eye`` (3,) that looks at ``target`` (3,).

    up: world direction (3,) that the image's up is as near to as possible.
    Raises GeometryError if ``eye`` and ``target`` are the same point.
    """
    eye, target = np.asarray(eye, dtype=np.float64), np.asarray(target, dtype=np.float64)
    forward = target - eye
    distance = np.linalg.norm(forward)
    if distance < 1e-12:
        raise GeometryError("look_at: the eye and the target are the same point")
    forward = forward / distance
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-9:  # looking along ``up``: any right axis will do
        right = np.cross(forward, [1.0, 0.0, 0.0])
        if np.linalg.norm(right) < 1e-9:
            right = np.cross(forward, [0.0, 1.0, 0.0])
    right = right / np.linalg.norm(right)
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2] = right, np.cross(forward, right), forward
    out[:3, 3] = eye
    return out


def on_sphere(
    target: ArrayLike, radius_m: float, azimuth_deg: float, elevation_deg: float, outward: bool = False
) -> Array:
    """Camera-to-world (4, 4) at ``radius_m`` from ``target`` (3,), looking at it or, if ``outward``, away
    from it. Azimuth 0 is on the target's -y side, 90 on its +x side; elevation 90 is above it."""
    a, e = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    away = np.array([np.cos(e) * np.sin(a), -np.cos(e) * np.cos(a), np.sin(e)])
    target = np.asarray(target, dtype=np.float64)
    eye = target + radius_m * away
    return look_at(eye, eye + away) if outward else look_at(eye, target)


# --- pinhole cameras --------------------------------------------------------------------------


def converging_point(origins: Array, directions: Array) -> Array | None:
    """The point (3,) nearest to all rays (N, 3) in least squares; None if they are parallel, diverge or start there."""
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    total = projectors.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-3 * len(origins):
        return None
    point = np.linalg.solve(total, (projectors @ origins[:, :, None]).sum(axis=0)[:, 0])
    along = ((point - origins) * directions).sum(axis=1)
    return point if np.median(along) > 1e-9 * np.abs(origins).max() else None


# A shorter mean of unit vectors has no meaning: the cameras roll freely.
_ROLLED = 0.25
# x axes of cameras that face nearly the same way (about 10 degrees to either side): smallest second eigenvalue of
# the mean of d d^T that spans a plane.
_FAN = 0.03


def world_up(poses: Array) -> Array:
    """The up direction, unit vector (3,). poses: camera-to-world (N, 4, 4), N >= 1.

    Cameras are held level, so up is perpendicular to their x axes. If these are parallel (a single camera, a
    row of cameras), it is the mean of the -y axes, which tilts with cameras that look down.
    """
    ups, sides = -poses[:, :3, 1], poses[:, :3, 0]
    mean = ups.mean(axis=0)
    if np.linalg.norm(mean) < _ROLLED:
        mean = ups[0]
    spread, directions = np.linalg.eigh(sides.T @ sides / len(sides))
    level = directions[:, 0] * (1.0 if directions[:, 0] @ mean >= 0 else -1.0)
    # Level cameras that face different ways: their x axes span a plane.
    if spread[1] > _FAN and spread[0] < 0.1 * spread[1] and level @ mean > _ROLLED:
        return level
    return mean / np.linalg.norm(mean)


@dataclass(frozen=True)
class Pinhole:
    """Pinhole intrinsics in pixels (corner origin).

    width, height: of the image. fx, fy: focal lengths. cx, cy: principal point.
    distortion: OpenCV's (k1, k2, p1, p2).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @staticmethod
    def from_fov(width: int, height: int, horizontal_fov_deg: float) -> Pinhole:
        """Centered square-pixel camera with the given horizontal field of view."""
        f = 0.5 * width / np.tan(0.5 * np.deg2rad(horizontal_fov_deg))
        return Pinhole(width, height, float(f), float(f), width / 2.0, height / 2.0)

    @staticmethod
    def from_opencv(
        width: int, height: int, matrix: ArrayLike, distortion: ArrayLike = (0.0, 0.0, 0.0, 0.0)
    ) -> Pinhole:
        """Camera of OpenCV's matrix (3, 3), whose pixel centers are whole numbers, and (k1, k2, p1, p2)."""
        m, (k1, k2, p1, p2) = np.asarray(matrix, dtype=np.float64), np.ravel(distortion).tolist()
        fx, fy, cx, cy = m[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        return Pinhole(width, height, fx, fy, cx + 0.5, cy + 0.5, (k1, k2, p1, p2))

    def opencv(self) -> tuple[Array, Array]:
        """OpenCV's matrix (3, 3), whose pixel centers are whole numbers, and (k1, k2, p1, p2)."""
        return np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1]]), np.array(
            self.distortion
        )

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return any(c != 0.0 for c in self.distortion)

    def scaled(self, factor: float) -> Pinhole:
        """The same camera with images resized by ``factor`` (sizes rounded)."""
        w, h = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        sx, sy = w / self.width, h / self.height
        return Pinhole(w, h, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, self.distortion)

    def halved(self, times: int) -> Pinhole:
        """The same camera with image sizes halved ``times`` times; odd sizes are rounded up, as in
        ``payload.decode``."""
        s = 0.5**times
        size = -(-self.width >> times), -(-self.height >> times)
        return Pinhole(*size, self.fx * s, self.fy * s, self.cx * s, self.cy * s, self.distortion)

    def rays(self, pixels: ArrayLike | None = None) -> Array:
        """Unit ray directions in camera axes.

        pixels: coordinates (N, 2), which give (N, 3); None: the centers of all pixels, which give (H, W, 3).
        """
        if pixels is None:
            u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        else:
            p = np.asarray(pixels, dtype=np.float64)
            u, v = p[..., 0], p[..., 1]
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        if self.distorted:
            x, y = self._undistort(x, y)
        return _unit_rays(x, y)

    def project(self, points: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in camera axes; NaN for points that are not in front."""
        p = np.asarray(points, dtype=np.float64)
        z = np.where(p[..., 2] > 1e-9, p[..., 2], np.nan)
        x, y = p[..., 0] / z, p[..., 1] / z
        if self.distorted:
            x, y = self._distort(x, y)
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        k1, k2, p1, p2 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * k2)
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def _undistort(self, xd: Array, yd: Array) -> tuple[Array, Array]:
        """The point that the lens maps to (xd, yd). Two Newton steps remove the residual of ``_nearly_undistorted``, up
        to a pixel at the corners of wide lenses; near a fold they diverge and are not taken."""
        k1, k2, p1, p2 = self.distortion
        x, y = self._nearly_undistorted(xd, yd)
        for _ in range(2):
            r2 = x * x + y * y
            radial, slope = 1.0 + r2 * (k1 + r2 * k2), 2.0 * (k1 + 2.0 * r2 * k2)
            # The Jacobian, which is symmetric: distortion is a gradient.
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            at_x, at_y = self._distort(x, y)
            ex, ey, determinant = at_x - xd, at_y - yd, xx * yy - xy * xy
            with np.errstate(all="ignore"):
                stepped = x - (yy * ex - xy * ey) / determinant, y - (xx * ey - xy * ex) / determinant
                at_x, at_y = self._distort(*stepped)
                nearer = np.hypot(at_x - xd, at_y - yd) < np.hypot(ex, ey)
            x, y = np.where(nearer, stepped[0], x), np.where(nearer, stepped[1], y)
        return x, y

    def _nearly_undistorted(self, xd: Array, yd: Array) -> tuple[Array, Array]:
        # Fixed-point iteration, as in OpenCV; eight rounds reach 1e-6 for lenses met in practice.
        k1, k2, p1, p2 = self.distortion
        x, y = xd, yd
        for _ in range(8):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * k2)
            dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            x, y = (xd - dx) / radial, (yd - dy) / radial
        return x, y


def _unit_rays(x: Array, y: Array) -> Array:
    """Unit directions (..., 3) of undistorted points (...) at depth 1."""
    d = np.stack([x, y, np.ones_like(x)], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def world_rays(camera: Pinhole, camera_to_world: ArrayLike) -> tuple[Array, Array]:
    """Origin (3,) and unit directions (H, W, 3) in world axes of every pixel's center."""
    m = np.asarray(camera_to_world, dtype=np.float64)
    return m[:3, 3].copy(), camera.rays() @ m[:3, :3].T


def seen_from(camera: Pinhole, camera_to_world: ArrayLike, points: ArrayLike) -> tuple[Array, Array, NDArray[np.bool_]]:
    """World points (N, 3) in camera axes, their pixels (N, 2), NaN behind the camera, and whether each is in the image
    (N,)."""
    m = np.asarray(camera_to_world, dtype=np.float64)
    local = (np.asarray(points, dtype=np.float64) - m[:3, 3]) @ m[:3, :3]
    at = camera.project(local)
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = np.all((at >= 0.0) & (at < (camera.width, camera.height)), axis=1)
    if camera.distorted:  # far outside the field of view, its polynomial folds back into the image
        ahead = (camera.rays(at[inside]) * local[inside]).sum(axis=1)
        inside[inside] = ahead > 0.999 * np.linalg.norm(local[inside], axis=1)
    return local, at, inside


_RASTER_POINTS = 33  # points a side at which a lens is checked


# All frames of a camera have the same lens; the cache is bounded because a hostile sender's may differ.
@lru_cache(maxsize=1024)
def invertible(camera: Pinhole) -> bool:
    """Whether the lens model can be inverted: undistortion (without its Newton steps) followed by projection returns
    each point of a grid over the whole image, edges included, within MAX_LENS_ERROR_PX. Undistortion diverges for
    coefficients that no real lens has."""
    if not camera.distorted:
        return True
    u, v = np.meshgrid(np.linspace(0.0, camera.width, _RASTER_POINTS), np.linspace(0.0, camera.height, _RASTER_POINTS))
    with np.errstate(all="ignore"):
        rays = _unit_rays(*camera._nearly_undistorted((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy))
        error_px = np.abs(camera.project(rays) - np.stack([u, v], axis=-1))
    # A NaN compares as False.
    return bool(np.isfinite(rays).all() and (error_px <= MAX_LENS_ERROR_PX).all())
