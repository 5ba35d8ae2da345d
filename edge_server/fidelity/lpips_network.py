"""The frozen network behind LPIPS, in torch: apart from ``lpips``, so that an edge with weights starts
without torch, which takes two seconds to import."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from edge_server.torch_threads import one_torch_thread

# ImageNet's statistics, restated by the authors for inputs in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPSILON = 1e-10


def distance(
    parameters: Mapping[str, NDArray[np.float32]],
    lins: Sequence[NDArray[np.float32]],
    rendering: NDArray,
    truth: NDArray,
    mask: NDArray[np.bool_] | None = None,
) -> float:
    """Distance of two images (H, W, 3), floating in [0, 1].

    parameters: AlexNet's arrays by name. lins: a vector of channel weights (C,) per slice.
    mask: (H, W), outside which both are black, and by whose share in each cell it counts; None: all count the same.
    ValueError: the mask is empty.
    """
    if mask is not None and not mask.any():
        raise ValueError("the mask leaves no pixel to compare")
    pair = np.stack([rendering, truth])
    with torch.inference_mode(), one_torch_thread():
        shares = None if mask is None else torch.from_numpy(mask[None].astype(np.float64))
        x = (pair if mask is None else pair * mask[..., None]).astype(np.float32).transpose(0, 3, 1, 2)
        pixels = torch.from_numpy(np.ascontiguousarray(x)) * 2.0 - 1.0
        pixels = (pixels - torch.tensor(SHIFT).view(1, 3, 1, 1)) / torch.tensor(SCALE).view(1, 3, 1, 1)
        total = 0.0
        for features, lin in zip(_slices({k: torch.from_numpy(v) for k, v in parameters.items()}, pixels), lins):
            unit = features / (features.square().sum(1, keepdim=True).sqrt() + EPSILON)
            weighted = (unit[:1] - unit[1:]).square() * torch.from_numpy(lin).view(1, -1, 1, 1)
            values = weighted.double().sum(1)
            if shares is None:
                total += float(values.mean())
            else:
                cells = F.adaptive_avg_pool2d(shares, (values.shape[1], values.shape[2]))
                total += float((values * cells).sum() / cells.sum())
    return total


def _slices(p: Mapping[str, Tensor], x: Tensor) -> list[Tensor]:
    """AlexNet after each of its five rectified convolutions; x (N, 3, H, W)."""

    def conv(name: str, x: Tensor, stride: int, padding: int) -> Tensor:
        return F.relu(F.conv2d(x, p[f"{name}.weight"], p[f"{name}.bias"], stride, padding))

    a = conv("0", x, 4, 2)
    b = conv("3", F.max_pool2d(a, 3, 2), 1, 2)
    c = conv("6", F.max_pool2d(b, 3, 2), 1, 1)
    d = conv("8", c, 1, 1)
    e = conv("10", d, 1, 1)
    return [a, b, c, d, e]
