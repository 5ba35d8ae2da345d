"""Baselines that need no field: the mean color, and the nearest camera's own image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_server.fidelity.images import BLACK, Color, to_unit
from edge_server.fidelity.psnr import psnr, psnr_of_mse
from edge_server.fields import View
from edge_server.run_records import Baseline


class BaselineMean:
    """The running mean of the baselines of any number of images; other threads may read ``mean``."""

    def __init__(self) -> None:
        self.mean = Baseline()
        self._count = 0

    def add(self, found: Baseline) -> None:
        """Take the baselines of one image, always the same of them known."""
        self._count += 1
        pairs = zip(msgspec.structs.astuple(self.mean), msgspec.structs.astuple(found))
        self.mean = Baseline(
            *(None if db is None else (mean or 0.0) + (db - (mean or 0.0)) / self._count for mean, db in pairs)
        )


def baseline(views: Sequence[View], truth: NDArray, camera_to_world: ArrayLike, background: Color = BLACK) -> Baseline:
    """Both baselines of one held-out image (H, W, 3) seen from ``camera_to_world`` (4, 4); none without views."""
    if not views:
        return Baseline()
    return Baseline(
        mean_color_db=mean_color_db([v.image for v in views], truth, background),
        nearest_view_db=view_db(nearest_view(views, camera_to_world).image, truth, background),
    )


def mean_color_db(images: Sequence[NDArray], truth: NDArray, background: Color = BLACK) -> float:
    """PSNR of a flat image in the mean color of the training images (each image weighs the same)."""
    mean = np.mean([to_unit(i, "training view", background).mean((0, 1)) for i in images], axis=0)
    return psnr_of_mse(float(((to_unit(truth, "truth", background) - mean) ** 2).mean()))


def view_db(image: NDArray, truth: NDArray, background: Color = BLACK) -> float:
    """PSNR of an unchanged training image, resampled where its size differs from the truth's."""
    target = to_unit(truth, "truth", background)
    shown = to_unit(image, "training view", background)
    height, width = target.shape[:2]
    if shown.shape != target.shape:
        how = cv2.INTER_AREA if width < shown.shape[1] else cv2.INTER_LINEAR
        shown = np.asarray(cv2.resize(shown, (width, height), interpolation=how), dtype=np.float64)
    score = psnr(shown, target)
    assert score is not None  # no mask was given
    return score


def nearest_view(views: Sequence[View], camera_to_world: ArrayLike) -> View:
    """The view with the nearest camera: distance of centers in units of the rig's radius plus angle between
    viewing directions in radians. The first of equals wins."""
    pose = np.asarray(camera_to_world, dtype=np.float64)
    centers = np.array([v.camera_to_world[:3, 3] for v in views])
    forward = np.array([v.camera_to_world[:3, 2] for v in views])
    # One radian of turning counts as much as one rig radius of moving.
    radius = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
    distance = np.linalg.norm(centers - pose[:3, 3], axis=1) / (radius if radius > 1e-9 else 1.0)
    angle = np.arccos(np.clip(forward @ pose[:3, 2], -1.0, 1.0))
    return views[int(np.argmin(distance + angle))]
