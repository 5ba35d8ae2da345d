"""Learned perceptual image patch similarity, thesis (3.34) and (3.35), as Zhang et al. published it (v0.1).

Features after each slice of a frozen ImageNet network are normalized over channels, their squared
difference is weighted by the learned (not squared) channel weights, averaged over pixels and summed over
slices. The thesis's (3.35) squares the weights and does not mention the normalization; papers and tools
report the published network, and so does this. Distances are comparable only within one network, hence
``Lpips.network`` accompanies every figure.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from edge_server.fidelity.images import ImageError, same_size, to_unit

# ImageNet's statistics, restated by the authors for inputs in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPSILON = 1e-10
# Smaller images leave a pooling layer of the network without input.
MINIMUM_SIDE = {"alex": 31, "squeeze": 17}

Parameters = dict[str, Tensor]
Slices = Callable[[Parameters, Tensor], list[Tensor]]


class Lpips:
    """LPIPS of one network on the CPU. Stateless once built, so that threads may share it."""

    def __init__(self, network: str, features: Path, lin: Path) -> None:
        """network: "alex" or "squeeze"; features, lin: npz files (see ``lpips_weights``).

        Raises KeyError or ValueError naming the array that is absent or has a wrong shape.
        """
        self.network = network
        self.minimum_side = MINIMUM_SIDE[network]
        self._slices: Slices = {"alex": _alex_slices, "squeeze": _squeeze_slices}[network]
        self._parameters = {
            name.removeprefix("features."): torch.from_numpy(array)
            for name, array in _arrays(features).items()
        }
        lins = _arrays(lin)
        self._lin = [torch.from_numpy(lins[f"lin{i}"].reshape(-1)) for i in range(len(lins))]
        self._check()

    def __call__(self, rendering: NDArray, truth: NDArray) -> float:
        """Distance of two images as ``images.to_unit`` takes them: 0 for equal ones, about 1 for unrelated
        ones.

        Raises ImageError where a side is shorter than ``minimum_side``.
        """
        a, b = to_unit(rendering, "rendering"), to_unit(truth, "truth")
        same_size(a, b)
        return float(self.batch(a[None], b[None])[0])

    def batch(self, renderings: NDArray, truths: NDArray) -> NDArray[np.float64]:
        """Distances (N,) of image pairs (N, H, W, 3), floating in [0, 1], finite."""
        if renderings.shape != truths.shape or renderings.ndim != 4 or renderings.shape[3] != 3:
            raise ImageError(f"expected two (N, H, W, 3) stacks, got {renderings.shape} and {truths.shape}")
        height, width = renderings.shape[1:3]
        if min(height, width) < self.minimum_side:
            raise ImageError(
                f"LPIPS-{self.network} needs images of at least {self.minimum_side} x {self.minimum_side} "
                f"pixels, got {width} x {height}"
            )
        n = len(renderings)
        with torch.inference_mode():
            x = np.concatenate([renderings, truths]).astype(np.float32).transpose(0, 3, 1, 2)
            pixels = torch.from_numpy(np.ascontiguousarray(x)) * 2.0 - 1.0
            pixels = (pixels - torch.tensor(SHIFT).view(1, 3, 1, 1)) / torch.tensor(SCALE).view(1, 3, 1, 1)
            total = torch.zeros(n, dtype=torch.float64)
            for features, lin in zip(self._slices(self._parameters, pixels), self._lin):
                unit = features / (features.square().sum(1, keepdim=True).sqrt() + EPSILON)
                weighted = (unit[:n] - unit[n:]).square() * lin.view(1, -1, 1, 1)
                total += weighted.double().sum(1).mean((1, 2))
        distances: NDArray[np.float64] = total.numpy()
        if not np.isfinite(distances).all():
            raise ImageError("LPIPS is not finite: an image holds NaN, infinity or values far outside [0, 1]")
        return distances

    def _check(self) -> None:
        """Run a tiny image through the network to find missing and misshapen arrays before the first
        score."""
        side = self.minimum_side
        with torch.inference_mode():
            try:
                slices = self._slices(self._parameters, torch.zeros(1, 3, side, side))
            except RuntimeError as error:
                raise ValueError(f"an array has a wrong shape: {str(error).splitlines()[0]}") from error
        widths, expected = [len(lin) for lin in self._lin], [s.shape[1] for s in slices]
        if widths != expected:
            raise ValueError(f"learned weights have widths {widths}, the network's slices {expected}")
        tensors = [*self._parameters.values(), *self._lin]
        if not all(torch.isfinite(t).all() for t in tensors):
            raise ValueError("an array holds NaN or infinity")


def _arrays(path: Path) -> dict[str, NDArray[np.float32]]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: np.ascontiguousarray(archive[name], dtype=np.float32) for name in archive.files}


def _alex_slices(p: Parameters, x: Tensor) -> list[Tensor]:
    """AlexNet after each of its five rectified convolutions; x (N, 3, H, W)."""

    def conv(name: str, x: Tensor, stride: int, padding: int) -> Tensor:
        return F.relu(F.conv2d(x, p[f"{name}.weight"], p[f"{name}.bias"], stride, padding))

    a = conv("0", x, 4, 2)
    b = conv("3", F.max_pool2d(a, 3, 2), 1, 2)
    c = conv("6", F.max_pool2d(b, 3, 2), 1, 1)
    d = conv("8", c, 1, 1)
    e = conv("10", d, 1, 1)
    return [a, b, c, d, e]


def _squeeze_slices(p: Parameters, x: Tensor) -> list[Tensor]:
    """SqueezeNet 1.1 after modules 1, 4, 7, 9, 10, 11 and 12; x (N, 3, H, W)."""

    def conv(name: str, x: Tensor, stride: int = 1, padding: int = 0) -> Tensor:
        return F.relu(F.conv2d(x, p[f"{name}.weight"], p[f"{name}.bias"], stride, padding))

    def fire(name: str, x: Tensor) -> Tensor:
        s = conv(f"{name}.squeeze", x)
        return torch.cat([conv(f"{name}.expand1x1", s), conv(f"{name}.expand3x3", s, 1, 1)], 1)

    def pool(x: Tensor) -> Tensor:
        return F.max_pool2d(x, 3, 2, ceil_mode=True)

    a = conv("0", x, 2)
    b = fire("4", fire("3", pool(a)))
    c = fire("7", fire("6", pool(b)))
    d = fire("9", pool(c))
    e = fire("10", d)
    f = fire("11", e)
    g = fire("12", f)
    return [a, b, c, d, e, f, g]
