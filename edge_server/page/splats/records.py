"""Encodes Gaussians in 16 bytes each, which a browser's shader reads without conversion.

An ellipsoid does not change when its axes are permuted or reversed. Of the 24 rotations that do so, one brings its
quaternion into the fundamental zone of cubic symmetry (Heinz and Neumann 1991), in which no component of the Rodrigues
vector, axis times tan(angle / 2), exceeds sqrt(2) - 1. Three bytes then hold a rotation to .2 degrees (RMS).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, POSITION, QUATERNION, SCALE
from edge_server.fields.splat.planar import unit_quaternions
from edge_server.fields.splat.splat_constants import LOG_SCALE_HIGH, LOG_SCALE_LOW, RAW_OPACITY_LIMIT

RECORD = np.dtype([("place", "<u2", 3), ("scale", "u1", 3), ("turn", "u1", 3), ("color", "u1", 3), ("alpha", "u1")])
ZONE = np.sqrt(2.0) - 1.0
COLOR_LOW, COLOR_STEP = -0.5, 2.0 / 255
"""Colors of Gaussians may leave [0, 1] by half (``COLOR_LOW`` in ``fields.splat.splat_constants``)."""
PLACE_STEP, TURN_STEP = 4.0 / 65535, 2.0 * ZONE / 255


def contract(points: NDArray) -> NDArray:
    """Scene units -> [-2, 2], each coordinate x beyond 1 as 2 - 1 / x."""
    far = np.abs(points) > 1.0
    return np.where(far, np.sign(points) * (2.0 - 1.0 / np.where(far, np.abs(points), 1.0)), points)


def expand(places: NDArray) -> NDArray:
    """The inverse of ``contract``."""
    far = np.abs(places) > 1.0
    return np.where(far, np.sign(places) / np.maximum(2.0 - np.abs(places), 1e-6), places)


def scale_range(params: NDArray[np.float32]) -> tuple[float, float]:
    """Lowest and highest log scale of the Gaussians (N, >= 14) that are drawn; a non-empty range."""
    scales = params[:, SCALE:QUATERNION]
    scales = scales[np.isfinite(scales)].clip(LOG_SCALE_LOW, LOG_SCALE_HIGH)
    low, high = (float(scales.min()), float(scales.max())) if scales.size else (-1.0, 0.0)
    return low, max(high, low + 1e-3)


def to_records(params: NDArray[np.float32], scales: tuple[float, float]) -> NDArray[np.void]:
    """RECORD (N,) of Gaussians, float32 (N, >= 14), scene units, without harmonics. Gaussians that are not finite,
    which no renderer draws, get alpha 0. scales: log scales of bytes 0 and 255; others are clipped."""
    out = np.zeros(len(params), RECORD)
    sound = np.asarray(np.isfinite(params[:, :BASE]).all(axis=1))
    params = np.where(sound[:, None], params[:, :BASE], np.float32(0.0))
    low, high = scales
    vector, order = _rodrigues(unit_quaternions(params))
    scale = np.take_along_axis(params[:, SCALE:QUATERNION], order, axis=1)
    raw = np.clip(params[:, OPACITY].astype(np.float64), -RAW_OPACITY_LIMIT, RAW_OPACITY_LIMIT)
    out["place"] = np.rint((contract(params[:, POSITION:SCALE].astype(np.float64)) + 2.0) / PLACE_STEP)
    out["scale"] = _bytes((scale - low) * (255.0 / (high - low)))
    out["turn"] = _bytes((vector + ZONE) / TURN_STEP)
    out["color"] = _bytes((params[:, COLOR:BASE] - COLOR_LOW) / COLOR_STEP)
    out["alpha"] = _bytes(255.0 / (1.0 + np.exp(-raw))) * sound
    return out


def from_records(records: NDArray[np.void], scales: tuple[float, float]) -> NDArray[np.float32]:
    """Gaussians, float32 (N, 14), that render like the records: the inverse of ``to_records`` up to rounding and the
    order of axes."""
    out = np.zeros((len(records), BASE), np.float32)
    low, high = scales
    out[:, POSITION:SCALE] = expand(records["place"] * PLACE_STEP - 2.0)
    out[:, SCALE:QUATERNION] = low + records["scale"] * ((high - low) / 255.0)
    out[:, QUATERNION] = 1.0
    out[:, QUATERNION + 1 : OPACITY] = records["turn"] * TURN_STEP - ZONE
    alpha = np.clip(records["alpha"] / 255.0, 1e-4, 1.0 - 1e-4)
    out[:, OPACITY] = np.log(alpha / (1.0 - alpha))
    out[:, COLOR:BASE] = COLOR_LOW + records["color"] * COLOR_STEP
    return out


def weights(params: NDArray[np.float32]) -> NDArray[np.float64]:
    """Visual weight of each Gaussian (N, >= 14): area of its two longest axes times opacity, outside the box divided by
    the squared distance from the center. 0 for one that is not finite."""
    scales = np.sort(params[:, SCALE:QUATERNION].clip(LOG_SCALE_LOW, LOG_SCALE_HIGH).astype(np.float64), axis=1)
    raw = np.clip(params[:, OPACITY].astype(np.float64), -RAW_OPACITY_LIMIT, RAW_OPACITY_LIMIT)
    far = np.maximum(np.linalg.norm(params[:, POSITION:SCALE].astype(np.float64), axis=1), 1.0)
    found = np.exp(scales[:, 1] + scales[:, 2]) / (1.0 + np.exp(-raw)) / far**2
    return np.where(np.isfinite(params[:, :BASE]).all(axis=1), found, 0.0)


def noticeable(before: NDArray[np.void], now: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which records (N,) differ visibly: by more than three steps of position (.2 mm per meter of the scene's radius),
    scale or alpha; two of color; six of rotation."""
    changed = np.zeros(len(now), np.bool_)
    for name, steps in (("place", 3), ("scale", 3), ("turn", 6), ("color", 2), ("alpha", 3)):
        apart = np.abs(now[name].astype(np.int32) - before[name]) > steps
        changed |= apart if apart.ndim == 1 else apart.any(axis=1)
    return changed


def _bytes(values: NDArray) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


_CUBIC = Rotation.create_group("O")
_GROUP = np.roll(_CUBIC.as_quat(), 1, axis=1)  # the 24 rotations of a cube, w first
_ORDERS = np.abs(_CUBIC.as_matrix()).argmax(axis=1)  # (24, 3): the order that each brings axes into


def _rodrigues(quaternions: NDArray) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Rodrigues vectors (N, 3) in the zone, of unit quaternions (N, 4), and the order (N, 3) of the axes: the columns
    of the matrix found are those of the given one in this order, up to signs."""
    q = quaternions.astype(np.float64)
    # w of q times each rotation: the zone is where it is largest.
    nearest = np.abs(q @ (_GROUP * [1.0, -1.0, -1.0, -1.0]).T).argmax(axis=1)
    g = _GROUP[nearest]
    w = q[:, 0] * g[:, 0] - (q[:, 1:] * g[:, 1:]).sum(axis=1)
    v = q[:, :1] * g[:, 1:] + g[:, :1] * q[:, 1:] + np.cross(q[:, 1:], g[:, 1:])
    return v / w[:, None], _ORDERS[nearest]
