"""Measures the quality of masks, with the code that a deployment runs (``edge_server.foreground``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.training.detector.dataset import LabeledImages
from edge_server.foreground import ForegroundConfig
from edge_server.foreground.foreground import make_foreground

Mask = NDArray[np.bool_]


def measure_masks(model: Path, dataset: LabeledImages) -> dict[str, Any]:
    """Measure the masks of a model.

    found: share of the images with the object in which it is found; None without such images.
    iou, iou_p10, iou_least: mean, tenth percentile and least IoU with the true mask, over these.
    false_alarms: share of the images without the object in which something is found; None without such
        images.
    """
    assert dataset.masks is not None
    cut = make_foreground(ForegroundConfig(detector=str(model)))
    ious, shown, alarms = [], 0, 0
    for image, mask, boxes in zip(dataset.images, dataset.masks, dataset.boxes):
        found = found_mask(cut.apply("", image), cut.counts.full_mask > 0)
        cut.counts.full_mask = 0
        if len(boxes):
            shown += 1
            if found is not None:
                ious.append(iou(found, mask))
        elif not mask.any():
            alarms += found is not None
    empty = sum(not mask.any() for mask in dataset.masks)
    return {
        "images": shown,
        "found": len(ious) / shown if shown else None,
        "iou": float(np.mean(ious)) if ious else None,
        "iou_p10": float(np.percentile(ious, 10)) if ious else None,
        "iou_least": min(ious, default=None),
        "empty_images": empty,
        "false_alarms": alarms / empty if empty else None,
    }


def found_mask(image: NDArray[np.uint8], full: bool) -> Mask | None:
    """The pixels (H, W) that a cut image still shows; None if it was passed on whole because nothing was
    found. full: whether the whole image was found to be the object."""
    if image.shape[2] == 4:
        return np.asarray(image[..., 3] > 0)
    return np.ones(image.shape[:2], np.bool_) if full else None


def iou(a: Mask, b: Mask) -> float:
    """Intersection over union of two masks (H, W)."""
    return float((a & b).sum() / max(int((a | b).sum()), 1))
