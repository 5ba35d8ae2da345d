"""Average precision of a detector as defined by COCO, for any model with YOLO's output."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.training.detector.dataset import LabeledImages, network_inputs
from edge_server.experiments.training.detector.scenes import KINDS

Array = NDArray[np.float64]

IOUS = np.arange(0.5, 0.96, 0.05)
RECALLS = np.linspace(0.0, 1.0, 101)
MIN_SCORE, NMS_IOU, MAX_DETECTIONS = 0.001, 0.6, 100
_BATCH = 32

Run = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Images (n, 3, H, W) in [0, 1] -> output0 (n, 4 + kinds, cells)."""


def measure(run: Run, dataset: LabeledImages, kinds: Sequence[str] = KINDS) -> dict[str, Any]:
    """Measure average precisions over ``dataset``: {map50, map50_95, by_kind: {kind: {ap50, ap50_95, true}},
    images}."""
    found: list[Array] = []
    for part in network_inputs(dataset.images, _BATCH):
        found += [detections(out[: 4 + len(kinds)]) for out in run(part)]
    by_kind = {}
    for k, kind in enumerate(kinds):
        true = [b[b[:, 4] == k, :4].astype(np.float64) for b in dataset.boxes]
        of_kind = [d[d[:, 5] == k, :5] for d in found]
        if total := sum(map(len, true)):
            ap = average_precision(of_kind, true)
            by_kind[kind] = {"ap50": float(ap[0]), "ap50_95": float(ap.mean()), "true": total}
    return {
        "map50": float(np.mean([row["ap50"] for row in by_kind.values()])),
        "map50_95": float(np.mean([row["ap50_95"] for row in by_kind.values()])),
        "by_kind": by_kind,
        "images": len(dataset),
    }


def detections(output: NDArray[np.float32]) -> Array:
    """Decode one image's output0 (4 + kinds, cells). Returns (n, 6): left, top, right, bottom, score, kind;
    best score first, after non-maximum suppression per kind."""
    centre, size, scores = output[:2].T, output[2:4].T, output[4:].T
    cells, kinds = np.nonzero(scores > MIN_SCORE)
    if not len(cells):
        return np.zeros((0, 6))
    low = (centre - size / 2)[cells].astype(np.float64)
    best = scores[cells, kinds].astype(np.float64)
    rectangles = np.concatenate([low, size[cells]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(rectangles.tolist(), best.tolist(), kinds.tolist(), MIN_SCORE, NMS_IOU)
    rows = np.concatenate([low, low + size[cells], best[:, None], kinds[:, None]], axis=1)
    rows = rows[np.asarray(kept, dtype=np.intp)]
    return np.asarray(rows[np.argsort(-rows[:, 4], kind="stable")][:MAX_DETECTIONS])


def average_precision(found: Sequence[Array], true: Sequence[Array], ious: Array = IOUS) -> Array:
    """Average precision (len(ious),) of one kind, interpolated at 101 recalls; NaN without a true box. Of two
    detections of one object, the one with the lower score is false.

    found: for each image, boxes with scores (n, 5).
    true: for each image, boxes (m, 4).
    """
    total = sum(map(len, true))
    if not total:
        return np.full(len(ious), np.nan)
    scores = np.concatenate([f[:, 4] for f in found])
    if not len(scores):
        return np.zeros(len(ious))
    hits = np.concatenate([_matches(f, t, ious) for f, t in zip(found, true)])
    order = np.argsort(-scores, kind="stable")
    good = np.cumsum(hits[order], axis=0)
    count = np.arange(1, len(order) + 1)[:, None]
    recall, precision = good / total, good / count
    # Precision at a recall is the best at that recall or any higher one.
    precision = np.maximum.accumulate(precision[::-1], axis=0)[::-1]
    out = np.zeros(len(ious))
    for k in range(len(ious)):
        at = np.searchsorted(recall[:, k], RECALLS, side="left")
        out[k] = precision[np.minimum(at, len(order) - 1), k][at < len(order)].sum() / len(RECALLS)
    return out


def _matches(found: Array, true: Array, ious: Array) -> NDArray[np.bool_]:
    """Whether each detection is a true positive at each IoU, (n, len(ious)): the detection with the highest
    score that has at least this IoU with a true box."""
    hits = np.zeros((len(found), len(ious)), dtype=np.bool_)
    if not len(found) or not len(true):
        return hits
    overlap = box_iou(found[:, :4], true)
    taken = np.zeros((len(true), len(ious)), dtype=np.bool_)
    for i in np.argsort(-found[:, 4], kind="stable"):
        for k, least in enumerate(ious):
            free = np.where(taken[:, k], -1.0, overlap[i])
            j = int(np.argmax(free))
            if free[j] >= least:
                taken[j, k] = hits[i, k] = True
    return hits


def box_iou(a: Array, b: Array) -> Array:
    """Intersection over union (n, m) of boxes (n, 4) and (m, 4): left, top, right, bottom."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    both = np.clip(high - low, 0.0, None).prod(axis=2)
    area_a, area_b = (np.clip(x[:, 2:] - x[:, :2], 0.0, None).prod(axis=1) for x in (a, b))
    return np.asarray(both / np.maximum(area_a[:, None] + area_b[None] - both, 1e-12))
