"""The Gaussians and their adaptive density control (Kerbl et al. 2023): which are split, which are pruned."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.training_schedule import BETA2
from edge_server.fields.splat.kernels.optimizer_step import DEAD, OptimizerState, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE, Gaussians
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import quaternion_to_matrix

SHRINK = 1.6  # divides the scales of both halves of a split Gaussian (Kerbl et al.)
SHARP_PX = 1.0  # Gaussians about this wide in the image are cloned without shrinking


@dataclass
class GaussianCloud:
    """The Gaussians and what is stored with each: arrays of equal length N <= ``settings.gaussians``. Their
    names are keys of checkpoints.

    params: (N, P), see ``kernels.project``.
    m, v, age, slope, looks, reach: see ``OptimizerState``.
    velocity: (N, 3), scene units a second, 0 for static Gaussians.
    guest: (N,), 0 for static Gaussians. Those seeded where something moved ("guests", see ``motion``) have 1
        plus the number of updates since they last moved.
    """

    params: NDArray[np.float32]
    m: NDArray[np.float32]
    v: NDArray[np.float32]
    age: NDArray[np.int32]
    slope: NDArray[np.float32]
    looks: NDArray[np.float32]
    reach: NDArray[np.float32]
    velocity: NDArray[np.float32]
    guest: NDArray[np.int32]

    @classmethod
    def new(cls, params: NDArray[np.float32]) -> GaussianCloud:
        """Static Gaussians that have made no step, with parameters float32 (N, P)."""
        n = len(params)
        slope, looks, reach = (np.zeros(n, np.float32) for _ in range(3))
        age, guest, velocity = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros((n, 3), np.float32)
        m, v = np.zeros_like(params), np.zeros_like(params)
        return cls(params, m, v, age, slope, looks, reach, velocity, guest)

    @classmethod
    def empty(cls, settings: SplatSettings) -> GaussianCloud:
        return cls.new(np.zeros((0, BASE + 3 * (settings.harmonics - 1)), np.float32))

    def __len__(self) -> int:
        return len(self.params)

    def gaussians(self, which: slice | NDArray[np.int64] = slice(None)) -> Gaussians:
        """The arrays that are projected: without a copy for all Gaussians, copied for some of them."""
        harmonics = (self.params.shape[1] - BASE) // 3 + 1
        return Gaussians(self.params[which], harmonics, self.velocity[which])

    def optimizer_state(self) -> OptimizerState:
        """The arrays that a step updates beside ``params``, not copied."""
        return OptimizerState(self.m, self.v, self.age, self.slope, self.looks, self.reach)

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Remove the Gaussians where ``which``, bool (N,), is false."""
        self._replace({f.name: np.ascontiguousarray(getattr(self, f.name)[which]) for f in fields(self)})

    def add(self, new: GaussianCloud) -> None:
        self._replace({f.name: np.concatenate([getattr(self, f.name), getattr(new, f.name)]) for f in fields(self)})

    def _replace(self, arrays: dict[str, NDArray]) -> None:
        # All at once: Ctrl-C in between would leave arrays of different lengths.
        self.__dict__.update(arrays)


def opacity(params: NDArray[np.float32]) -> NDArray[np.float32]:
    """Opacities (N,) in [0, 1]."""
    return (1.0 / (1.0 + np.exp(-params[:, OPACITY]))).astype(np.float32)


def raw_opacity(alpha: NDArray[np.float32]) -> NDArray[np.float32]:
    """The inverse of ``opacity``."""
    alpha = np.clip(alpha, 1e-4, 1.0 - 1e-4)
    return np.log(alpha / (1.0 - alpha)).astype(np.float32)


def color_sensitivity(cloud: GaussianCloud) -> NDArray[np.float32]:
    """How much the loss depends on each Gaussian, float32 (N,), on an arbitrary scale: Adam's mean square of
    the gradient by color. That gradient sums, over the pixels a Gaussian covers, its weight in the pixel
    times the error there. It is small for small, hidden and faint Gaussians, and where the error is small,
    because enough Gaussians are there; if too many are pruned, error and gradient return. Infinite for
    Gaussians that have made no step."""
    square = cloud.v[:, COLOR:BASE].sum(axis=1) / (1.0 - BETA2 ** np.maximum(cloud.age, 1))
    return np.where(cloud.age > 0, square, np.inf).astype(np.float32)


def prune_least_sensitive(cloud: GaussianCloud, count: int) -> None:
    """Remove the ``count`` Gaussians of least ``color_sensitivity``. Pruning by opacity instead would remove
    all faint Gaussians in time, and edges are made of them: -1.1 dB after 300 updates of ``room``."""
    if count > 0:
        keep = np.ones(len(cloud), bool)
        keep[np.argsort(color_sensitivity(cloud), kind="stable")[:count]] = False
        cloud.keep(keep)


def densify_and_prune(cloud: GaussianCloud, settings: SplatSettings, pixels: float, rng: np.random.Generator) -> None:
    """Remove faint Gaussians and those that no view shows, then split those with the largest gradient by the
    projected mean.

    The two halves together transmit as much light as the one did (Bulo et al. 2024): otherwise every split
    would darken what lies behind.

    pixels: width of the images.
    rng: draws where the halves go.
    """
    seen = cloud.looks > 0
    cloud.keep(seen & (opacity(cloud.params) >= settings.prune) & (cloud.params[:, OPACITY] > DEAD + 1e-3))
    n = len(cloud)
    want = min(settings.gaussians - n, int(np.ceil(settings.grow * n)))
    if want > 0 and n > 0:
        slope = cloud.slope / np.maximum(cloud.looks, 1.0)
        slope = np.where(cloud.reach > settings.widest, np.inf, slope)
        # Stable, so that ties are broken alike on every machine.
        chosen = np.sort(np.argsort(-slope, kind="stable")[:want])
        chosen = chosen[slope[chosen] > 0]
        _split(cloud, chosen, pixels, settings, rng)
    cloud.slope[:] = 0.0
    cloud.looks[:] = 0.0
    cloud.reach[:] = 0.0


def _split(
    cloud: GaussianCloud, chosen: NDArray[np.int64], pixels: float, settings: SplatSettings, rng: np.random.Generator
) -> None:
    one = cloud.params[chosen].copy()
    size = np.exp(one[:, SCALE : SCALE + 3])
    rotation = quaternion_to_matrix(one[:, QUATERNION : QUATERNION + 4])
    offset = np.einsum("nij,nj->ni", rotation, rng.standard_normal((len(chosen), 3)) * size)
    wide = cloud.reach[chosen] * pixels > SHARP_PX
    one[:, SCALE : SCALE + 3] -= np.where(wide, np.log(SHRINK), 0.0)[:, None]
    one[:, OPACITY] = raw_opacity(1.0 - np.sqrt(1.0 - opacity(one)))
    two = one.copy()
    one[:, :3] += 0.5 * offset
    two[:, :3] -= 0.5 * offset
    for half in (one, two):
        clamp_gaussians(half, *settings.scale_bounds)
    cloud.params[chosen] = one
    cloud.m[chosen] = 0.0
    cloud.v[chosen] = 0.0
    cloud.age[chosen] = 0
    halves = GaussianCloud.new(two)
    halves.velocity, halves.guest = cloud.velocity[chosen], cloud.guest[chosen]
    cloud.add(halves)
