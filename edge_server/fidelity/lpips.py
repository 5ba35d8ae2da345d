"""Learned perceptual image patch similarity, thesis (3.34) and (3.35), as Zhang et al. published it (v0.1).

Features after each slice of a frozen ImageNet network are normalized over channels, their squared
difference is weighted by the learned (not squared) channel weights, averaged over pixels and summed over
slices. The thesis's (3.35) squares the weights and does not mention the normalization; papers and tools
report the published network, and so does this. Distances are comparable only within one network, hence
``Lpips.network`` accompanies every figure.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.images import ImageError, same_size, to_unit

if TYPE_CHECKING:
    from edge_server.fidelity.lpips_network import Network

# Smaller images leave a pooling layer of the network without input.
MINIMUM_SIDE = {"alex": 31, "squeeze": 17}
# Channels after each slice.
SLICES = {"alex": (64, 192, 384, 256, 256), "squeeze": (64, 128, 256, 384, 384, 512, 512)}
# Convolutions: channels out and in, and side of the kernel. Of SqueezeNet 1.1 each fire:
# squeezed, in, expanded.
_ALEX = {"0": (64, 3, 11), "3": (192, 64, 5), "6": (384, 192, 3), "8": (256, 384, 3), "10": (256, 256, 3)}
_FIRES = {
    "3": (16, 64, 64),
    "4": (16, 128, 64),
    "6": (32, 128, 128),
    "7": (32, 256, 128),
    "9": (48, 256, 192),
    "10": (48, 384, 192),
    "11": (64, 384, 256),
    "12": (64, 512, 256),
}


class Lpips:
    """LPIPS of one network on the CPU, which threads may share. torch is imported at the first distance."""

    def __init__(self, network: str, features: Path, lin: Path) -> None:
        """network: "alex" or "squeeze"; features, lin: npz files (see ``lpips_weights``).

        Raises KeyError or ValueError naming the array that is absent or has a wrong shape.
        """
        self.network = network
        self.minimum_side = MINIMUM_SIDE[network]
        self._parameters = {name.removeprefix("features."): array for name, array in _arrays(features).items()}
        lins = _arrays(lin)
        self._lin = [lins[f"lin{i}"].reshape(-1) for i in range(len(lins))]
        self._check()
        self._lock = threading.Lock()
        self._loaded: Network | None = None

    def __call__(self, rendering: NDArray, truth: NDArray) -> float:
        """Distance of two images as ``images.to_unit`` takes them: 0 for equal ones, about 1 for unrelated
        ones.

        Raises ImageError where a side is shorter than ``minimum_side``.
        """
        a, b = to_unit(rendering, "rendering"), to_unit(truth, "truth")
        same_size(a, b)
        return float(self.batch(a[None], b[None])[0])

    def batch(self, renderings: NDArray, truths: NDArray) -> NDArray[np.float64]:
        """Distances (N,) of image pairs (N, H, W, 3), floating in [0, 1], finite. Raises ImageError for other
        shapes, a side shorter than ``minimum_side``, or a distance that is not finite."""
        if renderings.shape != truths.shape or renderings.ndim != 4 or renderings.shape[3] != 3:
            raise ImageError(f"expected two (N, H, W, 3) stacks, got {renderings.shape} and {truths.shape}")
        height, width = renderings.shape[1:3]
        if min(height, width) < self.minimum_side:
            raise ImageError(
                f"LPIPS-{self.network} needs images of at least {self.minimum_side} x {self.minimum_side} "
                f"pixels, got {width} x {height}"
            )
        distances = self._network().distances(renderings, truths)
        if not np.isfinite(distances).all():
            raise ImageError("LPIPS is not finite: an image holds NaN, infinity or values far outside [0, 1]")
        return distances

    def _network(self) -> Network:
        with self._lock:
            if self._loaded is None:
                from edge_server.fidelity.lpips_network import Network

                self._loaded = Network(self.network, self._parameters, self._lin)
            return self._loaded

    def _check(self) -> None:
        """Find missing and misshapen arrays before the first score."""
        for name, shape in _shapes(self.network).items():
            if self._parameters[name].shape != shape:
                raise ValueError(f"{name} has shape {self._parameters[name].shape}, the network needs {shape}")
        widths, expected = [len(lin) for lin in self._lin], list(SLICES[self.network])
        if widths != expected:
            raise ValueError(f"learned weights have widths {widths}, the network's slices {expected}")
        if not all(np.isfinite(array).all() for array in [*self._parameters.values(), *self._lin]):
            raise ValueError("an array holds NaN or infinity")


def _shapes(network: str) -> dict[str, tuple[int, ...]]:
    """The shape of every array by its name: a weight and a bias for each convolution."""
    layers = dict(_ALEX)
    if network == "squeeze":
        layers = {"0": (64, 3, 3)}
        for fire, (squeeze, inputs, expand) in _FIRES.items():
            layers[f"{fire}.squeeze"] = (squeeze, inputs, 1)
            layers[f"{fire}.expand1x1"] = (expand, squeeze, 1)
            layers[f"{fire}.expand3x3"] = (expand, squeeze, 3)
    found: dict[str, tuple[int, ...]] = {}
    for name, (out, inputs, side) in layers.items():
        found[f"{name}.bias"], found[f"{name}.weight"] = (out,), (out, inputs, side, side)
    return found


def _arrays(path: Path) -> dict[str, NDArray[np.float32]]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: np.ascontiguousarray(archive[name], dtype=np.float32) for name in archive.files}
