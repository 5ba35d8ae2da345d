"""The Gaussian field with gsplat's CUDA rasterizer (Ye et al. 2024): ``pip install "freshfield[cuda]"``.

Only the gradient of a step is computed here; ``SplatField`` does the rest: seeding, densification, motion,
state, and snapshots, which the CPU kernels render. Gaussians stay in host memory and are copied for each
step. The code around the rasterizer is tested on CPUs with the torch oracle in place of gsplat; the tests
with gsplat itself need a GPU.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edge_server.fields import Budget, View
from edge_server.fields.common.kernels.camera import LENS, NEAR, ORIGIN, SIZE, TIME
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.training_schedule import step_key
from edge_server.fields.ngp.torch_model import harmonics as harmonics_of
from edge_server.fields.splat.cpu_field import SplatField
from edge_server.fields.splat.kernels.optimizer_step import GRADIENT_LIMIT, clamp_gaussians
from edge_server.fields.splat.kernels.project import (
    COLOR,
    OPACITY,
    QUATERNION,
    RAW_OPACITY,
    SCALE,
    SCALE_HIGH,
    SCALE_LOW,
)
from edge_server.fields.splat.motion import SceneChange
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole

Rasterize = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


class GsplatField(SplatField):
    """``SplatField`` whose gradients come from ``rasterize``: gsplat's ``rasterization``, or one like it.

    Whole images, pinhole cameras and squared or absolute errors only. Not deterministic to the last bit:
    gsplat adds up gradients in whatever order its threads finish.
    """

    def __init__(
        self, settings: SplatSettings, rasterize: Rasterize, device: str = "cuda", pool: Pool | None = None
    ) -> None:
        if settings.dssim:
            raise ValueError("splat: dssim needs device cpu; device cuda has loss mse or l1 alone")
        super().__init__(settings, pool)
        self._rasterize, self._device = rasterize, torch.device(device)

    def warm_up(self) -> float:
        """Also a step on the device: gsplat compiles its kernels when first used, for a minute or more."""
        seconds, start = super().warm_up(), time.perf_counter()
        camera, pose = Pinhole.from_fov(32, 32, 60.0), np.eye(4)
        pose[2, 3] = -3.0
        tiny = replace(
            self.settings,
            gaussians=64,
            start=8,
            min_views=1,
            seed_cells=8,
            contracted=False,
            centre_m=None,
            radius_m=None,
            near_m=None,
        )
        image = np.full((32, 32, 3), 128, np.uint8)
        image[8:16, 8:16] = 255  # or there would be no Gaussians to rasterize
        field = GsplatField(tiny, self._rasterize, str(self._device))
        field.fit([View("warm-up", image, pose, camera)], Budget(steps=1))
        return seconds + time.perf_counter() - start

    def _ingest(self, views: Sequence[View]) -> SceneChange | None:
        for view in views:
            if view.intrinsics.distorted:
                raise ValueError(
                    f"camera {view.camera}: device cuda takes pinhole cameras only; undistort its images, "
                    "or use device cpu, which renders through the lens"
                )
        return super()._ingest(views)

    def _one_step(self, progress: float) -> tuple[float | None, int, int, int]:
        s, cloud = self.settings, self.cloud
        picked, _ = self._choose_tiles(step_key(s.seed, self.step))
        params = torch.tensor(cloud.params, device=self._device, requires_grad=True)
        pixels, square, lost = 0, 0.0, 0
        drawn = torch.zeros(len(cloud), device=self._device)
        errors = []
        for k in picked.tolist():
            error, info = self._residuals(params, k)
            errors.append(float(error.detach().abs().amax(dim=-1).median()))
            weight = self._weight(k)
            loss = (weight * (error.abs() if s.loss == "l1" else error.square())).sum()
            if not bool(torch.isfinite(loss)):
                lost += 1
                continue
            if info["means2d"].requires_grad:
                info["means2d"].retain_grad()
            if loss.requires_grad:
                loss.backward()
            drawn += self._record_statistics(info, float(self._cams[k, SIZE]))
            pixels += error.shape[0] * error.shape[1]
            square += float((weight * error.detach().square()).sum())
        if self._judge_step(picked, np.nan_to_num(errors, nan=1.0).tolist()):
            self._finish_step()
            return None, pixels, 0, lost
        gradient = np.zeros_like(cloud.params) if params.grad is None else params.grad.cpu().numpy()
        lost += int((~np.isfinite(gradient)).sum())
        self._adam(np.nan_to_num(gradient, posinf=0.0, neginf=0.0), drawn.cpu().numpy() > 0, progress)
        self._finish_step()
        return square / (3 * max(pixels, 1)), pixels, int(drawn.sum()), lost

    def _residuals(self, params: Tensor, k: int) -> tuple[Tensor, dict[str, Any]]:
        """Rendered minus true colors (H, W, 3) of view k, and gsplat's ``info``."""
        view, cam = self._views[k], torch.tensor(self._cams[k], device=self._device)
        lens = view.intrinsics
        pose = torch.eye(4, device=self._device)
        pose[:3, :3] = cam[:ORIGIN].view(3, 3)
        pose[:3, 3] = -pose[:3, :3] @ cam[ORIGIN:LENS]
        camera = torch.tensor([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]], device=self._device)
        direction = torch.nn.functional.normalize(params[:, :3] - cam[ORIGIN:LENS], dim=-1)
        count = self.settings.harmonics
        coefficients = params[:, COLOR + 3 :].view(len(params), count - 1, 3)
        colors = params[:, COLOR : COLOR + 3]
        colors = colors + (coefficients * harmonics_of(count, direction)[..., None]).sum(dim=1)
        back = torch.tensor(self.view_store.background(), device=self._device)
        if self.settings.background == "random":
            back = torch.tensor(self._rng(6).random(3), dtype=torch.float32, device=self._device)
        # gsplat divides by the number of Gaussians: without any the whole process would end.
        rasterize = self._rasterize if len(params) else _background
        color, _, info = rasterize(
            means=params[:, :3] + float(cam[TIME]) * torch.tensor(self.cloud.velocity, device=self._device),
            quats=params[:, QUATERNION:OPACITY],
            scales=params[:, SCALE:QUATERNION].clamp(SCALE_LOW, SCALE_HIGH).exp(),
            opacities=params[:, OPACITY].clamp(-RAW_OPACITY, RAW_OPACITY).sigmoid(),
            colors=colors,
            viewmats=pose[None],
            Ks=camera[None],
            width=lens.width,
            height=lens.height,
            near_plane=float(cam[NEAR]),
            backgrounds=back[None],
            packed=False,
        )
        image = torch.tensor(view.image, device=self._device, dtype=torch.float32) / 255.0
        target = image[..., :3]
        if image.shape[2] == 4:
            target = target * image[..., 3:] + back * (1.0 - image[..., 3:])
        return color[0] - target, info

    def _weight(self, k: int) -> Tensor:
        """The weights of view k's pixels, (H, W, 1), or (1,) where all are 1."""
        weight, first = self._data.weight, self._data.first
        if weight.size == 0:
            return torch.ones(1, device=self._device)
        width, height = self._data.size[k]
        share = weight[first[k] : first[k + 1]].reshape(height, width, 1)
        return torch.tensor(share, device=self._device)

    def _record_statistics(self, info: dict[str, Any], width: float) -> Tensor:
        """Record the statistics for densification; returns which Gaussians were drawn, (N,)."""
        radii = info["radii"][0]
        radii = radii.amax(dim=-1) if radii.ndim == 2 else radii  # newer versions have one for each axis
        drawn = radii > 0
        gradient = info["means2d"].grad
        if gradient is not None:
            self.cloud.slope += (gradient[0].norm(dim=-1) * width * drawn).cpu().numpy()
        self.cloud.looks += drawn.float().cpu().numpy()
        # gsplat's radius is three standard deviations.
        np.maximum(self.cloud.reach, (radii.float() / (3.0 * width)).cpu().numpy(), out=self.cloud.reach)
        return drawn.float()

    def _adam(self, g: NDArray[np.float32], drawn: NDArray[np.bool_], progress: float) -> None:
        """The rule of ``kernels.optimizer_step``, in numpy."""
        rule, cloud = self._adam_parameters(progress), self.cloud
        g = np.clip(np.nan_to_num(g, nan=0.0), -GRADIENT_LIMIT, GRADIENT_LIMIT)
        if rule.fade > 0:
            alpha = 1.0 / (1.0 + np.exp(-cloud.params[:, OPACITY]))
            g[:, OPACITY] += rule.fade * alpha * (1.0 - alpha)
        cloud.age[drawn] += 1
        correct = rule.corrections[np.minimum(cloud.age[drawn], len(rule.corrections) - 1)]
        m = rule.beta1 * cloud.m[drawn] + (1.0 - rule.beta1) * g[drawn]
        v = rule.beta2 * cloud.v[drawn] + (1.0 - rule.beta2) * g[drawn] ** 2
        cloud.m[drawn], cloud.v[drawn] = m, v
        step = rule.rates * m * correct[:, :1] * correct[:, 2:] / (np.sqrt(v * correct[:, 1:2]) + rule.epsilon)
        step[:, :SCALE] *= np.maximum(np.abs(cloud.params[drawn, :3]).max(axis=1), 1.0)[:, None]
        cloud.params[drawn] -= step
        clamp_gaussians(cloud.params, rule.largest, rule.thinnest)


def _background(
    *, means: Tensor, width: int, height: int, backgrounds: Tensor, **_: Any
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """What ``Rasterize`` returns where there are no Gaussians."""
    color = backgrounds[:, None, None].expand(-1, height, width, -1)
    none = means.new_zeros((1, 0, 2))
    return color, means.new_zeros((1, height, width, 1)), {"means2d": none, "radii": none.int()}


def make_cuda(settings: SplatSettings) -> SplatField:
    """A field on the CUDA device. ValueError where torch sees none or gsplat is not installed."""
    if not torch.cuda.is_available():
        raise ValueError("splat: device is cuda, but torch finds no CUDA device; use device cpu or auto")
    try:
        from gsplat import rasterization
    except ImportError:
        raise ValueError('splat: device cuda needs gsplat: pip install "freshfield[cuda]", or use device cpu') from None
    return GsplatField(settings, rasterization)
