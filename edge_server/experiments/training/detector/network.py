"""A small detector of the YOLOv8 family: cross-stage backbone, one step of neck, anchor-free heads.

Modules have the family's names (``model.N``), so the exported graph looks like others of the family.
Rectifiers replace SiLU, because ONNX Runtime fuses them into the convolutions, and 8 bits represent them
better.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

STRIDES = (8, 16)
WIDTHS = (16, 24, 48, 80)


class Conv(nn.Module):
    """Convolution, batch normalization (folded into it at export), rectifier."""

    def __init__(self, c_in: int, c_out: int, kernel: int = 1, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(c_in, c_out, kernel, stride, kernel // 2, bias=False)
        self.bn = nn.BatchNorm2d(c_out)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class C2f(nn.Module):
    """Cross-stage block: half of the channels bypass ``n`` residual pairs, and all stages are
    concatenated."""

    def __init__(self, c_in: int, c_out: int, n: int = 1, residual: bool = True) -> None:
        super().__init__()
        self.width = c_out // 2
        self.residual = residual
        self.cv1 = Conv(c_in, c_out)
        self.cv2 = Conv((2 + n) * self.width, c_out)
        self.m = nn.ModuleList(
            nn.Sequential(Conv(self.width, self.width, 3), Conv(self.width, self.width, 3)) for _ in range(n)
        )

    def forward(self, x: Tensor) -> Tensor:
        stages = list(self.cv1(x).split(self.width, 1))
        for block in self.m:
            y = block(stages[-1])
            stages.append(stages[-1] + y if self.residual else y)
        return self.cv2(torch.cat(stages, 1))


class SPPF(nn.Module):
    """Spatial pyramid pooling: the map and three poolings of 5 x 5 in a row."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.cv1 = Conv(channels, channels // 2)
        self.cv2 = Conv(channels * 2, channels)

    def forward(self, x: Tensor) -> Tensor:
        stages = [self.cv1(x)]
        for _ in range(3):
            stages.append(F.max_pool2d(stages[-1], 5, 1, 2))
        return self.cv2(torch.cat(stages, 1))


class Head(nn.Module):
    """Head of one map: distances to the four sides of the box in strides, and scores of the kinds as logits."""

    def __init__(self, channels: int, kinds: int) -> None:
        super().__init__()
        self.box = nn.Sequential(Conv(channels, 32, 3), nn.Conv2d(32, 4, 1))
        self.score = nn.Sequential(Conv(channels, 32, 3), nn.Conv2d(32, kinds, 1))
        nn.init.constant_(self.score[1].bias, -4.6)  # type: ignore[arg-type]  # one cell in a hundred holds something

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return F.softplus(self.box(x)), self.score(x)


class Detector(nn.Module):
    """Images (B, 3, H, W) in [0, 1], sides multiples of 16, -> output0 (B, 4 + kinds, cells): center, width
    and height in pixels and a score for each kind, as in every detector of the family."""

    def __init__(self, kinds: int) -> None:
        super().__init__()
        a, b, c, d = WIDTHS
        self.kinds = kinds
        self.model = nn.ModuleList(
            [
                Conv(3, a, 3, 2),
                Conv(a, b, 3, 2),
                C2f(b, b),
                Conv(b, c, 3, 2),
                C2f(c, c, 2),
                Conv(c, d, 3, 2),
                C2f(d, d),
                SPPF(d),
                nn.Upsample(scale_factor=2, mode="nearest"),
                C2f(c + d, c, residual=False),
                Head(c, kinds),
                Head(d, kinds),
            ]
        )

    def raw(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Boxes (B, cells, 4) as left, top, right, bottom in pixels, logits (B, cells, kinds), and the cells'
        centers and strides (cells, 3)."""
        m = self.model
        fine = m[4](m[3](m[2](m[1](m[0](x)))))
        coarse = m[7](m[6](m[5](fine)))
        fine = m[9](torch.cat([m[8](coarse), fine], 1))
        boxes, logits, cells = [], [], []
        for head, stride, feature in ((m[10], STRIDES[0], fine), (m[11], STRIDES[1], coarse)):
            side, score = head(feature)
            centre = _cells(feature, stride)
            side = side.flatten(2).transpose(1, 2) * stride
            boxes.append(torch.cat([centre[:, :2] - side[..., :2], centre[:, :2] + side[..., 2:]], 2))
            logits.append(score.flatten(2).transpose(1, 2))
            cells.append(centre)
        return torch.cat(boxes, 1), torch.cat(logits, 1), torch.cat(cells)

    def forward(self, x: Tensor) -> Tensor:
        boxes, logits, _ = self.raw(x)
        low, high = boxes[..., :2], boxes[..., 2:]
        return torch.cat([(low + high) / 2, high - low, logits.sigmoid()], 2).transpose(1, 2)


def _cells(feature: Tensor, stride: int) -> Tensor:
    """Centers x, y in pixels and the stride (cells, 3) of a map's cells, row by row."""
    height, width = feature.shape[2:]
    y = (torch.arange(height, device=feature.device, dtype=torch.float32) + 0.5) * stride
    x = (torch.arange(width, device=feature.device, dtype=torch.float32) + 0.5) * stride
    xy = torch.stack([x.repeat(height), y.view(-1, 1).expand(-1, width).reshape(-1)], 1)
    return torch.cat([xy, torch.full_like(xy[:, :1], float(stride))], 1)


def parameters(model: nn.Module) -> int:
    """Number of learned parameters of a network."""
    return sum(p.numel() for p in model.parameters())
