"""Typical image errors of this system at random strength, for fitting a perceptual distance."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Distort = Callable[[Image, Image, np.random.Generator], NDArray]
"""(image, the same view at another instant, rng) -> the distorted image, uint8 or floating 0..255."""


def _blur(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    return cv2.GaussianBlur(image, (0, 0), 0.3 * 12.0 ** rng.random())


def _noise(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    return image + rng.normal(0.0, 2.0 * 20.0 ** rng.random(), image.shape)


def _jpeg(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(3, 70))])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


def _exposure(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    return image * rng.uniform(0.5, 1.5, 3 if rng.random() < 0.5 else 1) + rng.uniform(-30, 30)


def _stale(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    return other


def _ghost(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    """A blend of two instants, or of an image with a shifted one."""
    dx, dy = rng.uniform(-8, 8, 2) * (rng.random() < 0.5)
    moved = cv2.warpAffine(
        other, np.array([[1, 0, dx], [0, 1, dy]]), other.shape[1::-1], borderMode=cv2.BORDER_REPLICATE
    )
    share = rng.uniform(0.1, 0.6)
    return image * (1.0 - share) + moved * share


def _coarse(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    """The rendering of a field with too few cells."""
    h, w = image.shape[:2]
    k = rng.uniform(1.3, 7.0)
    small = cv2.resize(image, (max(1, int(w / k)), max(1, int(h / k))), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (w, h), interpolation=cv2.INTER_LINEAR))


def _displaced(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    """A camera with a wrong pose."""
    turn = cv2.getRotationMatrix2D((image.shape[1] / 2, image.shape[0] / 2), rng.normal(0, 1.5), 1.0)
    turn = np.column_stack([turn[:, :2], turn[:, 2] + rng.normal(0.0, 2.0, 2)])
    return np.asarray(cv2.warpAffine(image, turn, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE))


def _floaters(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    """Soft blobs of stray density in front of the scene."""
    h, w = image.shape[:2]
    y, x = np.mgrid[0:h, 0:w]
    out = image.astype(np.float64)
    for _ in range(rng.integers(1, 12)):
        cy, cx, r = rng.uniform(0, h), rng.uniform(0, w), rng.uniform(2, 18)
        alpha = rng.uniform(0.2, 0.9) * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * r * r))
        out = out * (1 - alpha[..., None]) + rng.uniform(0, 255, 3) * alpha[..., None]
    return out


def _warped(image: Image, other: Image, rng: np.random.Generator) -> NDArray:
    """Wrong geometry: a smooth random displacement of every pixel."""
    h, w = image.shape[:2]
    coarse = rng.normal(0.0, 2.5 * rng.random(), (2, 6, 6)).astype(np.float32)
    dx, dy = (cv2.resize(c, (w, h), interpolation=cv2.INTER_CUBIC) for c in coarse)
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    return np.asarray(cv2.remap(image, x + dx, y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


DISTORTIONS: dict[str, Distort] = {
    "blur": _blur,
    "noise": _noise,
    "jpeg": _jpeg,
    "exposure": _exposure,
    "stale": _stale,
    "ghost": _ghost,
    "coarse": _coarse,
    "displaced": _displaced,
    "floaters": _floaters,
    "warped": _warped,
}


def distorted(image: Image, other: Image, rng: np.random.Generator) -> tuple[Image, str]:
    """An image with one random distortion, or with two in three cases of ten; and their names."""
    names = rng.choice(list(DISTORTIONS), 2 if rng.random() < 0.3 else 1, replace=False)
    out = image
    for name in names:
        out = np.clip(np.rint(DISTORTIONS[name](out, other, rng)), 0, 255).astype(np.uint8)
    return out, "+".join(names)
