"""Settings of the Gaussian field: one dataclass whose texts become help."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from edge_server.fields.common.trainer_settings import COMMON_BOUNDS, MOST_THREADS, copy_option
from edge_server.fields.common.trainer_settings import option as _option


@dataclass(frozen=True)
class SplatSettings:
    """The options of a ``SplatField``. Lengths in meters; None means: found from the cameras."""

    gaussians: int = _option(8192, "largest number of Gaussians")
    start: int = _option(4096, "number of Gaussians at the start, at most ``gaussians``")
    harmonics: int = _option(1, "view dependence of color: 1 (none), 4 or 9 spherical harmonics")
    views_a_step: int = _option(1, "views that a step trains on")
    tile_share: float = _option(1.0, "share of these views' tiles that a step trains on")
    loss: str = _option("mse", "mse or l1")
    dssim: float = _option(0.0, "weight of (1 - SSIM) / 2, tile by tile (Kerbl et al.: 0.2 beside l1)")
    seed_cells: int = _option(64, "cells a side of the grid that finds first positions; 0: random positions")
    seed_scale: float = _option(0.5, "first scale of Gaussians, in distances to their neighbors")
    seed_opacity: float = _option(0.3, "opacity of new Gaussians")
    centre_m: tuple[float, float, float] | None = _option(None, "center of the scene's box")
    radius_m: float | None = _option(None, "half the side of the scene's box")
    near_m: float | None = _option(None, "near plane: nothing closer to a camera is rendered")
    contracted: bool | None = _option(None, "whether the scene goes on beyond its box (rooms, outdoors)")
    background: str = _option("auto", "auto (plain, or the mean color), white, black, random, or '#rrggbb'")
    min_views: int = _option(2, "no Gaussian starts where fewer cameras than this look")
    rate_position: float = _option(0.4, "learning rate of positions at the start of a fit, in pixels")
    rate_scale: float = _option(0.08, "learning rate of the logarithms of scales")
    rate_rotation: float = _option(0.02, "learning rate of quaternions")
    rate_opacity: float = _option(0.15, "learning rate of opacities before the sigmoid")
    rate_color: float = _option(0.02, "learning rate of colors; a tenth of it for harmonics")
    rate_end: float = _option(0.1, "share of the learning rates that is left at the end of a fit")
    settle_after: float = _option(300.0, "steps of a Gaussian at full rates; then they fall as 1 / steps")
    rate_settled: float = _option(0.1, "share of the rates below which they do not fall")
    epsilon: float = _option(1e-3, "Adam's epsilon, on gradients summed over pixels")
    fade: float = _option(0.0, "penalty on opacity: removes Gaussians that no view needs")
    densify_every: int = _option(50, "steps between densifications, at least one pass over all views")
    grow: float = _option(0.15, "share of Gaussians split by a densification, largest gradient first")
    prune: float = _option(0.02, "opacity below which Gaussians are removed")
    opacity_reset: int = _option(0, "steps after which opacities are lowered to a tenth; 0: never")
    largest: float = _option(0.5, "largest standard deviation in scene units (half the box's side is 1)")
    widest: float = _option(0.2, "share of an image's width above which Gaussians are split first")
    aspect: float = _option(20.0, "largest ratio of longest to shortest axis")
    changed_share: float = _option(0.25, "share of steps that train only on tiles that changed")
    follow: int = _option(8, "steps at the start of an update that track moving Gaussians; 0: none")
    reseed: float = _option(0.25, "largest share of ``gaussians`` that is seeded anew where something moved")
    flatten: float = _option(
        0.0, "decrease a step of each Gaussian's smallest log scale, for surfaces (.02); 0: none"
    )
    align: float = _option(
        0.0, "share by which Gaussians turn to the normals of the rendered depth, for surfaces (.3); 0: none"
    )
    align_every: int = _option(5, "steps between two alignments")
    layers: bool = _option(
        False, "plates, a static field and a moving set instead of one field, where cameras stand still"
    )
    age_tau_ms: float = copy_option("age_tau_ms")
    mask_stale_ms: float = copy_option("mask_stale_ms")
    mask_grow_px_s: float = copy_option("mask_grow_px_s")
    refuse_beyond: float = copy_option("refuse_beyond")
    seed: int = _option(0, "seed of initial values and of all sampling")
    threads: int | None = _option(None, "worker threads; results do not depend on it. None: all cores")
    nice: int = _option(0, "how far workers lower their own priority (Linux); in a server 5")
    device: str = _option("auto", "cpu (numba) or cuda (gsplat, only where asked for); auto: cpu")

    def __post_init__(self) -> None:
        for name, low, high in (
            ("gaussians", 1, 1 << 20), ("start", 1, 1 << 20), ("views_a_step", 1, 64), ("seed_cells", 0, 256),
            ("densify_every", 1, 1 << 30), ("opacity_reset", 0, 1 << 30),
            ("follow", 0, 1000), ("settle_after", 1.0, 1e9), ("rate_settled", 0.0, 1.0),
            ("tile_share", 0.01, 1.0), ("dssim", 0.0, 1e3), ("seed_scale", 0.01, 100.0),
            ("seed_opacity", 0.001, 0.99), ("fade", 0.0, 1e3),
            ("grow", 0.0, 1.0), ("prune", 0.0, 0.9), ("largest", 1e-3, 50.0), ("widest", 1e-3, 1e3),
            ("aspect", 1.0, 1e4), ("reseed", 0.0, 1.0),
            ("rate_position", 0.0, 100.0), ("rate_scale", 0.0, 10.0), ("rate_rotation", 0.0, 10.0),
            ("rate_opacity", 0.0, 10.0), ("rate_color", 0.0, 10.0), ("flatten", 0.0, 1.0),
            ("align", 0.0, 1.0), ("align_every", 1, 1 << 30), *COMMON_BOUNDS,
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"splat: {name} must be in {low}..{high}, not {getattr(self, name)}")
        if self.threads is not None and not 1 <= self.threads <= MOST_THREADS:
            raise ValueError(f"splat: threads must be in 1..{MOST_THREADS}, not {self.threads}")
        for name, allowed in (
            ("harmonics", (1, 4, 9)), ("loss", ("mse", "l1")), ("device", ("auto", "cpu", "cuda")),
        ):  # fmt: skip
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"splat: {name} must be one of {', '.join(map(str, allowed))}, "
                    f"not {getattr(self, name)!r}"
                )
        named = self.background in ("auto", "white", "black", "random")
        if not named and not re.fullmatch("#[0-9a-fA-F]{6}", self.background):
            raise ValueError(
                "splat: background must be auto, white, black, random or a color like '#80c0ff', "
                f"not {self.background!r}"
            )
        if self.layers and self.device == "cuda":
            raise ValueError("splat: layers work on the CPU: device must be cpu or auto, not cuda")
        for name in ("radius_m", "near_m"):
            if getattr(self, name) is not None and not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"splat: {name} must be positive, not {getattr(self, name)}")

    @property
    def planar(self) -> bool:
        """Whether Gaussians are made flat, so that depth is rendered from their planes."""
        return self.flatten > 0.0 or self.align > 0.0

    @property
    def scale_bounds(self) -> tuple[np.float32, np.float32]:
        """``largest``, and the logarithm of ``aspect``, as ``kernels.optimizer_step`` takes them."""
        return np.float32(self.largest), np.float32(np.log(self.aspect))


EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"gaussians": 4096, "start": 2048},
    "medium": {},
    "high": {"gaussians": 32768, "start": 8192},
}


def make_settings(options: dict[str, Any], seed: int = 0) -> SplatSettings:
    """Settings from plain options (a scenario's ``field`` section).

    options: ``effort`` (low, medium, high) names a preset that the other options override.

    ValueError: an unknown option (the valid ones are listed), or a wrong value.
    """
    options = dict(options)
    effort = options.pop("effort", "medium")
    if effort not in EFFORTS:
        raise ValueError(f"splat: effort must be one of {', '.join(EFFORTS)}, not {effort!r}")
    valid = [f.name for f in fields(SplatSettings)]
    unknown = sorted(set(options) - set(valid))
    if unknown:
        raise ValueError(f"splat has no option {', '.join(unknown)}; it has: effort, {', '.join(valid)}")
    if options.get("centre_m") is not None:
        options["centre_m"] = tuple(float(c) for c in options["centre_m"])
    return replace(SplatSettings(), **{"seed": seed, **EFFORTS[effort], **options})


def help_text() -> dict[str, str]:
    """Help text of each option, for command lines and documentation."""
    return {f.name: f.metadata["help"] for f in fields(SplatSettings)}
