"""Gaussian splatting in plain torch, written as the equations are (Kerbl et al. 2023).

The tests compare the kernels and their gradients with this, in float64.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from edge_server.fields.common.kernels.camera import LENS, LIMITS, NEAR, ORIGIN
from edge_server.fields.splat.kernels.project import COLOR, OPACITY, QUATERNION, SCALE
from tests.edge_server.fields.torch_model import harmonics

# Written out: an oracle that imported them could not see them change.
LOW_PASS = 0.3  # pixels squared
ALPHA_MIN, ALPHA_MAX, STOP = 1.0 / 255.0, 0.99, 1e-4
RAW_OPACITY, SCALE_LOW, SCALE_HIGH = 9.0, -12.0, 4.0


class Flat(NamedTuple):
    """Projected Gaussians: mean (N, 2) in pixels, covariance (N, 2, 2), alpha (N,), color (N, 3), depth (N,), seen
    (N,): in front of the near plane."""

    mean: Tensor
    covariance: Tensor
    alpha: Tensor
    color: Tensor
    depth: Tensor
    seen: Tensor


def rotations(quaternion: Tensor) -> Tensor:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) of any length; the identity for length 0."""
    norm = quaternion.norm(dim=-1, keepdim=True)
    none = norm < 1e-10
    unit = torch.where(none, torch.tensor([1.0, 0, 0, 0]).to(quaternion), quaternion / norm.clamp(min=1e-10))
    w, x, y, z = unit.unbind(-1)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    first = [1 - 2 * (yy + zz), 2 * (xy - w * z), 2 * (xz + w * y)]
    second = [2 * (xy + w * z), 1 - 2 * (xx + zz), 2 * (yz - w * x)]
    third = [2 * (xz - w * y), 2 * (yz + w * x), 1 - 2 * (xx + yy)]
    rows = [*first, *second, *third]
    return torch.stack(rows, dim=-1).view(-1, 3, 3)


def distort(lens: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """``Pinhole``'s distortion of normalized coordinates; lens (8,)."""
    k1, k2, p1, p2 = lens[4:8]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return u, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def flatten(cam: Tensor, params: Tensor, sh_degree: int) -> Flat:
    """Project Gaussians (N, P) into camera row ``cam`` (see ``kernels.project``)."""
    view, origin, lens = cam[:ORIGIN].view(3, 3), cam[ORIGIN:LENS], cam[LENS:LIMITS]
    x, y, z = ((params[:, :3] - origin) @ view.T).unbind(-1)
    seen = z > cam[NEAR]
    z = torch.where(seen, z, torch.ones_like(z))
    a, b = x / z, y / z
    limits = cam[LIMITS : LIMITS + 4].tolist()
    ta, tb = a.clamp(*limits[:2]), b.clamp(*limits[2:])
    with torch.enable_grad():  # the lens's Jacobian by autograd, to check the kernel's
        pa, pb = (ta, tb) if ta.requires_grad else (ta.requires_grad_(True), tb.requires_grad_(True))
        u, v = distort(lens, pa, pb)
        dxx, dxy = torch.autograd.grad(u.sum(), (pa, pb), create_graph=True)
        _, dyy = torch.autograd.grad(v.sum(), (pa, pb), create_graph=True)
    fx, fy, cx, cy = lens[:4]
    mean_x, mean_y = u + dxx * (a - ta) + dxy * (b - tb), v + dxy * (a - ta) + dyy * (b - tb)
    mean = torch.stack([fx * mean_x + cx, fy * mean_y + cy], -1)
    bent = torch.stack([fx * dxx, fx * dxy, fy * dxy, fy * dyy], dim=-1).view(-1, 2, 2)
    one, none = 1 / z, torch.zeros_like(z)
    plane = torch.stack([one, none, -ta / z, none, one, -tb / z], dim=-1).view(-1, 2, 3)
    scale = params[:, SCALE:QUATERNION].clamp(SCALE_LOW, SCALE_HIGH).exp()
    half = bent @ plane @ view @ rotations(params[:, QUATERNION:OPACITY]) * scale[:, None, :]
    covariance = half @ half.mT + LOW_PASS * torch.eye(2).to(half)
    direction = params[:, :3] - origin
    direction = direction / direction.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    color = params[:, COLOR : COLOR + 3]
    if sh_degree:
        color = color + (params[:, COLOR + 3 :].view(len(params), 3, 3) * harmonics(direction)[..., None]).sum(1)
    alpha = params[:, OPACITY].clamp(-RAW_OPACITY, RAW_OPACITY).sigmoid()
    return Flat(mean, covariance, alpha, color, z, seen)


def composite(flat: Flat, width: int, height: int, background: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Color (H, W, 3), depth (H, W) and opacity (H, W), front to back."""
    ys, xs = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixel = torch.stack([xs, ys], dim=-1).to(flat.mean) + 0.5
    light = torch.ones(height, width).to(flat.mean)
    color, depth = torch.zeros(height, width, 3).to(light), torch.zeros(height, width).to(light)
    inverse = torch.linalg.inv(flat.covariance)
    for i in torch.argsort(flat.depth.detach(), stable=True).tolist():
        if not flat.seen[i]:
            continue
        offset = pixel - flat.mean[i]
        power = -0.5 * torch.einsum("hwi,ij,hwj->hw", offset, inverse[i], offset)
        alpha = (flat.alpha[i] * power.exp()).clamp(max=ALPHA_MAX)
        alpha = torch.where((alpha >= ALPHA_MIN) & (light >= STOP), alpha, torch.zeros_like(alpha))
        weight = alpha * light
        color = color + weight[..., None] * flat.color[i]
        depth = depth + weight * flat.depth[i]
        light = light - weight
    seen = 1 - light
    return color + light[..., None] * background, depth / seen.clamp(min=1e-3), seen
