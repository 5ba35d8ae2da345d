"""Trains the detector. A checkpoint is written after every epoch, from which a stopped run resumes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edge_server.experiments.training.detector.dataset import LabeledImages
from edge_server.experiments.training.detector.loss import detection_loss
from edge_server.experiments.training.detector.network import Detector
from edge_server.experiments.training.detector.scenes import KINDS, MIN_SIDE_PX, Boxes

BATCH = 32
WARMUP_STEPS = 100
# The exported weights are an average over about this many steps.
AVERAGED_STEPS = 300


class CheckpointError(ValueError):
    """The checkpoint does not belong to this run; the message says which setting differs."""


@dataclass(frozen=True)
class Settings:
    """Settings that determine the weights bit for bit; also threads, because they split sums.

    side: width and height of the images.
    """

    seed: int = 0
    side: int = 128
    worlds: int = 400
    epochs: int = 18
    rate: float = 2e-3
    threads: int = 1


def train(dataset: LabeledImages, settings: Settings, checkpoint: Path) -> tuple[Detector, list[dict[str, Any]]]:
    """Train, or resume from ``checkpoint``.

    Returns the averaged detector in eval mode, and a row of losses per epoch. Raises CheckpointError if the
    checkpoint has other settings, FloatingPointError if the loss diverges.
    """
    torch.set_num_threads(settings.threads)
    torch.use_deterministic_algorithms(True)
    torch.manual_seed(settings.seed)
    # The memory format channels_last saves a quarter of the time per step.
    model = Detector(len(KINDS))
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's own types
    averaged = Detector(len(KINDS)).eval()
    averaged.load_state_dict(model.state_dict())
    optimizer = torch.optim.AdamW(model.parameters(), settings.rate, weight_decay=0.02)
    parts = {"model": model, "averaged": averaged, "optimizer": optimizer}
    log = _resume(checkpoint, settings, parts)
    per_epoch = len(dataset) // BATCH
    for epoch in range(len(log), settings.epochs):
        began, sums = time.perf_counter(), np.zeros(2)
        model.train()
        for k, (images, truths) in enumerate(_batches(dataset, settings, epoch)):
            step = epoch * per_epoch + k
            for group in optimizer.param_groups:
                group["lr"] = settings.rate * _schedule(step, settings.epochs * per_epoch)
            losses = detection_loss(model.raw(images), truths)
            optimizer.zero_grad(set_to_none=True)
            (losses[0] + losses[1]).backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
            optimizer.step()
            _average(averaged, model, step)
            sums += [float(loss.detach()) for loss in losses]
        score_loss, box_loss = (round(float(v), 5) for v in sums / per_epoch)
        if not math.isfinite(score_loss + box_loss):
            raise FloatingPointError(f"the loss of epoch {epoch + 1} is not finite; lower the rate")
        seconds = round(time.perf_counter() - began, 1)
        log.append({"epoch": epoch + 1, "score_loss": score_loss, "box_loss": box_loss, "seconds": seconds})
        _save(checkpoint, settings, parts, log)
        left_s = seconds * (settings.epochs - epoch - 1)
        words = f"epoch {epoch + 1} of {settings.epochs}, loss {score_loss:.3f} + {box_loss:.3f}"
        print(f"  training: {words}; {left_s:.0f} s left", flush=True)
    return averaged, log


def _schedule(step: int, steps: int) -> float:
    """Factor of the learning rate: a short warm-up, then half a cosine down to a hundredth."""
    warm = min(1.0, (step + 1) / WARMUP_STEPS)
    return warm * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * step / max(1, steps))))


def _average(averaged: Detector, model: Detector, step: int) -> None:
    keep = min(1.0 - 1.0 / AVERAGED_STEPS, (1.0 + step) / (10.0 + step))
    with torch.no_grad():
        for a, b in zip(averaged.state_dict().values(), model.state_dict().values()):
            if a.dtype.is_floating_point:
                a.mul_(keep).add_(b, alpha=1.0 - keep)
            else:
                a.copy_(b)


def _resume(checkpoint: Path, settings: Settings, parts: dict[str, Any]) -> list[dict[str, Any]]:
    """Load what ``_save`` wrote into ``parts``; returns the log so far."""
    if not checkpoint.is_file():
        return []
    kept = _read(checkpoint)
    known = kept["settings"]
    for key, value in asdict(settings).items():
        if known.get(key) != value:
            raise CheckpointError(
                f"{checkpoint}: was trained with {key} {known.get(key)}, not {value}: go on alike, delete "
                "it, or name another --out"
            )
    for name, part in parts.items():
        part.load_state_dict(kept[name])
    log: list[dict[str, Any]] = kept["log"]
    return log


def _read(checkpoint: Path) -> dict[str, Any]:
    """Read a checkpoint. Raises CheckpointError."""
    try:
        kept: dict[str, Any] = torch.load(checkpoint, weights_only=True)
        kept["settings"], kept["averaged"]
    except Exception as error:  # torch's reader raises any kind of exception
        raise CheckpointError(f"{checkpoint}: cannot be read ({error})") from None
    return kept


def _save(checkpoint: Path, settings: Settings, parts: dict[str, Any], log: list[dict[str, Any]]) -> None:
    new = checkpoint.with_suffix(".part")
    states = {name: part.state_dict() for name, part in parts.items()}
    torch.save({"settings": asdict(settings), "log": log, **states}, new)
    new.replace(checkpoint)


def _batches(dataset: LabeledImages, settings: Settings, epoch: int) -> Iterator[tuple[Tensor, list[Tensor]]]:
    """Augmented batches of one epoch, images and boxes, which depend only on seed and epoch."""
    order = np.random.default_rng([settings.seed, epoch]).permutation(len(dataset))
    for first in range(0, len(dataset) - BATCH + 1, BATCH):
        images, truths = [], []
        for i in order[first : first + BATCH]:
            rng = np.random.default_rng([settings.seed, epoch, int(i)])
            image, boxes = augmented(dataset.images[i], dataset.boxes[i], rng)
            images.append(image)
            truths.append(torch.from_numpy(boxes))
        yield torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2), truths


def augmented(image: NDArray[np.uint8], boxes: Boxes, rng: np.random.Generator) -> tuple[NDArray[np.float32], Boxes]:
    """Randomly augment an image (side, side, 3), returned in [0, 1], and its boxes: mirrored, scaled,
    shifted, with a random exposure and tint, sometimes blurred or noisy."""
    side = image.shape[0]
    boxes = boxes.copy()
    if rng.random() < 0.5:
        image = image[:, ::-1]
        boxes[:, [0, 2]] = side - boxes[:, [2, 0]]
    if rng.random() < 0.7:
        scale = rng.uniform(0.7, 1.4)
        shift = (1.0 - scale) * side / 2 + rng.uniform(-0.15, 0.15, 2) * side
        warp = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
        image = np.asarray(
            cv2.warpAffine(np.ascontiguousarray(image), warp, (side, side), borderValue=(114, 114, 114)), np.uint8
        )
        before = np.maximum(boxes[:, 2:4] - boxes[:, :2], 1.0).prod(axis=1)
        boxes[:, :4] = boxes[:, :4] * scale + np.tile(shift, 2)
        boxes[:, :4] = boxes[:, :4].clip(0, side)
        size = boxes[:, 2:4] - boxes[:, :2]
        # Boxes that are mostly cut off are dropped.
        kept = (size.min(axis=1, initial=float(side)) >= MIN_SIDE_PX) & (size.prod(axis=1) > 0.25 * before * scale**2)
        boxes = boxes[kept]
    out = image.astype(np.float32) / 255.0
    out = out * rng.uniform(0.6, 1.4) * rng.uniform(0.85, 1.15, 3).astype(np.float32) + rng.uniform(-0.08, 0.08)
    if rng.random() < 0.2:
        out = np.asarray(cv2.GaussianBlur(out, (0, 0), rng.uniform(0.3, 1.2)))
    if rng.random() < 0.3:
        out = out + rng.normal(0.0, rng.uniform(0.005, 0.04), out.shape)
    return np.clip(out, 0.0, 1.0).astype(np.float32), boxes.astype(np.float32)
