"""Segmentation within a box: GrabCut (Rother, Kolmogorov and Blake 2004), or the whole box."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.foreground import BOX, ForegroundConfig

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]
"""Left, top, right, bottom: whole pixels within the image, not empty."""
Segmenter = Callable[[NDArray[np.uint8], Box], Mask]
"""(image (H, W, 3), box) -> mask (H, W) of the object."""

_SEED = 4403
# Margin around the box, as a share of it: background for GrabCut to learn from.
_AROUND = 0.15


def make_segmenter(config: ForegroundConfig) -> Segmenter:
    """The segmentation that ``config.segment`` names, for images without a detector's mask."""
    if config.segment == BOX:
        return whole_box
    return partial(grabcut, iterations=config.iterations, side=config.side)


def whole_box(image: NDArray[np.uint8], box: Box) -> Mask:
    """No segmentation: the whole box is the object."""
    out = np.zeros(image.shape[:2], np.bool_)
    out[box[1] : box[3], box[0] : box[2]] = True
    return out


def grabcut(image: NDArray[np.uint8], box: Box, iterations: int, side: int) -> Mask:
    """A graph cut between color mixtures of the box's inside and outside. The mask covers everything if the
    box leaves no background to learn from.

    iterations: rounds of GrabCut.
    side: longest side of the crop, pixels; a larger crop is shrunk, and its mask enlarged.
    """
    part, (left, top, right, bottom) = _surroundings(image.shape, box)
    crop = image[part[1] : part[3], part[0] : part[2]]
    h, w = crop.shape[:2]
    scale = min(1.0, side / max(h, w))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    small = cv2.resize(crop, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else crop
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    rows = slice(int(top * scale), max(int(top * scale) + 1, int(np.ceil(bottom * scale))))
    columns = slice(int(left * scale), max(int(left * scale) + 1, int(np.ceil(right * scale))))
    labels[rows, columns] = cv2.GC_PR_FGD
    out = np.zeros(image.shape[:2], np.bool_)
    within = out[part[1] : part[3], part[0] : part[2]]
    if (labels == cv2.GC_PR_FGD).all():
        within[:] = True
        return out
    # GrabCut initializes its mixtures by k-means, which uses OpenCV's global random generator.
    cv2.setRNGSeed(_SEED)
    inside, outside = np.zeros((1, 65)), np.zeros((1, 65))
    unused = (0, 0, 1, 1)  # the labels replace the rectangle
    mode = cv2.GC_INIT_WITH_MASK
    pixels = np.ascontiguousarray(small)
    cv2.grabCut(pixels, labels, unused, outside, inside, iterations, mode)
    found = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if scale < 1.0:
        soft = cv2.resize(found.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
        found = soft > 0.5
    within[:] = found
    return out


def _surroundings(shape: tuple[int, ...], box: Box) -> tuple[Box, Box]:
    """(the box plus margin, in image pixels; the box relative to that)."""
    left, top, right, bottom = box
    dx, dy = (max(2, round(_AROUND * side)) for side in (right - left, bottom - top))
    part = max(0, left - dx), max(0, top - dy), min(shape[1], right + dx), min(shape[0], bottom + dy)
    return part, (left - part[0], top - part[1], right - part[0], bottom - part[1])
