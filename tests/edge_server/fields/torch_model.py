"""The hash-grid field in plain torch: the reference for the kernels.

Parameters, layout and formulas are those of ``kernels``; autograd computes the gradients.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from edge_server.fields.common.kernels.hash_grid import FEATURES
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW
from edge_server.fields.field_constants import OPAQUE_DEPTH


def to_torch(grid: Any) -> Any:
    """The grid, whatever it has beside a table, with that (vertices, 2) as a tensor of float64."""
    return grid._replace(table=torch.as_tensor(grid.table, dtype=torch.float64).clone())


def encode(grid: Any, levels: int, x: Tensor) -> Tensor:
    """Points (N, 3) in the unit cube -> features (N, 2 L); levels from ``levels`` on are 0. Eq. 3.23."""
    res, first, dense = map(torch.as_tensor, (grid.resolution[:levels], grid.first[: levels + 1], grid.dense[:levels]))
    res, dense = res.long()[:, None], dense[:, None]  # (l, 1)
    scaled = x[:, None, :] * res  # (N, l, 3)
    cell = torch.minimum(scaled.floor().clamp(min=0), (res - 1).to(x.dtype))
    part = scaled - cell
    weight = _corners(torch.mul, torch.stack([1 - part, part], dim=-1))
    strides = torch.cat([torch.ones_like(res), res + 1, (res + 1) ** 2], dim=-1)
    factor = torch.where(dense, strides, torch.tensor((1, 2654435761, 805459861)))  # (l, 3)
    near = cell.long() * factor
    sides = torch.stack([near, near + factor], dim=-1)
    hashed = (_corners(torch.bitwise_xor, sides) & 0xFFFFFFFF) % first.diff()[:, None]
    row = first[:-1, None] + torch.where(dense, _corners(torch.add, sides), hashed)  # (N, l, 8)
    found = (weight[..., None] * grid.table[row]).sum(dim=2).flatten(1)
    return torch.nn.functional.pad(found, (0, FEATURES * (len(grid.resolution) - levels)))


def _corners(combine: Callable[[Tensor, Tensor], Tensor], sides: Tensor) -> Tensor:
    """Of both sides of a cell along x, y and z (N, l, 3, 2) -> of its corners (N, l, 8), x fastest."""
    x, y, z = sides.unbind(-2)
    plane = combine(x[..., None, :], y[..., :, None])
    return combine(plane[..., None, :, :], z[..., :, None, None]).flatten(2)


def mlp(widths: Sequence[int], params: Tensor, x: Tensor) -> Tensor:
    """x (N, up to widths[0]), padded with zeros -> (N, widths[-1]); ReLU between layers."""
    x = torch.nn.functional.pad(x, (0, widths[0] - x.shape[-1]))
    first = 0
    for layer, (n_in, n_out) in enumerate(pairwise(widths)):
        matrix = params[first : first + n_out * n_in].view(n_out, n_in)
        first += n_out * n_in
        x = x @ matrix.T + params[first : first + n_out]
        first += n_out
        x = x if layer == len(widths) - 2 else torch.relu(x)
    return x


def harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics of degree 1 of unit directions (N, 3) -> (N, 3)."""
    return 0.4886025 * d[:, [1, 2, 0]]


def shade(raw: Tensor, sh_degree: int, d: Tensor) -> tuple[Tensor, Tensor]:
    """Net output (N, >= 4 + 9 sh_degree) and directions (N, 3) -> density (N,), color (N, 3). The clamp has
    no gradient outside its bounds, forward and backward alike."""
    sigma = raw[:, 0].clamp(RAW_LOW, RAW_HIGH).exp()
    color = raw[:, 1:4]
    if sh_degree:
        color = color + (raw[:, 4:13].view(len(raw), 3, 3) * harmonics(d)[..., None]).sum(dim=1)
    return sigma, color.sigmoid()


def ray_weights(sigma: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
    """Density and step length (R, S), 0 where there is no sample -> weights (R, S) and transmittance
    behind the last sample (R,). Samples behind the point of opacity have no weight. Eq. 3.21."""
    depth = (sigma * delta).cumsum(dim=-1)
    before = torch.nn.functional.pad(depth, (1, 0))[:, :-1]
    seen = before <= OPAQUE_DEPTH
    weight = torch.where(seen, torch.exp(-before) - torch.exp(-depth), torch.zeros_like(depth))
    return weight, 1.0 - weight.sum(dim=-1)


def ray_losses(
    sigma: Tensor, color: Tensor, t: Tensor, delta: Tensor, target: Tensor, background: Tensor, distortion: float
) -> tuple[Tensor, Tensor]:
    """Color errors (R,) and losses (R,) of rays with samples (R, S), none nearer than the one before it: 3.22
    and mip-NeRF 360's distortion loss."""
    weight, left = ray_weights(sigma, delta)
    rendered = (weight[..., None] * color).sum(dim=1) + left[:, None] * background
    error = (rendered - target).square().sum(dim=-1)
    before = torch.nn.functional.pad(weight, (1, 0)).cumsum(dim=-1)[:, :-1]
    moment = torch.nn.functional.pad(weight * t, (1, 0)).cumsum(dim=-1)[:, :-1]
    spread = 2.0 * (weight * (t * before - moment)).sum(dim=-1)  # over all pairs
    spread = spread + (weight.square() * delta).sum(dim=-1) / 3.0
    return error, error + distortion * spread
