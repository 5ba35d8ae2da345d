"""Loss of the detector: task-aligned assignment (TOOD, Feng et al. 2021) as YOLOv8 uses it.

Each true box is assigned the cells inside it whose prediction has the highest score^a * overlap^b. These
cells learn the box (generalized IoU) and, as their score, the alignment.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

TOP_CELLS = 10
SCORE_POWER, OVERLAP_POWER = 0.5, 6.0
BOX_WEIGHT = 5.0


def overlaps(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """(IoU, generalized IoU) of boxes (..., 4) given as left, top, right, bottom; shapes broadcast."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    both = (high - low).clamp(min=0).prod(-1)
    area_a = (a[..., 2:] - a[..., :2]).clamp(min=0).prod(-1)
    area_b = (b[..., 2:] - b[..., :2]).clamp(min=0).prod(-1)
    union = area_a + area_b - both + 1e-7
    hull_low, hull_high = torch.minimum(a[..., :2], b[..., :2]), torch.maximum(a[..., 2:], b[..., 2:])
    hull = (hull_high - hull_low).clamp(min=0).prod(-1) + 1e-7
    iou = both / union
    return iou, iou - (hull - union) / hull


def assign(boxes: Tensor, scores: Tensor, cells: Tensor, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Assign true boxes to the cells of one image.

    boxes: (A, 4), predicted. scores: (A, kinds), predicted. cells: (A, 3). truth: (G, 5).

    Returns the assigned cells (P,), the index of each one's true box (P,) and its score target (P,).
    """
    if not len(truth):
        none = torch.zeros(0, dtype=torch.long)
        return none, none, torch.zeros(0)
    true = truth[:, None, :4]
    centre = cells[None, :, :2]
    # Half a stride around a box counts as inside, because small boxes contain few cell centers.
    reach = cells[None, :, 2] * 0.5
    inside = ((centre - true[..., :2]).amin(-1) > -reach) & ((true[..., 2:] - centre).amin(-1) > -reach)
    iou = overlaps(boxes[None], true)[0]
    metric = scores[:, truth[:, 4].long()].T ** SCORE_POWER * iou**OVERLAP_POWER
    # At the start of training all overlaps are zero: the nearest cells of the nearest stride are assigned.
    size = (truth[:, 2:4] - truth[:, :2]).amax(1, keepdim=True)
    near = (centre - (true[..., :2] + true[..., 2:]) / 2).norm(dim=-1) / size
    fit = (torch.log2(size / (cells[None, :, 2] * 4.0))).abs()
    metric = torch.where(inside, metric + 1e-9 / (1.0 + near + fit), torch.zeros(()))
    best = metric.topk(min(TOP_CELLS, metric.shape[1]), dim=1)
    taken = torch.zeros_like(metric).scatter_(1, best.indices, (best.values > 0).float()) > 0
    aligned = torch.where(taken, metric, torch.zeros(()))
    # A cell of several boxes goes to the one with the largest overlap, among equals to the smallest.
    claim = torch.where(taken, iou + 1e-3 / size, torch.full_like(iou, -1.0))
    owner = claim.argmax(0)
    holds = (claim.amax(0) > 0).nonzero()[:, 0]
    which = owner[holds]
    own = aligned[which, holds]
    top = aligned.amax(1)[which]
    quality = torch.where(taken, iou, torch.zeros(())).amax(1)[which]
    return holds, which, (own / (top + 1e-12) * quality).detach()


def detection_loss(predicted: tuple[Tensor, Tensor, Tensor], truths: list[Tensor]) -> tuple[Tensor, Tensor]:
    """(score loss, box loss) of a batch.

    predicted: as from ``Detector.raw``.
    truths: (G, 5) each.
    """
    boxes, logits, cells = predicted
    target = torch.zeros_like(logits)
    box_loss = logits.sum() * 0.0
    total = torch.zeros(())
    for k, truth in enumerate(truths):
        with torch.no_grad():
            holds, which, score = assign(boxes[k], logits[k].sigmoid(), cells, truth)
        if not len(holds):
            continue
        target[k, holds, truth[which, 4].long()] = score
        _, generalised = overlaps(boxes[k, holds], truth[which, :4])
        box_loss = box_loss + ((1.0 - generalised) * score).sum()
        total = total + score.sum()
    score_loss = F.binary_cross_entropy_with_logits(logits, target, reduction="sum")
    total = total.clamp(min=1.0)
    return score_loss / total, BOX_WEIGHT * box_loss / total
