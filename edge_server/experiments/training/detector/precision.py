"""Average precision of a detector as COCO defines it (pycocotools), for any model with YOLO's output."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.training.detector.dataset import LabeledImages, network_inputs
from edge_server.experiments.training.detector.export import Run
from edge_server.experiments.training.detector.scenes import KINDS

MIN_SCORE, NMS_IOU, MAX_DETECTIONS = 0.001, 0.6, 100
_BATCH = 32


def measure(run: Run, dataset: LabeledImages) -> dict[str, Any]:
    """Average precisions over ``dataset``: {map50, map50_95, by_kind: {kind: {ap50, ap50_95, true}}, images}."""
    found = [detections(out) for part in network_inputs(dataset.images, _BATCH) for out in run(part)]
    return average_precision(found, [np.asarray(boxes, np.float64) for boxes in dataset.boxes])


def detections(output: NDArray[np.float32]) -> NDArray[np.float64]:
    """Decode one image's output0 (4 + kinds, cells). Returns (n, 6): left, top, right, bottom, score, kind;
    best score first, after non-maximum suppression per kind."""
    center, size, scores = output[:2].T, output[2:4].T, output[4:].T
    cells, kinds = np.nonzero(scores > MIN_SCORE)
    if not len(cells):
        return np.zeros((0, 6))
    low = (center - size / 2)[cells].astype(np.float64)
    best = scores[cells, kinds].astype(np.float64)
    rectangles = np.concatenate([low, size[cells]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(rectangles.tolist(), best.tolist(), kinds.tolist(), MIN_SCORE, NMS_IOU)
    rows = np.concatenate([low, low + size[cells], best[:, None], kinds[:, None]], axis=1)
    rows = rows[np.asarray(kept, dtype=np.intp)]
    return np.asarray(rows[np.argsort(-rows[:, 4], kind="stable")][:MAX_DETECTIONS])


def average_precision(found: list[NDArray[np.float64]], true: list[NDArray[np.float64]]) -> dict[str, Any]:
    """As ``measure``. found: for each image (n, 6) as from ``detections``. true: for each image (m, 5): box, kind."""
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    boxes = [(image, row) for image, rows in enumerate(true) for row in rows]
    with contextlib.redirect_stdout(io.StringIO()):  # it says what it does
        truth = COCO()
        truth.dataset = {
            "images": [{"id": image} for image in range(len(true))],
            "categories": [{"id": kind} for kind in range(len(KINDS))],
            "annotations": [
                {"id": number, "iscrowd": 0, "area": float(np.prod(row[2:4] - row[:2])), **_annotation(image, row)}
                for number, (image, row) in enumerate(boxes, 1)
            ],
        }
        truth.createIndex()
        results = [
            {**_annotation(image, np.append(row[:4], row[5])), "score": float(row[4])}
            for image, rows in enumerate(found)
            for row in rows
        ]
        by_kind = {}
        if results:
            evaluation = COCOeval(truth, truth.loadRes(results), "bbox")
            evaluation.evaluate()
            evaluation.accumulate()
            precision = evaluation.eval["precision"][:, :, :, 0, -1]  # (IoUs, recalls, kinds): all sizes, most boxes
    for k, kind in enumerate(KINDS):
        if total := sum(int(row[4]) == k for _, row in boxes):
            of_kind = precision[:, :, k] if results else np.zeros((1, 1))
            row = {"ap50": float(of_kind[0].mean()), "ap50_95": float(of_kind.mean()), "true": total}
            by_kind[kind] = row
    return {
        "map50": float(np.mean([row["ap50"] for row in by_kind.values()])),
        "map50_95": float(np.mean([row["ap50_95"] for row in by_kind.values()])),
        "by_kind": by_kind,
        "images": len(true),
    }


def _annotation(image: int, row: NDArray[np.float64]) -> dict[str, Any]:
    """row: left, top, right, bottom, kind."""
    left, top, right, bottom, kind = map(float, row)
    return {"image_id": image, "category_id": int(kind), "bbox": [left, top, right - left, bottom - top]}
