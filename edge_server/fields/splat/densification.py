"""How Gaussians come and go: split where pictures pull at them, removed where they add nothing."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.training_schedule import BETA2
from edge_server.fields.splat.kernels.optimizer_step import DEAD, OptimizerState, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE, Gaussians
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import quaternion_to_matrix

SHRINK = 1.6  # of both halves of a split Gaussian (Kerbl et al.)
SHARP_PX = 1.0  # what is about a pixel wide is doubled without shrinking


@dataclass
class GaussianCloud:
    """The Gaussians and all that is known of each: arrays of equal length, at most ``settings.gaussians``.

    velocity: (N, 3) scene units a second, 0 but for guests. guest: (N,), 0 for what belongs to the scene as
    it stands; else 1 more than the updates since the Gaussian, begun where something moved, last moved."""

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
        """New Gaussians, without a history."""
        n = len(params)
        slope, looks, reach = (np.zeros(n, np.float32) for _ in range(3))
        age, guest, velocity = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros((n, 3), np.float32)
        m, v = np.zeros_like(params), np.zeros_like(params)
        return cls(params, m, v, age, slope, looks, reach, velocity, guest)

    @classmethod
    def empty(cls, settings: SplatSettings) -> GaussianCloud:
        """None at all."""
        return cls.new(np.zeros((0, BASE + 3 * (settings.harmonics - 1)), np.float32))

    def __len__(self) -> int:
        return len(self.params)

    def gaussians(self, harmonics: int) -> Gaussians:
        """As the kernels read them."""
        return Gaussians(self.params, harmonics, self.velocity)

    def optimizer_state(self) -> OptimizerState:
        """As the kernels read them."""
        return OptimizerState(self.m, self.v, self.age, self.slope, self.looks, self.reach)

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Remove the others."""
        self._replace({f.name: np.ascontiguousarray(getattr(self, f.name)[which]) for f in fields(self)})

    def add(self, new: GaussianCloud) -> None:
        """Append others."""
        self._replace({
            f.name: np.concatenate([getattr(self, f.name), getattr(new, f.name)]) for f in fields(self)
        })  # fmt: skip

    def _replace(self, arrays: dict[str, NDArray]) -> None:
        # All at once: Ctrl-C in between would leave arrays of different lengths.
        self.__dict__.update(arrays)


def opacity(params: NDArray[np.float32]) -> NDArray[np.float32]:
    """In [0, 1], (N,)."""
    return (1.0 / (1.0 + np.exp(-params[:, OPACITY]))).astype(np.float32)


def raw_opacity(alpha: NDArray[np.float32]) -> NDArray[np.float32]:
    """The inverse of ``opacity``."""
    alpha = np.clip(alpha, 1e-4, 1.0 - 1e-4)
    return np.log(alpha / (1.0 - alpha)).astype(np.float32)


def color_sensitivity(cloud: GaussianCloud) -> NDArray[np.float32]:
    """How much the pictures' errors depend on each Gaussian, float32 (N,), of a scale that only comparisons
    know: the mean square of the loss's gradient by its colour, which Adam keeps. That gradient is the sum,
    over the pixels where it shows, of its share in the pixel times the error there. Small, hidden and faint
    ones have little of it, and so has what is shown without any error: there are more than enough there, and
    when there no longer are, errors and gradients come back. Infinite for those that have made no step:
    nothing is known of them.
    """
    square = cloud.v[:, COLOR:BASE].sum(axis=1) / (1.0 - BETA2 ** np.maximum(cloud.age, 1))
    return np.where(cloud.age > 0, square, np.inf).astype(np.float32)


def prune_least_sensitive(cloud: GaussianCloud, count: int) -> None:
    """Remove the ``count`` Gaussians on which the pictures' errors depend least. By opacity, all that is
    faint would go in time, and it is what edges are made of: -1.1 dB after 300 updates of ``room``."""
    if count > 0:
        keep = np.ones(len(cloud), bool)
        keep[np.argsort(color_sensitivity(cloud), kind="stable")[:count]] = False
        cloud.keep(keep)


def densify_and_prune(
    cloud: GaussianCloud, settings: SplatSettings, pixels: float, rng: np.random.Generator
) -> None:
    """Remove what no picture shows, then split the Gaussians whose place in the picture is pulled at most.

    pixels: of a picture's width. The two halves together let through as much light as the one did (Bulo et
    al. 2024): without that, every split would darken what lies behind.
    """
    seen = cloud.looks > 0
    cloud.keep(seen & (opacity(cloud.params) >= settings.prune) & (cloud.params[:, OPACITY] > DEAD + 1e-3))
    n = len(cloud)
    want = min(settings.gaussians - n, int(np.ceil(settings.grow * n)))
    if want > 0 and n > 0:
        pull = cloud.slope / np.maximum(cloud.looks, 1.0)
        pull = np.where(cloud.reach > settings.widest, np.inf, pull)
        # Stable, so that equal ones are taken in one order on every machine.
        chosen = np.sort(np.argsort(-pull, kind="stable")[:want])
        chosen = chosen[pull[chosen] > 0]
        _split(cloud, chosen, pixels, settings, rng)
    cloud.slope[:] = 0.0
    cloud.looks[:] = 0.0
    cloud.reach[:] = 0.0


def _split(
    cloud: GaussianCloud,
    chosen: NDArray[np.int64],
    pixels: float,
    settings: SplatSettings,
    rng: np.random.Generator,
) -> None:
    one = cloud.params[chosen].copy()
    size = np.exp(one[:, SCALE : SCALE + 3])
    turn = quaternion_to_matrix(one[:, QUATERNION : QUATERNION + 4])
    offset = np.einsum("nij,nj->ni", turn, rng.standard_normal((len(chosen), 3)) * size)
    wide = cloud.reach[chosen] * pixels > SHARP_PX
    one[:, SCALE : SCALE + 3] -= np.where(wide, np.log(SHRINK), 0.0)[:, None]
    one[:, OPACITY] = raw_opacity(1.0 - np.sqrt(1.0 - opacity(one)))
    two = one.copy()
    one[:, :3] += 0.5 * offset
    two[:, :3] -= 0.5 * offset
    largest, thinnest = np.float32(settings.largest), np.float32(np.log(settings.aspect))
    for half in (one, two):
        clamp_gaussians(half, largest, thinnest)
    cloud.params[chosen] = one
    cloud.m[chosen] = 0.0
    cloud.v[chosen] = 0.0
    cloud.age[chosen] = 0
    halves = GaussianCloud.new(two)
    halves.velocity, halves.guest = cloud.velocity[chosen], cloud.guest[chosen]
    cloud.add(halves)
