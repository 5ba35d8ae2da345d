"""Segmentation within a box: GrabCut (Rother, Kolmogorov and Blake 2004), an ONNX, or the whole box."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.foreground import BOX, GRABCUT, OWN, ForegroundConfig, ForegroundError

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]

_SEED = 4403
# Margin around the box, as a share of it: background for GrabCut to learn from, context for a model.
_AROUND = 0.15
_USUAL_SIDE = 320
_MEAN, _SPREAD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


class Segmenter(Protocol):
    """Labels each pixel within a box as object or background."""

    def mask(self, image: NDArray[np.uint8], box: Box) -> Mask:
        """Object mask (H, W) of ``image`` (H, W, 3). box: left, top, right, bottom, whole pixels within the
        image, not empty."""
        ...


def make_segmenter(config: ForegroundConfig) -> Segmenter:
    """Create the segmenter that ``config.segment`` names. ForegroundError: its model is unusable."""
    if config.segment == BOX:
        return WholeBox()
    if config.segment in (None, OWN, GRABCUT):
        return GrabCut(config.iterations, config.side)
    return SegmentModel(config)


class WholeBox:
    """No segmentation: the whole box is the object."""

    def mask(self, image: NDArray[np.uint8], box: Box) -> Mask:
        """See ``Segmenter``."""
        out = np.zeros(image.shape[:2], np.bool_)
        out[box[1] : box[3], box[0] : box[2]] = True
        return out


class GrabCut:
    """A graph cut between color mixtures of the box's inside and outside. side: longest side of the crop,
    pixels; a larger crop is shrunk, and its mask enlarged."""

    def __init__(self, iterations: int, side: int) -> None:
        self._iterations, self._side = iterations, side

    def mask(self, image: NDArray[np.uint8], box: Box) -> Mask:
        """See ``Segmenter``. The mask covers everything if the box leaves no background to learn from."""
        part, (left, top, right, bottom) = _surroundings(image.shape, box)
        crop = image[part[1] : part[3], part[0] : part[2]]
        h, w = crop.shape[:2]
        scale = min(1.0, self._side / max(h, w))
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
        cv2.grabCut(pixels, labels, unused, outside, inside, self._iterations, mode)
        found = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
        if scale < 1.0:
            soft = cv2.resize(found.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
            found = soft > 0.5
        within[:] = found
        return out


class SegmentModel:
    """An ONNX (U2-Net, IS-Net or similar) from a crop around the box to one foreground map: shares, or logits
    if any value is outside 0 to 1. Raises ForegroundError."""

    def __init__(self, config: ForegroundConfig) -> None:
        from edge_server.foreground.detector import open_model

        file = Path(str(config.segment))
        self._name = file.name
        self._session: Any = open_model(file, config.provider, config.threads)
        image = self._session.get_inputs()[0]
        if len(image.shape) != 4 or image.type != "tensor(float)":
            raise ForegroundError(f"{file}: expected a model of images (1, 3, height, width), float32")
        self._input = image.name
        self._height, self._width = (
            side if isinstance(side, int) else _USUAL_SIDE for side in image.shape[2:]
        )
        self._threshold = config.threshold
        unit = config.normalise == "unit"
        self._mean = np.zeros(3) if unit else _MEAN
        self._spread = np.ones(3) if unit else _SPREAD
        self.mask(np.zeros((8, 8, 3), np.uint8), (1, 1, 7, 7))  # an unusable model fails here

    def mask(self, image: NDArray[np.uint8], box: Box) -> Mask:
        """See ``Segmenter``; pixels outside the box are background."""
        part, _ = _surroundings(image.shape, box)
        crop = image[part[1] : part[3], part[0] : part[2]]
        fitted = cv2.resize(crop, (self._width, self._height), interpolation=cv2.INTER_LINEAR) / 255.0
        given = ((fitted - self._mean) / self._spread).transpose(2, 0, 1)[None].astype(np.float32)
        try:
            found = np.asarray(self._session.run(None, {self._input: given})[0], dtype=np.float32)
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            from edge_server.embed.embedder import reason_of

            raise ForegroundError(f"{self._name}: {reason_of(error)}") from None
        if found.size != found.shape[-1] * found.shape[-2] or found.ndim < 2:
            raise ForegroundError(
                f"{self._name}: gives {found.shape}, not one map (1, 1, height, width) of the foreground"
            )
        share: NDArray[np.floating] = found.reshape(found.shape[-2:])
        share = np.nan_to_num(share, nan=0.0, posinf=50.0, neginf=-50.0)
        if share.min() < 0.0 or share.max() > 1.0:
            share = 1.0 / (1.0 + np.exp(-np.clip(share, -50.0, 50.0)))
        out = np.zeros(image.shape[:2], np.bool_)
        size = (crop.shape[1], crop.shape[0])
        wanted = cv2.resize(share, size, interpolation=cv2.INTER_LINEAR) > self._threshold
        out[part[1] : part[3], part[0] : part[2]] = wanted
        return out & WholeBox().mask(image, box)


def _surroundings(shape: tuple[int, ...], box: Box) -> tuple[Box, Box]:
    """(the box plus margin, in image pixels; the box relative to that)."""
    left, top, right, bottom = box
    dx, dy = (max(2, round(_AROUND * side)) for side in (right - left, bottom - top))
    part = max(0, left - dx), max(0, top - dy), min(shape[1], right + dx), min(shape[0], bottom + dy)
    return part, (left - part[0], top - part[1], right - part[0], bottom - part[1])
