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

Parameters = dict[str, Tensor]


class Network:
    """Distances by AlexNet. Stateless once built, so that threads may share it.

    parameters: its arrays by name.
    lin: one vector of channel weights (C,) per slice.
    """

    def __init__(self, parameters: Mapping[str, NDArray[np.float32]], lin: Sequence[NDArray[np.float32]]) -> None:
        self._parameters = {key: torch.from_numpy(array) for key, array in parameters.items()}
        self._lin = [torch.from_numpy(each) for each in lin]

    def distances(
        self, renderings: NDArray, truths: NDArray, masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Distances (N,) of image pairs (N, H, W, 3), floating in [0, 1]. masks: (N, H, W), the weights of pixels in
        the averages; None: all weigh the same."""
        n = len(renderings)
        with torch.inference_mode(), one_torch_thread():
            x = np.concatenate([renderings, truths]).astype(np.float32).transpose(0, 3, 1, 2)
            pixels = torch.from_numpy(np.ascontiguousarray(x)) * 2.0 - 1.0
            pixels = (pixels - torch.tensor(SHIFT).view(1, 3, 1, 1)) / torch.tensor(SCALE).view(1, 3, 1, 1)
            total = torch.zeros(n, dtype=torch.float64)
            for features, lin in zip(_slices(self._parameters, pixels), self._lin):
                unit = features / (features.square().sum(1, keepdim=True).sqrt() + EPSILON)
                weighted = (unit[:n] - unit[n:]).square() * lin.view(1, -1, 1, 1)
                total += _mean(weighted.double().sum(1), masks)
        found: NDArray[np.float64] = total.numpy()
        return found


def _mean(values: Tensor, masks: NDArray[np.bool_] | None) -> Tensor:
    """Mean (N,) of ``values`` (N, h, w), weighted by the share of ``masks`` (N, H, W) in each cell."""
    if masks is None:
        return values.mean((1, 2))
    _, height, width = values.shape
    shares = F.adaptive_avg_pool2d(torch.from_numpy(masks.astype(np.float64)), (height, width))
    return (values * shares).sum((1, 2)) / shares.sum((1, 2))


def _slices(p: Parameters, x: Tensor) -> list[Tensor]:
    """AlexNet after each of its five rectified convolutions; x (N, 3, H, W)."""

    def conv(name: str, x: Tensor, stride: int, padding: int) -> Tensor:
        return F.relu(F.conv2d(x, p[f"{name}.weight"], p[f"{name}.bias"], stride, padding))

    a = conv("0", x, 4, 2)
    b = conv("3", F.max_pool2d(a, 3, 2), 1, 2)
    c = conv("6", F.max_pool2d(b, 3, 2), 1, 1)
    d = conv("8", c, 1, 1)
    e = conv("10", d, 1, 1)
    return [a, b, c, d, e]
