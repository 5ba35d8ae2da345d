"""Make the background of images transparent; images that cannot be masked pass unchanged and are counted."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.embed import EmbeddingError
from edge_server.foreground import BOX, DEFAULT, OBJECTS, OWN, WHY, ForegroundConfig, ForegroundError
from edge_server.foreground.segment import Box, Segmenter, make_segmenter, whole_box

log = logging.getLogger(__name__)

Image = NDArray[np.uint8]
Weight = NDArray[np.float32]


@dataclass
class Counts:
    """Images per result: masked, or unchanged because nothing was detected, the box or the mask had no area,
    the mask covered everything, or a model failed."""

    masked: int = 0
    not_detected: int = 0
    empty_box: int = 0
    empty_mask: int = 0
    full_mask: int = 0
    failed: int = 0


class Foreground:
    """Applied once to every decoded image. ``seconds``: total run time, for reports only."""

    def __init__(self, config: ForegroundConfig, boxes: Boxes, segmenter: Segmenter) -> None:
        self.config = config
        self.counts = Counts()
        self.seconds = 0.0
        self._boxes, self._segmenter = boxes, segmenter
        self._said: set[tuple[str, str]] = set()

    def apply(self, camera: str, image: Image) -> tuple[Image, Weight | None]:
        """Mask uint8 ``image`` (H, W, 3 or 4). Returns RGBA (H, W, 4) and each pixel's supervision weight,
        float32 (H, W), or None if all are 1. Background pixels become transparent and black, so that changes
        there do not count as motion; transparent pixels stay transparent. Without a mask, returns ``image``
        itself."""
        begun = time.perf_counter()
        try:
            found = self._mask(camera, image)
        except (ForegroundError, EmbeddingError):
            found = "failed"
        self.seconds += time.perf_counter() - begun
        counted = found if isinstance(found, str) else "masked"
        setattr(self.counts, counted, getattr(self.counts, counted) + 1)
        if isinstance(found, str):
            self._say(camera, found)
            return image, None
        mask, box = found
        out = np.empty((*image.shape[:2], 4), np.uint8)
        out[..., :3] = np.where(mask[..., None], image[..., :3], 0)
        out[..., 3] = np.where(mask, image[..., 3] if image.shape[2] == 4 else 255, 0)
        doubt = np.float32(self.config.doubt)
        # A whole-box mask labels no pixel within the box as background.
        if doubt == 1.0 or self.config.segment == BOX:
            return out, None
        weight: Weight = np.ones(mask.shape, np.float32)
        inside = weight[box[1] : box[3], box[0] : box[2]]
        inside[~mask[box[1] : box[3], box[0] : box[2]]] = doubt
        return out, weight

    def _say(self, camera: str, why: str) -> None:
        """Log a camera's first unmasked image for each reason, if the camera has a name."""
        if camera and (camera, why) not in self._said:
            self._said.add((camera, why))
            log.warning("camera %s: an image is used whole: %s (further ones: edge.json)", camera, WHY[why])

    def _mask(self, camera: str, image: Image) -> tuple[NDArray[np.bool_], Box] | str:
        """Object mask (H, W) and box; if the image passes unchanged, why: a name of ``Counts``."""
        height, width = image.shape[:2]
        found = self._boxes.of(camera, image)
        if found is None:
            return "not_detected"
        box = clipped(found.box, width, height)
        if box is None:
            return "empty_box"
        if self.config.segment in (None, OWN) and found.mask is not None:
            mask = found.mask() & whole_box(image, box)
        else:
            mask = self._segmenter(np.ascontiguousarray(image[..., :3]), box)
        if not mask.any():
            return "empty_mask"
        return "full_mask" if mask.all() else (mask, box)

    def status(self) -> dict[str, Any]:
        """Counts, and milliseconds per image."""
        images = sum(vars(self.counts).values())
        return {**vars(self.counts), "ms_per_image": 1e3 * self.seconds / images if images else None}


@dataclass(frozen=True)
class Found:
    """The object. box: left, top, right, bottom in pixels, possibly beyond the image. mask: computes the
    detector's own mask (H, W); None without one."""

    box: tuple[float, float, float, float]
    mask: Callable[[], NDArray[np.bool_]] | None = None


class Boxes:
    """The object's box, fixed or detected. Raises ForegroundError."""

    def __init__(self, config: ForegroundConfig) -> None:
        self._config = config
        self._detector = None
        if config.detector is not None:
            from edge_server.foreground.detector import Detector

            self._detector = Detector(config.detector)
            known = set(self._detector.kinds.values())
            if known and (unknown := set(config.kinds) - known):
                raise ForegroundError(
                    f"kinds: {self._detector.name} knows no {', '.join(sorted(unknown))}; "
                    f"it knows {', '.join(sorted(known))}"
                )
        if config.segment == OWN and (self._detector is None or not self._detector.gives_masks):
            raise ForegroundError(
                f"segment: {OWN}: {self._detector.name if self._detector else 'a fixed box'} gives no masks; "
                "name a YOLO segmentation model (-seg), or grabcut"
            )

    def of(self, camera: str, image: Image) -> Found | None:
        """None if nothing was detected."""
        c = self._config
        if self._detector is None:
            share = c.boxes.get(camera, c.box)
            if share is None:
                return None
            height, width = image.shape[:2]
            return Found((share[0] * width, share[1] * height, share[2] * width, share[3] * height))
        found = [d for d in self._detector.detect(image, c.confidence) if not c.kinds or d.kind in c.kinds]
        if not found:
            return None
        x0, y0, x1, y1 = found[0].box
        dx, dy = c.margin * (x1 - x0), c.margin * (y1 - y0)
        return Found((x0 - dx, y0 - dy, x1 + dx, y1 + dy), found[0].mask)


def clipped(box: tuple[float, float, float, float], width: int, height: int) -> Box | None:
    """Clip ``box`` to whole pixels of the image; None if it is empty."""
    if not all(map(math.isfinite, box)):
        return None
    left, top = max(0, math.floor(box[0])), max(0, math.floor(box[1]))
    right, bottom = min(width, math.ceil(box[2])), min(height, math.ceil(box[3]))
    empty = right <= left or bottom <= top or box[2] <= box[0] or box[3] <= box[1]
    return None if empty else (left, top, right, bottom)


def make_foreground(config: ForegroundConfig) -> Foreground:
    """Create from a config. Raises ForegroundError: a library is not installed, or a model is unusable."""
    try:
        return Foreground(config, Boxes(config), make_segmenter(config))
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("onnx", "onnxruntime"):
            raise
        package = error.name.split(".")[0]
        what = "the shipped detector" if config.detector in (DEFAULT, *OBJECTS) else "an ONNX model"
        raise ForegroundError(
            f"{what} needs {package}, which is not installed: pip install 'freshfield[embed]'"
        ) from None
