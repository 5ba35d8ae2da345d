"""Depth of plates by a monocular network of the user's, where neither sensors nor stereo find it.

A network tells inverse depth but for a scale and a shift (Ranftl et al., "Towards Robust Monocular Depth Estimation",
2020). Those are taken at which most of the pixels with known depth agree (RANSAC, Fischler and Bolles, 1981). Then the
network is corrected by what it errs evenly around them. Where too few agree it is not used, and says so.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.depth_plate import smooth
from edge_server.fields.splat.layers.depth.overlaps import overlaps
from edge_server.fields.splat.layers.depth.surfaces import Surface

log = logging.getLogger(__name__)

Image = NDArray[np.float32]
Network = Callable[[NDArray[np.uint8]], Image]
"""uint8 RGB (H, W, 3) -> relative inverse depth, float32 (H, W), NaN where there is none. ValueError: it fails."""


class NetworkDepth:
    """Fills surfaces by what ``network`` says of their plates.

    refused: camera -> why its network depth was not used, the last time.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        self.refused: dict[str, str] = {}

    def fill(
        self, names: Sequence[str], surfaces: Sequence[Surface], measured: Sequence[NDArray[np.bool_]], pool: Pool
    ) -> list[Surface]:
        """The surfaces with the network's depth where they have none, and where it contradicts their stereo but agrees
        with most of it. names: of their cameras. measured: bool (H, W), where a sensor measured their depth."""
        before, self.refused = self.refused, {}
        out = [self._filled(name, k, surfaces, measured[k], pool) for k, name in enumerate(names)]
        for name, why in self.refused.items():
            if before.get(name) != why:
                log.warning("%s: the depth network is not used: %s", name, why)
        return out

    def _filled(
        self, name: str, k: int, surfaces: Sequence[Surface], measured: NDArray[np.bool_], pool: Pool
    ) -> Surface:
        surface = surfaces[k]
        known = inverse = np.where(surface.known, surface.inverse, 0.0).astype(np.float32)
        if np.count_nonzero(known) < tuned.NETWORK_LEAST:
            known = _seen_by_others(k, surfaces)
        color = np.nan_to_num(np.clip(surface.color, 0.0, 255.0)).astype(np.uint8)
        try:
            found, agree = align(self.network(color), known)
        except ValueError as error:
            self.refused[name] = str(error)
            return surface
        plane, slope = smooth(found, surface.color, pool, tuned.NETWORK_NOISE * float(np.median(known[known > 0])))
        keep = inverse > 0
        if agree >= tuned.NETWORK_BETTER:
            with np.errstate(divide="ignore", invalid="ignore"):
                keep &= measured | (plane == 0) | (np.abs(np.log(plane / inverse)) < tuned.NETWORK_NEAR)
        inverse, slope = np.where(keep, inverse, plane), np.where(keep[..., None], surface.slope, slope)
        return replace(surface, inverse=inverse, slope=slope)


def _seen_by_others(k: int, surfaces: Sequence[Surface]) -> Image:
    """Inverse depth of what other cameras know, in the pixels of camera k that have the same color, float32 (H, W)."""
    out = np.zeros(surfaces[k].known.shape, np.float32)
    for pair in overlaps(surfaces):
        if pair.seen_by == k:
            alike = np.abs(pair.colors[0] - pair.colors[1]).max(axis=1) < tuned.NETWORK_COLOR
            x, y = pair.pixels[:, alike]
            out[y, x] = np.maximum(out[y, x], 1.0 / pair.depth[alike])  # the nearest hides the others
    return out


def align(relative: Image, inverse: Image) -> tuple[Image, float]:
    """The network's inverse depth in 1 / m, float32 (H, W), and the share of the known depths that agree with it.

    It is 0 where it cannot be believed: far beyond the known depths.

    relative: of the network, float32 (H, W). inverse: known inverse depth, 1 / m, float32 (H, W), 0 unknown.
    ValueError: too little is known, or too little of it agrees with any scale and shift.
    """
    known = (inverse > 0) & np.isfinite(relative)
    if np.count_nonzero(known) < tuned.NETWORK_LEAST:
        raise ValueError("too few of its pixels have a depth from stereo or sensors to compare with")
    r, q = relative[known].astype(np.float64), inverse[known].astype(np.float64)
    some = np.s_[:: max(1, r.size // tuned.NETWORK_POINTS)]
    scale, shift = _line(r[some], q[some])
    log_ratio = np.log(q / np.maximum(scale * r + shift, 1e-9))
    agree = np.abs(log_ratio) < tuned.NETWORK_AGREE
    if not scale > 0 or agree.mean() < tuned.NETWORK_TRUSTED:
        raise ValueError(
            f"at most {100 * agree.mean() * (scale > 0):.0f} % of the depths that stereo or sensors know agree with it"
        )
    right, error = np.zeros(inverse.shape, np.float32), np.zeros(inverse.shape, np.float32)
    right[known], error[known] = agree, np.where(agree, log_ratio, 0.0)
    spread_px = tuned.NETWORK_SPREAD * max(inverse.shape)
    even = cv2.GaussianBlur(error, (0, 0), spread_px) / (cv2.GaussianBlur(right, (0, 0), spread_px) + 1e-2)
    metric = np.nan_to_num(scale * relative + shift) * np.exp(even)
    low, high = np.percentile(q, tuned.NETWORK_KNOWN)
    believed = (metric > low / tuned.NETWORK_BEYOND) & (metric < high * tuned.NETWORK_BEYOND)
    return np.where(believed, metric, 0.0).astype(np.float32), float(agree.mean())


def _line(r: NDArray[np.float64], q: NDArray[np.float64]) -> tuple[float, float]:
    """Scale and shift at which most of q agrees with ``scale * r + shift``; scale is 0 where none that is positive
    does."""
    rng = np.random.default_rng(0)  # the same points give the same line
    i, j = rng.integers(0, r.size, (2, tuned.NETWORK_LINES))
    # Two points of one flat wall tell no scale: rounding would choose it, and the wall's pixels outvote all others.
    apart = np.abs(q[i] - q[j]) > tuned.NETWORK_AGREE * np.maximum(q[i], q[j])
    use = apart & ((q[i] - q[j]) * (r[i] - r[j]) > 0)
    scales = (q[i] - q[j])[use] / (r[i] - r[j])[use]
    if not scales.size:
        return 0.0, float(np.median(q))
    shifts = q[i][use] - scales * r[i][use]
    errors = np.abs(scales[:, None] * r + shifts[:, None] - q)
    best = int(np.argmax((errors < tuned.NETWORK_AGREE * q).sum(axis=1)))
    agree = errors[best] < tuned.NETWORK_AGREE * q
    if np.ptp(r[agree]) <= 0:
        return float(scales[best]), float(shifts[best])
    rows = np.stack([r[agree], np.ones(np.count_nonzero(agree))], axis=1) / q[agree, None]  # even in log depth
    scale, shift = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
    return float(scale), float(shift)
