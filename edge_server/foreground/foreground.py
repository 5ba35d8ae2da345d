"""A picture in, the same with its background transparent out; or the picture as it is, and counted."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.embed import EmbeddingError
from edge_server.foreground import BOX, DEFAULT, ForegroundConfig, ForegroundError
from edge_server.foreground.segment import Box, Segmenter, make_segmenter

Image = NDArray[np.uint8]
Weight = NDArray[np.float32]


@dataclass
class Counts:
    """Pictures by what became of them: masked, or passed through whole because nothing was detected, the box
    or the mask had no area, the mask left nothing out, or a model failed."""

    masked: int = 0
    not_detected: int = 0
    empty_box: int = 0
    empty_mask: int = 0
    full_mask: int = 0
    failed: int = 0


class Foreground:
    """Applied to every decoded picture, once. ``seconds``: what it took so far (a measurement, no part of
    what is decided)."""

    def __init__(self, config: ForegroundConfig, boxes: Boxes, segmenter: Segmenter) -> None:
        self.config = config
        self.counts = Counts()
        self.seconds = 0.0
        self._boxes, self._segmenter = boxes, segmenter

    def apply(self, camera: str, image: Image) -> tuple[Image, Weight | None]:
        """RGBA (H, W, 4) with alpha 0 on the background (its colour black, so that what happens there is not
        taken for motion), of uint8 ``image`` (H, W, 3 or 4), and how much each pixel supervises, float32
        (H, W), None: all of them in full; ``image`` itself where there is nothing to cut out. An alpha that
        it has already stays: what was transparent is not made opaque."""
        begun = time.perf_counter()
        try:
            found = self.mask(camera, image)
        except (ForegroundError, EmbeddingError):
            self.counts.failed += 1
            found = None
        self.seconds += time.perf_counter() - begun
        if found is None:
            return image, None
        mask, box = found
        self.counts.masked += 1
        out = np.empty((*image.shape[:2], 4), np.uint8)
        out[..., :3] = np.where(mask[..., None], image[..., :3], 0)
        out[..., 3] = np.where(mask, image[..., 3] if image.shape[2] == 4 else 255, 0)
        doubt = np.float32(self.config.doubt)
        # Where nothing was decided within the box there is nothing to doubt.
        if doubt == 1.0 or self.config.segment == BOX:
            return out, None
        weight: Weight = np.ones(mask.shape, np.float32)
        inside = weight[box[1] : box[3], box[0] : box[2]]
        inside[~mask[box[1] : box[3], box[0] : box[2]]] = doubt
        return out, weight

    def mask(self, camera: str, image: Image) -> tuple[NDArray[np.bool_], Box] | None:
        """(H, W), True on the object, and its box; None, counted, where the picture is to pass whole."""
        height, width = image.shape[:2]
        found = self._boxes.of(camera, image)
        if found is None:
            self.counts.not_detected += 1
            return None
        box = clipped(found, width, height)
        if box is None:
            self.counts.empty_box += 1
            return None
        mask = self._segmenter.mask(np.ascontiguousarray(image[..., :3]), box)
        if not mask.any():
            self.counts.empty_mask += 1
            return None
        if mask.all():
            self.counts.full_mask += 1
            return None
        return mask, box

    def status(self) -> dict[str, Any]:
        """Counts, and milliseconds a picture."""
        pictures = sum(vars(self.counts).values())
        return {**vars(self.counts), "ms_per_image": 1e3 * self.seconds / pictures if pictures else None}


class Boxes:
    """Where the object is: fixed, or detected. Raises ForegroundError."""

    def __init__(self, config: ForegroundConfig) -> None:
        self._config = config
        self._detector = None
        if config.detector is not None:
            from edge_server.foreground.detector import Detector

            self._detector = Detector(config.detector, config.provider, config.threads)
            known = set(self._detector.kinds.values())
            if known and (unknown := set(config.kinds) - known):
                raise ForegroundError(
                    f"kinds: {self._detector.name} knows no {', '.join(sorted(unknown))}; "
                    f"it knows {', '.join(sorted(known))}"
                )

    def of(self, camera: str, image: Image) -> tuple[float, float, float, float] | None:
        """Left, top, right, bottom in pixels, maybe beyond the image; None where nothing was detected."""
        c = self._config
        if self._detector is None:
            share = c.boxes.get(camera, c.box)
            if share is None:
                return None
            height, width = image.shape[:2]
            return share[0] * width, share[1] * height, share[2] * width, share[3] * height
        found = [d for d in self._detector.detect(image, c.confidence) if not c.kinds or d.kind in c.kinds]
        if not found:
            return None
        if c.choose == "largest":
            found.sort(key=lambda d: (d.box[0] - d.box[2]) * (d.box[3] - d.box[1]))
        x0, y0, x1, y1 = found[0].box
        dx, dy = c.margin * (x1 - x0), c.margin * (y1 - y0)
        return x0 - dx, y0 - dy, x1 + dx, y1 + dy


def clipped(box: tuple[float, float, float, float], width: int, height: int) -> Box | None:
    """Whole pixels of ``box`` within the image; None where none are left."""
    if not all(map(math.isfinite, box)):
        return None
    left, top = max(0, math.floor(box[0])), max(0, math.floor(box[1]))
    right, bottom = min(width, math.ceil(box[2])), min(height, math.ceil(box[3]))
    empty = right <= left or bottom <= top or box[2] <= box[0] or box[3] <= box[1]
    return None if empty else (left, top, right, bottom)


def make_foreground(config: ForegroundConfig) -> Foreground:
    """What a section describes. Raises ForegroundError: a library that is not installed, a model that cannot
    be used."""
    try:
        return Foreground(config, Boxes(config), make_segmenter(config))
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("onnx", "onnxruntime"):
            raise
        package = error.name.split(".")[0]
        what = "the shipped detector" if config.detector == DEFAULT else "an ONNX model"
        raise ForegroundError(
            f"{what} needs {package}, which is not installed: pip install 'freshfield[embed]'"
        ) from None
