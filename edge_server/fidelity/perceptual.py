"""A perceptual distance on our own small detector's backbone: the stand-in where LPIPS weights are missing.

It is thesis (3.34) and (3.35): features of the backbone's layers, normalized over channels as LPIPS does,
squared differences weighted by w_l^2 >= 0 and averaged over pixels, summed over layers, and
g(d) = d^power. Weights and power were fitted to real LPIPS on distorted renderings of our own scenes
(with tag v0.1-all, which can fit them again), so figures have LPIPS's size and order. They are not LPIPS: wherever they
appear they are called ``perceptual``. Spearman's correlation with LPIPS is .90 on unseen variations of the
fitted scenes, and .86 to .90 on a scene that was left out of the fit (``embed/models/perceptual.json``).
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.images import ImageError, same_size, to_unit

if TYPE_CHECKING:
    import onnxruntime as ort

EPSILON = 1e-10
MINIMUM_SIDE = 16
MODELS = Path(__file__).resolve().parent.parent / "embed" / "models"
DETECTOR, COEFFICIENTS = "detector_fp32.onnx", "perceptual.npz"


class Perceptual:
    """The fitted distance; stateless once built, so that threads may share it."""

    minimum_side = MINIMUM_SIDE

    def __init__(self, layers: Layers, weights: list[NDArray[np.float64]], power: float) -> None:
        """weights: w_l^2 (C_l,) of each layer, not negative. power: exponent of g. Raises ValueError if they
        do not fit the layers."""
        if len(weights) != len(layers.taps) or not 0.0 < power <= 4.0:
            raise ValueError(f"{len(weights)} weights for {len(layers.taps)} layers, power {power}")
        if not all(np.isfinite(w).all() and (w >= 0.0).all() for w in weights):
            raise ValueError("a weight is negative, NaN or infinite")
        self.network, self._layers, self._power = layers.name, layers, power
        self._weights = np.concatenate(weights)

    def __call__(self, rendering: NDArray, truth: NDArray) -> float:
        """Distance of two images as ``images.to_unit`` takes them; 0 for equal ones. Raises ImageError."""
        a, b = to_unit(rendering, "rendering"), to_unit(truth, "truth")
        same_size(a, b)
        if min(a.shape[:2]) < MINIMUM_SIDE:
            raise ImageError(
                f"the perceptual distance needs images of at least {MINIMUM_SIDE} x {MINIMUM_SIDE} pixels, "
                f"got {a.shape[1]} x {a.shape[0]}"
            )
        distance = float(self._layers.differences(a[None], b[None])[0] @ self._weights) ** self._power
        if not np.isfinite(distance):
            raise ImageError("the perceptual distance is not finite: the detector's file is damaged")
        return distance


class Layers:
    """The backbone's feature maps ``taps``, and the differences of image stacks in them."""

    def __init__(self, detector: Path, taps: tuple[str, ...], threads: int = 1) -> None:
        """Raises edge_server.embed.EmbeddingError where the file cannot be used."""
        from edge_server.embed.backbone import cut_layers
        from edge_server.embed.embedder import open_session

        model, self._input = cut_layers(detector, taps)
        self._session: ort.InferenceSession = open_session(model, "cpu", threads, detector.name)[0]
        self.taps, self.name = taps, detector.stem

    def differences(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, sum of C_l) squared differences of normalized features of image stacks (N, H, W, 3) in [0, 1],
        averaged over pixels; the channels of all layers in order."""
        n = len(a)
        stack = np.concatenate([a, b]).transpose(0, 3, 1, 2).astype(np.float32)
        found = []
        for features in self._session.run(None, {self._input: np.ascontiguousarray(stack)}):
            length = np.sqrt((features * features).sum(axis=1, keepdims=True, dtype=np.float64)) + EPSILON
            unit = features / length
            found.append(((unit[:n] - unit[n:]) ** 2).mean(axis=(2, 3)))
        return np.concatenate(found, axis=1)

    def widths(self) -> list[int]:
        """Channels of each layer."""
        probe = np.zeros((1, 3, MINIMUM_SIDE, MINIMUM_SIDE), np.float32)
        return [out.shape[1] for out in self._session.run(None, {self._input: probe})]


def open_perceptual(folder: Path = MODELS) -> tuple[Perceptual | None, str | None]:
    """(metric, None), or (None, reason) in one line where it cannot be used. folder: folder with the detector
    and coefficients in the same format; by default the shipped ones."""
    try:
        with np.load(folder / COEFFICIENTS, allow_pickle=False) as archive:
            taps = tuple(str(tap) for tap in archive["taps"])
            power = float(archive["power"])
            weights = [archive[f"w{k}"].astype(np.float64) for k in range(len(taps))]
        layers = Layers(folder / DETECTOR, taps)
        if [len(w) for w in weights] != layers.widths():
            raise ValueError(f"{COEFFICIENTS} was fitted to another detector")
        return Perceptual(layers, weights, power), None
    except ModuleNotFoundError as error:
        return None, f"perceptual: {error.name} is not installed: pip install 'freshfield[embed]'"
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        return None, f"perceptual: the files in {folder} cannot be used ({error})"
