"""``NgpField`` for CUDA devices, in plain torch (also runs on a CPU, slowly, which is how it is tested).

The state is that of ``NgpField``: checkpoints load both ways. So are the settings, with three differences:
options in ``KERNEL_OPTIONS`` are refused; ``smooth`` and an automatic depth guide are ignored; so is
``batch_samples``: every ray of a step is used, however many samples it has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edge_server.fields import Budget, View
from edge_server.fields.common.field_state import load_arrays
from edge_server.fields.common.kernels.adam import GRADIENT_LIMIT, PARAMETER_LIMIT
from edge_server.fields.common.kernels.hash_grid import FEATURES
from edge_server.fields.common.kernels.rays import HORIZON, Views
from edge_server.fields.common.model_layout import init_net, make_grid
from edge_server.fields.common.occupancy_grid import EVERY, FADE, OccupancyGrid
from edge_server.fields.common.ray_snapshot import Pixels, PixelSnapshot
from edge_server.fields.common.scene_box import UNIT_BOX, SceneBox
from edge_server.fields.common.stepped_field import Step, SteppedField
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.training_schedule import (
    BETA1_FIELD,
    BETA2,
    NOMINAL_RAYS,
    StepBudget,
    StepTimer,
    active_levels,
    step_key,
    step_length,
)
from edge_server.fields.common.view_store import Arrays
from edge_server.fields.ngp.settings import STATE_SHAPE, NgpSettings
from edge_server.fields.ngp.torch_model import TorchGrid, encode, mlp, ray_losses, ray_weights, shade, to_torch
from freshfield.geometry import Pinhole

RENDER_RAYS = 8192  # rendered at a time
POINTS = 1 << 17  # encoded at a time where no gradient is wanted
UNCHECKED_STEPS = 32  # between two checks whether any ray goes on: a check waits for the device
KERNEL_OPTIONS = ("exposure", "refine_m", "refine_deg", "depth_guide")  # not implemented here


def unsupported_options(settings: NgpSettings) -> tuple[str, ...]:
    """Enabled options that only the kernels implement."""
    return tuple(name for name in KERNEL_OPTIONS if getattr(settings, name))


@contextmanager
def _deterministic() -> Iterator[None]:
    """Sum gradients in a fixed order where torch can (on CUDA, cumulative sums may not)."""
    before = torch.are_deterministic_algorithms_enabled()
    warn = torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before, warn_only=warn)


def cuda_present() -> bool:
    """Whether torch can use a CUDA device here."""
    return torch.cuda.is_available()


@dataclass(frozen=True)
class TorchSnapshot(PixelSnapshot):
    """``RaySnapshot`` of a torch field. occupied: uint8 (cells, cells, cells), z first. step_length: in scene
    units."""

    settings: NgpSettings
    box: SceneBox
    grid: TorchGrid
    levels: int
    widths: list[int]
    net: Tensor
    occupied: Tensor
    background: Tensor
    step_length: float
    cameras: tuple[View, ...]
    step: int

    def copied(self) -> TorchSnapshot:
        """See ``stepped_field.StepSnapshot``."""
        grid = replace(self.grid, table=self.grid.table.detach().clone())
        return replace(self, grid=grid, net=self.net.detach().clone())

    def march(self, o: Tensor, d: Tensor, jitter: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Origins and directions (R, 3), jitter (R,) -> t, delta (R, S), unit-cube points (R, S, 3) and
        which of them lie in occupied cells (R, S): ``kernels.rays.march`` without skipping."""
        box, s = self.box, self.settings
        step = self.step_length
        half = HORIZON if box.contracted else 1.0
        safe = torch.where(d.abs() < 1e-9, torch.full_like(d, 1e-9), d)
        a, b = (-half - o) / safe, (half - o) / safe
        enter = torch.minimum(a, b).amax(-1).clamp(min=box.near_m / box.radius_m)
        leave = torch.maximum(a, b).amin(-1)
        t = enter + jitter * step
        if box.contracted:
            last = torch.maximum(t, leave)
            ts: list[Tensor] = []
            deltas: list[Tensor] = []
            while not ts or bool((t < leave).any()):
                for _ in range(UNCHECKED_STEPS):
                    m = torch.linalg.vector_norm(torch.addcmul(o, t[:, None], d), torch.inf, dim=-1)
                    deltas.append(step * m.clamp(min=1.0).square())
                    ts.append(t)
                    t = torch.minimum(t + deltas[-1], last)  # or steps that grow with distance overflow
            t, delta = torch.stack(ts, -1), torch.stack(deltas, -1)
            most = max(int((t < leave[:, None]).any(0).sum()), 1)
            t, delta = t[:, :most], delta[:, :most]
        else:
            most = max(int(((leave - t).amax() / step).ceil()), 1)
            t = t[:, None] + step * torch.arange(most, device=t.device)
            delta = torch.full_like(t, step)
        p = torch.addcmul(o[:, None], t[..., None], d[:, None])
        if box.contracted:
            m = torch.linalg.vector_norm(p, torch.inf, dim=-1, keepdim=True).clamp(min=1.0)
            p = p * (2.0 - 1.0 / m) / m * 0.5
        u = (p * 0.5 + 0.5).clamp(0.0, 0.9999999)
        cell = (u * s.cells).long()
        inside = self.occupied[cell[..., 2], cell[..., 1], cell[..., 0]] > 0
        return t, delta, u, inside & (t < leave[:, None])

    def evaluate(self, points: Tensor) -> Tensor:
        """The network's output (N, outputs) for points (N, 3) in the unit cube."""
        # A whole picture's points would take gigabytes; a step's gradients need them all at once anyway.
        size = len(points) if torch.is_grad_enabled() else POINTS
        parts = points.split(max(size, 1))
        return torch.cat([mlp(self.widths, self.net, encode(self.grid, self.levels, part)) for part in parts])

    def query(self, d: Tensor, u: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Density (R, S) and color (R, S, 3) of marched samples; 0 where not ``inside``."""
        direction = d[:, None].expand(-1, u.shape[1], -1)[inside]
        sigma, color = shade(self.evaluate(u[inside]), self.settings.harmonics, direction)
        shape = inside.shape
        whole = torch.zeros(shape, device=u.device).masked_scatter(inside, sigma)
        colors = torch.zeros((*shape, 3), device=u.device)
        return whole, colors.masked_scatter(inside[..., None].expand(-1, -1, 3), color)

    @torch.no_grad()
    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> Pixels:
        """See ``PixelSnapshot``."""
        device, pose = self.net.device, np.asarray(camera_to_world, dtype=np.float64)
        rays = (intrinsics.rays(pixels) @ pose[:3, :3].T).astype(np.float32)
        origin = self.box.normalise(pose[:3, 3]).astype(np.float32)
        parts = []
        for a in range(0, len(rays), RENDER_RAYS):
            d = torch.as_tensor(rays[a : a + RENDER_RAYS], device=device)
            o = torch.as_tensor(origin, device=device).expand_as(d)
            t, delta, u, inside = self.march(o, d, torch.full((len(d),), 0.5, device=device))
            sigma, color = self.query(d, u, inside)
            weight, left = ray_weights(sigma, delta)
            opacity = 1.0 - left
            depth = (weight * t).sum(-1) / opacity.clamp(min=1e-3)
            rgb = (weight[..., None] * color).sum(1) + left[:, None] * self.background
            depth = torch.where(opacity > 1e-3, depth, torch.zeros_like(depth)) * self.box.radius_m
            parts.append((rgb.clamp(0, 1).cpu().numpy(), depth.cpu().numpy(), opacity.cpu().numpy()))
        color_, depth_, opacity_ = (np.concatenate(p) for p in zip(*parts))
        return color_, depth_, opacity_


class NgpTorchField(SteppedField[TorchSnapshot]):
    """``NgpField`` in torch. Raises ValueError for a missing device and for ``unsupported_options``."""

    name = NgpSettings.name
    shape = STATE_SHAPE
    settings: NgpSettings

    def __init__(self, settings: NgpSettings | None = None, device: str = "cuda", pool: Pool | None = None) -> None:
        settings = settings or NgpSettings()
        if missing := unsupported_options(settings):
            raise ValueError(f"ngp: {', '.join(missing)} needs device cpu: the torch field lacks it")
        self.device = device
        if self.device.startswith("cuda") and not cuda_present():
            raise ValueError("ngp: device cuda was asked for, but torch finds none here; use device cpu")
        super().__init__(settings, pool)

    def _begin_fit(self, views: Sequence[View], step_budget: StepBudget, budget: Budget) -> tuple[Step, int, int]:
        with self._lock:
            update = self.view_store.add(views)
            if update.box_changed:
                self._forget_parameters()
            if update.visibility_changed:
                self._occupancy.recount_views(self.pool, self.view_store)
            data = self.view_store.without_outliers(views, update, self.step, self._live())
        return partial(self._one_step, data), 0, 0

    def _run_kernels(self, pool: Pool) -> None:
        """Those of the occupancy grid; and the device's libraries, which take seconds to load."""
        camera, pose = Pinhole.from_fov(8, 8, 60.0), np.eye(4)
        pose[2, 3] = -3.0
        tiny = replace(self.settings, rays=16, log2_table=8, cells=8, min_views=1)
        field = NgpTorchField(tiny, self.device, pool)
        views = [View(f"warm-up {k}", np.full((8, 8, 3), 128, np.uint8), pose, camera) for k in range(3)]
        field.fit(views, Budget(steps=1))
        field.render(pose, camera)

    def _counters(self) -> dict[str, Any]:
        counters = {"step": self.step, "updates": self._updates, "dropped": self.dropped}
        return {**counters, "needed": self._occupancy.needed}

    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        load_arrays(arrays, state)
        for name, tensor in self._tensors().items():
            tensor.copy_(torch.as_tensor(arrays[name]))
        for name in ("density", "seen", "occupied"):
            getattr(self._occupancy, name)[...] = arrays[name]
        self._updates, self._occupancy.needed = int(meta["updates"]), int(meta["needed"])
        self._occupancy.update_occupied()

    # --- inside -------------------------------------------------------------------------------

    def _tensors(self) -> dict[str, Tensor]:
        names = ("table", "table_m", "table_v", "net", "net_m", "net_v")
        return dict(zip(names, (self._grid.table, *self._moments[0], self._net, *self._moments[1])))

    def _arrays(self) -> Arrays:
        o = self._occupancy
        arrays = {name: tensor.cpu().numpy() for name, tensor in self._tensors().items()}
        return {**arrays, "density": o.density, "seen": o.seen, "occupied": o.occupied}

    def _forget_parameters(self) -> None:
        rng = np.random.default_rng(np.random.SeedSequence(self.settings.seed))
        self.step = self._updates = 0
        self._snapshot = None
        self._step_time = StepTimer()
        self._grid = to_torch(make_grid(self.settings, self.view_store.box, rng), self.device)
        net = init_net(FEATURES * self.settings.levels, self.settings, rng)
        self._widths = net.widths.tolist()
        self._net = torch.as_tensor(net.params, device=self.device)
        self._moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in (self._grid.table, self._net)]
        self._occupancy: OccupancyGrid = OccupancyGrid.for_box(
            self.settings.cells, self.settings.min_views, self.view_store.box
        )

    def _live(self) -> TorchSnapshot:
        o, s = self._occupancy, self.settings
        occupied = torch.as_tensor(o.occupied, device=self.device).view(s.cells, s.cells, s.cells)
        return TorchSnapshot(
            settings=s,
            box=self.view_store.box or UNIT_BOX,
            grid=self._grid,
            levels=active_levels(s, self.step),
            widths=self._widths,
            net=self._net,
            occupied=occupied,
            background=torch.as_tensor(self.view_store.background(), device=self.device),
            step_length=step_length(s, self.step),
            cameras=self.view_store.views,
            step=self.step,
        )

    def _one_step(self, data: Views, progress: float) -> tuple[float, int, int, int]:
        s, box, model = self.settings, self.view_store.box, self._live()
        assert box is not None
        rng = np.random.default_rng(int(step_key(s.seed, self.step)))
        if self.step % EVERY == 0:
            self._refresh(model, rng)
            model = self._live()
        o, d, target, background, weight = self._draw(data, rng)
        jitter = torch.as_tensor(rng.random(len(d), dtype=np.float32), device=self.device)
        table = self._grid.table.requires_grad_(True)
        net = self._net.requires_grad_(True)
        t, delta, u, inside = model.march(o, d, jitter)
        sigma, color = model.query(d, u, inside)
        error, loss = ray_losses(sigma, color, t, delta, target, background, s.distortion)
        error, loss = error * weight, loss * weight
        good = torch.isfinite(error)
        with _deterministic():
            torch.where(good, loss, torch.zeros_like(loss)).sum().backward()
        self.step += 1
        self._updates += 1
        with torch.no_grad():
            scale, bad, rate_decay = NOMINAL_RAYS / len(d), int((~good).sum()), s.rate_end**progress
            rates = (s.rate * rate_decay, s.rate_net * rate_decay)
            for p, (m, v), rate, decay in zip((table, net), self._moments, rates, (s.decay, 0.0)):
                bad += self._adam(p, m, v, scale, rate, decay)
        self._grid.table.requires_grad_(False)
        self._net.requires_grad_(False)
        mean = error[good].mean().item() / 3.0 if bool(good.any()) else 0.0
        return mean, s.rays, int(inside.sum()), bad

    def _adam(self, p: Tensor, m: Tensor, v: Tensor, scale: float, rate: float, decay: float) -> int:
        """``kernels.adam``: entries without gradient, or with one that is not finite, stay as they are."""
        assert p.grad is not None
        g = p.grad * scale
        p.grad = None
        finite = torch.isfinite(g)
        use = finite & (g != 0)
        g = torch.where(use, g, torch.zeros_like(g)).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)
        m.copy_(torch.where(use, BETA1_FIELD * m + (1 - BETA1_FIELD) * g, m))
        v.copy_(torch.where(use, BETA2 * v + (1 - BETA2) * g * g, v))
        root = (v / (1 - BETA2**self._updates)).sqrt() + self.settings.epsilon
        new = p - rate * (m / (1 - BETA1_FIELD**self._updates) / root + decay * p)
        new = torch.where(use, new, p).nan_to_num(0.0, 0.0, 0.0)
        p.copy_(new.clamp(-PARAMETER_LIMIT, PARAMETER_LIMIT))
        return int((~finite).sum())

    def _draw(self, data: Views, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Origins, directions, targets and backgrounds (R, 3) of one step's rays, and their weights (R,)."""
        count = self.settings.rays
        pixel = rng.integers(0, len(data.drawn) or len(data.pixels), count)
        if len(data.drawn):
            pixel = data.drawn[pixel]
        if len(data.changed):
            moved = rng.choice(data.changed, count)
            pixel = np.where(rng.random(count) < self.settings.changed_share, moved, pixel)
        view = np.searchsorted(data.first, pixel, side="right") - 1
        local, width = pixel - data.first[view], data.size[view, 0]
        middle = np.stack([local % width + 0.5, local // width + 0.5], axis=-1)
        kinds, kind = np.unique(np.hstack([data.size, data.lens]), axis=0, return_inverse=True)
        rays = np.empty((count, 3))
        for k, (wide, high, fx, fy, cx, cy, *bent) in enumerate(kinds.tolist()):
            rows = np.flatnonzero(kind.reshape(-1)[view] == k)
            rays[rows] = Pinhole(int(wide), int(high), fx, fy, cx, cy, tuple(bent)).rays(middle[rows])
        directions = (data.rotation[view] @ rays[..., None])[..., 0].astype(np.float32)
        rgb = data.pixels[pixel].astype(np.float32) / 255.0
        background = np.broadcast_to(self.view_store.background(), (count, 3))
        if self.settings.background == "random":
            background = rng.random((count, 3), dtype=np.float32)
        alpha = rgb[:, 3:] if rgb.shape[1] == 4 else np.ones((count, 1), np.float32)
        target = rgb[:, :3] * alpha + background * (1 - alpha)
        weight = data.weight[pixel] if len(data.weight) else np.ones(count, np.float32)
        arrays = (data.origin[view].astype(np.float32), directions, target, background.copy(), weight)
        o, d, wanted, behind, counts = (torch.as_tensor(a, device=self.device) for a in arrays)
        return o, d, wanted, behind, counts

    @torch.no_grad()
    def _refresh(self, model: TorchSnapshot, rng: np.random.Generator) -> None:
        o, cells = self._occupancy, self.settings.cells
        axis = torch.arange(cells, device=self.device)
        corner = torch.cartesian_prod(axis, axis, axis).flip(-1)  # x fastest
        jitter = torch.as_tensor(rng.random(corner.shape, dtype=np.float32), device=self.device)
        points = (corner + jitter) / cells
        fresh = shade(model.evaluate(points), 1, points)[0]
        if o.contracted:
            m = ((corner + 0.5) * (4.0 / cells) - 2.0).abs().amax(-1)
            fresh = fresh * torch.where(m > 1.0, 1.0 / (2.0 - m).clamp(min=1e-6), torch.ones_like(m)).square()
        found = torch.where(torch.isfinite(fresh), fresh, torch.full_like(fresh, 1e3)).cpu().numpy()
        o.density[:] = np.where(o.seen >= o.needed, np.maximum(o.density * np.float32(FADE), found), 0.0)
        o.update_occupied()
