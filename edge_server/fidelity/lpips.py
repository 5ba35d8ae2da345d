"""Learned perceptual image patch similarity, thesis (3.34) and (3.35), as Zhang et al. published it (v0.1).

Features after each slice of a frozen AlexNet are normalized over channels, their squared
difference is weighted by the learned (not squared) channel weights, averaged over pixels and summed over
slices. The thesis's (3.35) squares the weights and does not mention the normalization; papers and tools
report the published network, and so does this. Distances are comparable only within one network, AlexNet here.

With a mask the pixels outside it are black in both images, and the differences of a slice are averaged with the shares
of the mask in its cells as weights (mLPIPS of Gao et al., 2022, which enlarges the differences to pixels instead).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.images import ImageError, same_size, to_unit

MINIMUM_SIDE = 31  # smaller images leave a pooling layer of AlexNet without input
# AlexNet's convolutions: channels out and in, and side of the kernel.
CONVOLUTIONS = {"0": (64, 3, 11), "3": (192, 64, 5), "6": (384, 192, 3), "8": (256, 384, 3), "10": (256, 256, 3)}


class Lpips:
    """LPIPS of AlexNet on the CPU, which threads may share. torch is imported at the first distance."""

    minimum_side = MINIMUM_SIDE

    def __init__(self, features: Path, lin: Path) -> None:
        """features, lin: npz files (see ``lpips_weights``).

        Raises KeyError or ValueError naming the array that is absent or has a wrong shape.
        """
        self._parameters = {name.removeprefix("features."): array for name, array in _arrays(features).items()}
        lins = _arrays(lin)
        self._lin = [lins[f"lin{i}"].reshape(-1) for i in range(len(lins))]
        self._check()

    def __call__(self, rendering: NDArray, truth: NDArray, mask: NDArray[np.bool_] | None = None) -> float:
        """Distance of two images as ``images.to_unit`` takes them: 0 for equal ones, about 1 for unrelated
        ones.

        mask: (H, W), the pixels to score, at least one; None: all.
        Raises ImageError where a side is shorter than ``minimum_side``.
        """
        a, b = to_unit(rendering, "rendering"), to_unit(truth, "truth")
        same_size(a, b)
        height, width = a.shape[:2]
        if min(height, width) < MINIMUM_SIDE:
            raise ImageError(
                f"LPIPS needs images of at least {MINIMUM_SIDE} x {MINIMUM_SIDE} pixels, got {width} x {height}"
            )
        from edge_server.fidelity.lpips_network import distance

        return distance(self._parameters, self._lin, a, b, mask)

    def _check(self) -> None:
        """Find missing and misshapen arrays before the first score."""
        for name, (out, inputs, side) in CONVOLUTIONS.items():
            for part, shape in (("bias", (out,)), ("weight", (out, inputs, side, side))):
                if (found := self._parameters[f"{name}.{part}"].shape) != shape:
                    raise ValueError(f"{name}.{part} has shape {found}, the network needs {shape}")
        widths, expected = [len(lin) for lin in self._lin], [out for out, _, _ in CONVOLUTIONS.values()]
        if widths != expected:
            raise ValueError(f"learned weights have widths {widths}, the network's slices {expected}")
        if not all(np.isfinite(array).all() for array in [*self._parameters.values(), *self._lin]):
            raise ValueError("an array holds NaN or infinity")


def _arrays(path: Path) -> dict[str, NDArray[np.float32]]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: np.ascontiguousarray(archive[name], dtype=np.float32) for name in archive.files}
