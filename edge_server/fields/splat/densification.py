"""The Gaussians and their adaptive density control (Kerbl et al. 2023): which are split, which are pruned."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat import splat_constants as tuned
from edge_server.fields.splat.kernels.optimizer_step import DEAD, OptimizerState, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, OPACITY, QUATERNION, SCALE, SH_COLUMNS
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import quaternion_to_matrix


@dataclass
class GaussianCloud:
    """The Gaussians and their optimizer state: arrays of equal length N <= ``settings.gaussians``. Their names are
    keys of checkpoints.

    params: (N, P), see ``kernels.project``.
    m, v, age, slope, looks, reach: see ``OptimizerState``.
    """

    params: NDArray[np.float32]
    m: NDArray[np.float32]
    v: NDArray[np.float32]
    age: NDArray[np.int32]
    slope: NDArray[np.float32]
    looks: NDArray[np.float32]
    reach: NDArray[np.float32]

    @classmethod
    def new(cls, params: NDArray[np.float32]) -> GaussianCloud:
        """Gaussians before their first step, with parameters float32 (N, P)."""
        n = len(params)
        slope, looks, reach = (np.zeros(n, np.float32) for _ in range(3))
        m, v, age = np.zeros_like(params), np.zeros_like(params), np.zeros(n, np.int32)
        return cls(params, m, v, age, slope, looks, reach)

    @classmethod
    def empty(cls, settings: SplatSettings) -> GaussianCloud:
        return cls.new(np.zeros((0, BASE + SH_COLUMNS * settings.sh_degree), np.float32))

    def __len__(self) -> int:
        return len(self.params)

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


def densify_and_prune(cloud: GaussianCloud, most: int, pixels: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Remove faint Gaussians and those that no view shows, then split those with the largest mean gradient by the
    projected mean. Returns int64 (N,), for each Gaussian the index of the one that it comes from.

    The two halves together transmit as much light as the one did (Bulo et al. 2024): otherwise every split
    would darken what lies behind.

    most: largest number of Gaussians.
    pixels: width of the images.
    rng: draws the positions of the halves.
    """
    kept = (cloud.looks > 0) & (opacity(cloud.params) >= tuned.PRUNE_OPACITY) & (cloud.params[:, OPACITY] > DEAD + 1e-3)
    cloud.keep(kept)
    origin, n = np.flatnonzero(kept), len(cloud)
    want = min(most - n, int(np.ceil(tuned.GROW_SHARE * n)))
    if want > 0 and n > 0:
        slope = cloud.slope / np.maximum(cloud.looks, 1.0)
        slope = np.where(cloud.reach > tuned.WIDEST, np.inf, slope)
        # Stable, so that ties are broken alike on every machine.
        chosen = np.sort(np.argsort(-slope, kind="stable")[:want])
        chosen = chosen[slope[chosen] > 0]
        _split(cloud, chosen, pixels, rng)
        origin = np.concatenate([origin, origin[chosen]])
    cloud.slope[:] = 0.0
    cloud.looks[:] = 0.0
    cloud.reach[:] = 0.0
    return origin


def _split(cloud: GaussianCloud, chosen: NDArray[np.int64], pixels: float, rng: np.random.Generator) -> None:
    one = cloud.params[chosen].copy()
    size = np.exp(one[:, SCALE : SCALE + 3])
    rotation = quaternion_to_matrix(one[:, QUATERNION : QUATERNION + 4])
    offset = np.einsum("nij,nj->ni", rotation, rng.standard_normal((len(chosen), 3)) * size)
    wide = cloud.reach[chosen] * pixels > tuned.SHARP_PX
    one[:, SCALE : SCALE + 3] -= np.where(wide, np.log(tuned.SPLIT_SHRINK), 0.0)[:, None]
    one[:, OPACITY] = raw_opacity(1.0 - np.sqrt(1.0 - opacity(one)))
    two = one.copy()
    one[:, :3] += tuned.SPLIT_APART * offset
    two[:, :3] -= tuned.SPLIT_APART * offset
    for half in (one, two):
        clamp_gaussians(half)
    cloud.params[chosen] = one
    cloud.m[chosen] = 0.0
    cloud.v[chosen] = 0.0
    cloud.age[chosen] = 0
    cloud.add(GaussianCloud.new(two))
