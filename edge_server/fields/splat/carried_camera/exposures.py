"""The exposure of each view of a scan: a gain and a bias per channel, which map the rendering to the image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.kernels.rasterize import EXPOSURE

Array = NDArray[np.float64]

_NEUTRAL = np.array([[1.0] * 3, [0.0] * 3])


class Exposures:
    """Exposures by view, found in closed form: image = gain * rendering + bias.

    Only their ratios are determined, since a common factor can be absorbed by the colors: the geometric mean of the
    gains is kept at 1, the mean of the biases at 0.
    """

    def __init__(self) -> None:
        self.known: dict[str, Array] = {}  # view -> (2, 3), gains and biases

    def of(self, camera: str) -> Array:
        """Gains and biases (2, 3) of a view; neutral if none are known."""
        return self.known.get(camera, _NEUTRAL)

    def between(self, neighbors: dict[str, float]) -> Array:
        """Gains and biases (2, 3) interpolated from other views. neighbors: these views and their weights."""
        if not neighbors:
            return _NEUTRAL
        parts = [(share, *self.of(name)) for name, share in neighbors.items()]
        logs = sum(share * np.log(gain) for share, gain, _ in parts)
        return np.stack([np.exp(logs), sum(share * bias for share, _, bias in parts)])

    def row(self, camera: str) -> NDArray[np.float32]:
        """``Target.exposure``. An error counts as it does in the image."""
        gain, bias = self.of(camera)
        row = np.zeros(EXPOSURE, np.float32)
        row[:3], row[3:6], row[6] = gain, bias, np.mean(gain * gain)
        return row

    def learn(self, camera: str, sums: Array, whole: bool = False) -> None:
        """Move a view's exposure toward the damped least-squares solution of a step, all the way the first time. Does
        nothing if sums are not finite or contain no pixels.

        sums: (3, MOMENTS), see ``rasterize.MOMENTS``, at the exposure as known.
        whole: go all the way.
        """
        if not np.isfinite(sums).all() or sums[:, 0].min() <= 0.0:
            return
        (gain, bias), fresh = self.of(camera), whole or camera not in self.known
        r, rr, t, rt = (sums[:, k] / sums[:, 0] for k in range(1, 5))
        image, both = gain * t + bias, gain * rt + bias * r
        a, d = rr + tuned.TOWARDS_ONE, 1.0 + tuned.TOWARDS_ONE
        b, p, q = r, both + tuned.TOWARDS_ONE, image
        over = 1.0 / (a * d - b * b)  # at least TOWARDS_ONE squared: a d >= rr + damping, and b b <= rr
        found = np.stack([(p * d - b * q) * over, (a * q - b * p) * over])
        known = found if fresh else np.stack([gain, bias]) * (1.0 - tuned.EXPOSURE_SHARE) + tuned.EXPOSURE_SHARE * found
        self.known[camera] = _bounded(known)

    def center(self) -> None:
        """Return to the gauge: geometric mean of gains 1, mean of biases 0."""
        if not self.known:
            return
        every = np.stack(list(self.known.values()))
        mean = np.stack([np.exp(np.log(every[:, 0]).mean(axis=0)), every[:, 1].mean(axis=0)])
        for name, (gain, bias) in self.known.items():
            self.known[name] = _bounded(np.stack([gain / mean[0], bias - mean[1]]))

    def meta(self) -> dict[str, Any]:
        """The exact state, as JSON values."""
        return {name: known.tolist() for name, known in self.known.items()}

    def load(self, meta: dict[str, Any]) -> None:
        """Restore what ``meta`` returned."""
        self.known = {name: np.array(known, dtype=np.float64).reshape(2, 3) for name, known in meta.items()}


def _bounded(known: Array) -> Array:
    return np.stack([np.clip(known[0], *tuned.GAINS), np.clip(known[1], -tuned.MOST_BIAS, tuned.MOST_BIAS)])
