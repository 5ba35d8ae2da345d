"""Make the background of images transparent; images that cannot be masked pass unchanged and are counted."""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge_server.embed import EmbeddingError, onnx_libraries
from edge_server.foreground import WHY
from edge_server.foreground.settings import SHIPPED, ForegroundConfig

if TYPE_CHECKING:
    from edge_server.foreground.detector import Detector

log = logging.getLogger(__name__)

Image = NDArray[np.uint8]


class Foreground:
    """Applied once to every decoded image.

    counts: images masked, and used whole by reason (``WHY``). seconds: total run time, for reports only.
    """

    def __init__(self, config: ForegroundConfig, detector: Detector) -> None:
        self.config, self.detector = config, detector
        self.counts: Counter[str] = Counter(dict.fromkeys(("masked", *WHY), 0))
        self.seconds = 0.0
        self._said: set[tuple[str, str]] = set()

    def apply(self, camera: str, image: Image) -> Image:
        """Mask uint8 ``image`` (H, W, 3 or 4). Returns RGBA (H, W, 4): background pixels become transparent
        and black, so that changes there do not count as motion; transparent pixels stay transparent. Without
        a mask, returns ``image`` itself."""
        begun = time.perf_counter()
        try:
            found = self._mask(image)
        except EmbeddingError:
            found = "failed"
        self.seconds += time.perf_counter() - begun
        counted = found if isinstance(found, str) else "masked"
        self.counts[counted] += 1
        if isinstance(found, str):
            self._say(camera, found)
            return image
        out = np.empty((*image.shape[:2], 4), np.uint8)
        out[..., :3] = np.where(found[..., None], image[..., :3], 0)
        out[..., 3] = np.where(found, image[..., 3] if image.shape[2] == 4 else 255, 0)
        return out

    def _say(self, camera: str, why: str) -> None:
        """Log a camera's first unmasked image for each reason, if the camera has a name."""
        if camera and (camera, why) not in self._said:
            self._said.add((camera, why))
            log.warning("camera %s: an image is used whole: %s (further ones: edge.json)", camera, WHY[why])

    def _mask(self, image: Image) -> NDArray[np.bool_] | str:
        """Object mask (H, W); if the image passes unchanged, why: a name in ``WHY``."""
        c = self.config
        found = [d for d in self.detector.detect(image, c.confidence) if not c.kinds or d.kind in c.kinds]
        if not found:
            return "not_detected"
        x0, y0, x1, y1 = found[0].box
        dx, dy = c.margin * (x1 - x0), c.margin * (y1 - y0)
        inside = np.zeros(image.shape[:2], np.bool_)
        left, top = (max(0, math.floor(at)) for at in (x0 - dx, y0 - dy))
        right, bottom = (max(0, math.ceil(at)) for at in (x1 + dx, y1 + dy))
        inside[top:bottom, left:right] = True
        mask: NDArray[np.bool_] = found[0].mask() & inside
        if not mask.any():
            return "not_detected"
        return "full_mask" if mask.all() else mask

    def status(self) -> dict[str, Any]:
        """Counts, and milliseconds per image."""
        images = self.counts.total()
        return {**self.counts, "ms_per_image": 1e3 * self.seconds / images if images else None}


def make_foreground(config: ForegroundConfig) -> Foreground:
    """Create from a config. Raises EmbeddingError: a library is not installed, or the model is unusable."""
    with onnx_libraries("the shipped model" if config.detector in SHIPPED else "an ONNX model"):
        from edge_server.foreground.detector import Detector
    detector = Detector(config.detector)
    known = set(detector.kinds.values())
    if known and (unknown := set(config.kinds) - known):
        raise EmbeddingError(
            f"kinds: {detector.name} knows no {', '.join(sorted(unknown))}; it knows {', '.join(sorted(known))}"
        )
    if not known and not all(kind.isdecimal() for kind in config.kinds):
        raise EmbeddingError(f"kinds: {detector.name} names no classes: give their numbers, such as '15'")
    return Foreground(config, detector)
