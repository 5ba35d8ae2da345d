"""Boxes and masks from any YOLO segmentation model in ONNX (v8 and v11 heads): letterbox, run, decode, suppress."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.embed import EmbeddingError
from edge_server.embed.backbone import MAX_FILE_BYTES, MAX_SIDE, exported_size, parse_model
from edge_server.embed.embedder import open_session, reason_of
from edge_server.embed.letterbox import blob, checked
from edge_server.foreground import MODELS, SHIPPED, ForegroundError
from freshfield.untrusted import read_bytes

Array = NDArray[np.float64]

NMS_IOU = 0.6
_TYPES: dict[str, type[np.floating]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
# Boxes that enter non-maximum suppression, by score.
_MOST = 300


@dataclass(frozen=True)
class Detection:
    """box: left, top, right, bottom in pixels of the image, not clipped to it. kind: the model's name of the
    class. mask: computes the object's mask (H, W), not clipped to the box."""

    box: tuple[float, float, float, float]
    score: float
    kind: str
    mask: Callable[[], NDArray[np.bool_]]


class Detector:
    """A YOLO segmentation model. path: its ONNX file, or the name of a shipped one (``SHIPPED``).
    ForegroundError: the file is missing or unusable, or its model gives no masks."""

    def __init__(self, path: str) -> None:
        file = MODELS / SHIPPED[path] if path in SHIPPED else Path(path)
        self.name = file.name
        self._session = open_model(file)
        image = self._session.get_inputs()[0]
        if len(self._session.get_inputs()) != 1 or len(image.shape) != 4 or image.type not in _TYPES:
            raise ForegroundError(f"{file}: expected a model of images (n, 3, height, width)")
        self._input, self._dtype = image.name, _TYPES[image.type]
        meta = self._session.get_modelmeta().custom_metadata_map
        self.height, self.width = _size(image.shape, meta, file)
        self.kinds = _kinds(meta)
        outputs = self._session.get_outputs()
        if len(outputs) != 2 or len(outputs[1].shape) != 4:
            raise ForegroundError(f"{file}: gives no masks; name a YOLO segmentation model (-seg)")
        self.detect(np.zeros((8, 8, 3), np.uint8), 1.0)  # a model that cannot run fails here

    def detect(self, image: NDArray[np.uint8], confidence: float) -> list[Detection]:
        """Detect objects in uint8 ``image`` (H, W, 3 or 4): best score first, after non-maximum suppression
        per class. confidence: minimum score. ForegroundError: the model fails, or its output is not that of a
        YOLO head."""
        whole = checked(image, 0)
        try:
            given = blob([whole], self.height, self.width, self._dtype)
            out, prototypes = map(np.asarray, self._session.run(None, {self._input: given}))
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise ForegroundError(f"{self.name}: {reason_of(error)}") from None
        if len(prototypes) != 1:
            raise ForegroundError(f"{self.name}: gives {prototypes.shape}, not masks (1, n, height, width)")
        rows = decode(out, confidence, self.name, prototypes.shape[1])
        h, w = whole.shape[:2]
        scale, _, (left, top) = self._placed((h, w))
        found = []
        for x0, y0, x1, y1, score, kind, *weights in rows:
            box = ((x0 - left) / scale, (y0 - top) / scale, (x1 - left) / scale, (y1 - top) / scale)
            mask = partial(self._mask, weights, prototypes[0], (h, w))
            found.append(Detection(box, score, self.kinds.get(int(kind), str(int(kind))), mask))
        return found

    def _placed(self, shape: tuple[int, int]) -> tuple[float, tuple[int, int], tuple[int, int]]:
        """Scale of an image in the letterboxed input, and its size and left upper corner there."""
        h, w = shape
        scale = min(self.height / h, self.width / w)
        size = max(1, round(w * scale)), max(1, round(h * scale))
        return scale, size, ((self.width - size[0]) // 2, (self.height - size[1]) // 2)

    def _mask(self, weights: list[float], prototypes: Array, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Where the weighted sum of prototypes (n, h, w) is positive, as a mask of the image's ``shape``. The
        prototypes cover the model's input."""
        h, w = shape
        _, size, (left, top) = self._placed(shape)
        logits = np.tensordot(np.asarray(weights, np.float32), prototypes.astype(np.float32), 1)
        logits = np.nan_to_num(logits, nan=-1.0)
        whole = cv2.resize(logits, (self.width, self.height), interpolation=cv2.INTER_LINEAR)
        image = whole[top : top + size[1], left : left + size[0]]
        mask: NDArray[np.bool_] = cv2.resize(image, (w, h), interpolation=cv2.INTER_LINEAR) > 0.0
        return mask


def decode(output: NDArray[np.floating], confidence: float, name: str, coefficients: int) -> list[tuple[float, ...]]:
    """Decode a YOLO head's ``output`` (1, 4 + kinds + coefficients, cells) or its transpose: center, size and
    a score per class, in pixels of the model's input, and the weights of the masks.

    Returns rows (left, top, right, bottom, score, kind, *coefficients), best score first, without those that
    are not finite or have no area. name: the model's name in errors. Raises ForegroundError."""
    if output.ndim != 3 or len(output) != 1 or min(output.shape[1:]) < 5 + coefficients:
        raise ForegroundError(
            f"{name}: gives {output.shape}, not the boxes and scores (1, 4 + kinds, cells) of a YOLO v8 or "
            "v11 head; export it with format=onnx and nms=False"
        )
    # The longer axis holds the cells: our smallest model has 64 of them, with 8 numbers each.
    table = output[0].T if output.shape[1] < output.shape[2] else output[0]
    table = table.astype(np.float64)
    end = table.shape[1] - coefficients
    scores, kinds = table[:, 4:end].max(axis=1), table[:, 4:end].argmax(axis=1)
    sound = np.isfinite(table).all(axis=1) & (scores >= confidence) & (table[:, 2:4] > 0).all(axis=1)
    best = np.flatnonzero(sound)
    best = best[np.argsort(-scores[best], kind="stable")][:_MOST]
    if not len(best):
        return []
    center, size = table[best, :2], table[best, 2:4]
    low = center - size / 2
    rectangles = np.concatenate([low, size], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(rectangles.tolist(), scores[best].tolist(), kinds[best].tolist(), 0.0, NMS_IOU)
    columns = (low, low + size, scores[best, None], kinds[best, None], table[best, end:])
    rows = np.concatenate(columns, axis=1)
    return [tuple(float(v) for v in rows[k]) for k in sorted(int(i) for i in kept)]


def open_model(file: Path) -> Any:
    """Open the ONNX model in ``file``. Raises ForegroundError."""
    try:
        data = read_bytes(file, MAX_FILE_BYTES)
        parse_model(data, file)
        return open_session(data, "auto", 1, str(file))[0]
    except OSError as error:
        raise ForegroundError(f"{file}: cannot be read: {error.strerror}; name a model in ONNX format") from None
    except EmbeddingError as error:
        raise ForegroundError(str(error)) from None


def _size(shape: list[Any], meta: dict[str, str], file: Path) -> tuple[int, int]:
    """(height, width) of the input: fixed by the model, else those of ``exported_size``."""
    height, width = (side if isinstance(side, int) else 0 for side in shape[2:])
    if not (height and width):
        height, width = exported_size(meta)
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise ForegroundError(f"{file}: images of {width} x {height} are not within 1 to {MAX_SIDE} a side")
    return height, width


def _kinds(meta: dict[str, str]) -> dict[int, str]:
    """Class names from the exporter's metadata; empty without them."""
    try:
        return {int(k): str(v) for k, v in ast.literal_eval(meta["names"]).items()}
    except (KeyError, ValueError, TypeError, AttributeError, SyntaxError, MemoryError, RecursionError):
        return {}
