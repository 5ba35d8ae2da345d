"""Boxes and masks from any YOLO segmentation model in ONNX: letterbox, run, decode, suppress.

Heads: raw ones (v8, v11), raw with objectness (v5), and end-to-end ones that suppress by themselves (v26, nms=True).
They are told apart by the exporter's metadata and the number of columns, and believed only if scores lie in 0 to 1.
"""

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

from edge_server import edge_constants as tuned
from edge_server.embed import EmbeddingError
from edge_server.embed.backbone import input_size
from edge_server.embed.embedder import INPUT_TYPES, open_model, reason_of
from edge_server.embed.letterbox import blob, checked, placed
from edge_server.foreground.settings import MODELS, SHIPPED

Array = NDArray[np.float64]

_EXPORT = "yolo export model=yolo11n-seg.pt format=onnx"
# Least and greatest score, with what float16 rounds.
_SCORES = (-1e-3, 1.0 + 1e-3)


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
    EmbeddingError: the file is missing or unusable, or its model gives no masks."""

    def __init__(self, path: str) -> None:
        file = MODELS / SHIPPED[path] if path in SHIPPED else Path(path)
        self.name = file.name
        self._session = open_model(file)
        image = self._session.get_inputs()[0]
        if len(self._session.get_inputs()) != 1 or len(image.shape) != 4 or image.type not in INPUT_TYPES:
            raise EmbeddingError(f"{file}: expected a model of images (n, 3, height, width)")
        self._input, self._dtype = image.name, INPUT_TYPES[image.type]
        meta = self._session.get_modelmeta().custom_metadata_map
        height, width = (side if isinstance(side, int) else 0 for side in image.shape[2:])
        self.height, self.width = input_size(height, width, meta, file)
        self.kinds = _kinds(meta)
        outputs = sorted(self._session.get_outputs(), key=lambda output: len(output.shape))
        task = meta.get("task", "segment")
        if task != "segment" or len(outputs) != 2 or len(outputs[1].shape) != 4:
            what = f"it is a model of the task {task}" if "task" in meta else "its outputs are no boxes and prototypes"
            raise EmbeddingError(f"{file}: gives no masks: {what}; name a YOLO segmentation model: {_EXPORT}")
        self._outputs = [output.name for output in outputs]
        self._end_to_end = _end_to_end(meta)
        self.detect(np.zeros((8, 8, 3), np.uint8), 1.0)  # a model that cannot run fails here

    def detect(self, image: NDArray[np.uint8], confidence: float) -> list[Detection]:
        """Detect objects in uint8 ``image`` (H, W, 3 or 4): best score first, after non-maximum suppression
        per class. confidence: minimum score. EmbeddingError: the model fails, or its output is not that of a
        YOLO head."""
        whole = checked(image, 0)
        try:
            given = blob([whole], self.height, self.width, self._dtype)
            out, prototypes = map(np.asarray, self._session.run(self._outputs, {self._input: given}))
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise EmbeddingError(f"{self.name}: {reason_of(error)}") from None
        if len(prototypes) != 1:
            raise EmbeddingError(f"{self.name}: gives {prototypes.shape}, not masks (1, n, height, width)")
        rows = decode(out, confidence, self.name, prototypes.shape[1], len(self.kinds), self._end_to_end)
        h, w = whole.shape[:2]
        scale, _, (left, top) = placed(h, w, self.height, self.width)
        found = []
        for x0, y0, x1, y1, score, kind, *weights in rows:
            box = ((x0 - left) / scale, (y0 - top) / scale, (x1 - left) / scale, (y1 - top) / scale)
            mask = partial(self._mask, weights, prototypes[0], (h, w))
            found.append(Detection(box, score, self.kinds.get(int(kind), str(int(kind))), mask))
        return found

    def _mask(self, weights: list[float], prototypes: Array, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Where the weighted sum of prototypes (n, h, w) is positive, as a mask of the image's ``shape``. The
        prototypes cover the model's input."""
        h, w = shape
        _, size, (left, top) = placed(h, w, self.height, self.width)
        logits = np.tensordot(np.asarray(weights, np.float32), prototypes.astype(np.float32), 1)
        logits = np.nan_to_num(logits, nan=-1.0)
        whole = cv2.resize(logits, (self.width, self.height), interpolation=cv2.INTER_LINEAR)
        image = whole[top : top + size[1], left : left + size[0]]
        mask: NDArray[np.bool_] = cv2.resize(image, (w, h), interpolation=cv2.INTER_LINEAR) > 0.0
        return mask


def decode(
    output: NDArray[np.floating],
    confidence: float,
    name: str,
    coefficients: int,
    kinds: int = 0,
    end_to_end: bool | None = None,
) -> list[tuple[float, ...]]:
    """Decode a YOLO head's ``output`` in pixels of the model's input: (1, 4 + kinds + coefficients, cells) or its
    transpose, with center, size and a score per class; with an objectness before the scores; or end-to-end (1, boxes,
    6 + coefficients) with corners, score and class. The weights of the masks come last.

    name: the model's name in errors. kinds: number of classes that the model names, 0 if it names none. end_to_end:
    what its metadata say; None: nothing.
    Returns rows (left, top, right, bottom, score, kind, *coefficients), best score first, without those that
    are not finite or have no area. Raises EmbeddingError."""
    shaped = output.ndim == 3 and len(output) == 1
    if (
        shaped and end_to_end is None
    ):  # a raw head of two classes has as many columns, but scores where that has classes
        fits = output.shape[2] == 6 + coefficients and output.shape[1] <= tuned.NMS_BOXES and kinds != 2
        end_to_end = fits and _whole(output[0, :, 5])
    if not shaped or (not end_to_end and min(output.shape[1:]) < 5 + coefficients):
        raise EmbeddingError(
            f"{name}: gives {output.shape}, not the boxes and scores of a YOLO segmentation head; export it again: "
            f"{_EXPORT}"
        )
    # The longer axis holds the cells: our smallest model has 64 of them, with 8 numbers each.
    table = output[0].T if not end_to_end and output.shape[1] < output.shape[2] else output[0]
    table = table.astype(np.float64)
    end = table.shape[1] - coefficients
    if end_to_end:
        corners, scores, found = table[:, :4], table[:, 4:5], table[:, 5]
        right = end == 6 and _whole(found)
    else:
        half = table[:, 2:4] / 2
        corners = np.concatenate([table[:, :2] - half, table[:, :2] + half], axis=1)
        objectness = end == 5 + kinds and kinds > 0
        scores = table[:, 5:end] * table[:, 4:5] if objectness else table[:, 4:end]
        found = scores.argmax(axis=1).astype(np.float64)
        right = kinds in (0, scores.shape[1])
    if not right:
        raise EmbeddingError(
            f"{name}: gives {output.shape} with {coefficients} mask weights, which fits no head of {kinds} classes; "
            f"export it again: {_EXPORT}"
        )
    known = scores[np.isfinite(scores)]
    if known.size and not _SCORES[0] <= known.min() <= known.max() <= _SCORES[1]:
        raise EmbeddingError(
            f"{name}: its scores lie in {known.min():.3g} to {known.max():.3g}, not in 0 to 1: no head that is read; "
            f"export it again: {_EXPORT}"
        )
    most = np.abs(corners[np.isfinite(corners)]).max(initial=0.0)
    if not end_to_end and 0.0 < most <= 2.0:
        raise EmbeddingError(f"{name}: its boxes are not in pixels; export it again: {_EXPORT}")
    surest = scores.max(axis=1)
    sound = np.isfinite(table).all(axis=1) & (surest >= confidence) & (corners[:, 2:] > corners[:, :2]).all(axis=1)
    best = np.flatnonzero(sound)
    best = best[np.argsort(-surest[best], kind="stable")][: tuned.NMS_BOXES]
    rows = np.concatenate([corners, surest[:, None], found[:, None], table[:, end:]], axis=1)[best]
    if end_to_end or not len(rows):
        return [tuple(map(float, row)) for row in rows]
    rectangles = np.concatenate([rows[:, :2], rows[:, 2:4] - rows[:, :2]], axis=1)
    classes = rows[:, 5].astype(int).tolist()
    kept = cv2.dnn.NMSBoxesBatched(rectangles.tolist(), rows[:, 4].tolist(), classes, 0.0, tuned.NMS_IOU)
    return [tuple(map(float, rows[k])) for k in sorted(int(i) for i in kept)]


def _whole(values: NDArray[np.floating]) -> bool:
    known = values[np.isfinite(values)]
    return bool((known == np.rint(known)).all())


def _end_to_end(meta: dict[str, str]) -> bool | None:
    """Whether the exporter's metadata say that the model suppresses boxes by itself; None if they say nothing."""
    says = [meta.get("end2end"), _literal(meta, "args", dict).get("nms")]
    if not any(each is not None for each in says):
        return None
    return any(str(each).lower() == "true" for each in says)


def _kinds(meta: dict[str, str]) -> dict[int, str]:
    """Class names from the exporter's metadata, a mapping or a list; empty without them."""
    listed = _literal(meta, "names", list)
    try:
        named = dict(enumerate(listed)) or _literal(meta, "names", dict)
        return {int(k): str(v) for k, v in named.items()}
    except (ValueError, TypeError):
        return {}


def _literal(meta: dict[str, str], key: str, kind: Any) -> Any:
    """The value of a metadata text if it is of a kind, else an empty one."""
    try:
        value = ast.literal_eval(meta[key])
    except (KeyError, ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return kind()
    return value if isinstance(value, kind) else kind()
