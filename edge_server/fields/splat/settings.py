"""Settings of the Gaussian field: one dataclass whose texts become help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from edge_server.fields.common.trainer_settings import FieldSettings, option


@dataclass(frozen=True)
class SplatSettings(FieldSettings):
    """The options of a ``SplatField``. Lengths in meters; None means: found from the cameras."""

    name = "splat"
    has_cuda = True

    gaussians: int = option(8192, "largest number of Gaussians")
    start: int = option(4096, "number of Gaussians at the start, at most ``gaussians``")
    harmonics: int = option(1, "view dependence of color: 1 (none), 4 or 9 spherical harmonics")
    views_a_step: int = option(1, "number of views that a training step uses")
    loss: str = option("mse", "color loss: mse (squared errors) or l1 (absolute errors)")
    dssim: float = option(0.0, "weight of (1 - SSIM) / 2, tile by tile (Kerbl et al.: 0.2 beside l1)")
    seed_cells: int = option(64, "cells a side of the grid that gives initial positions; 0: random ones")
    seed_scale: float = option(0.5, "initial scale of Gaussians, in distances to their neighbors")
    seed_opacity: float = option(0.3, "opacity of new Gaussians")
    near_m: float | None = option(
        None, "near plane, meters: nothing closer to a camera is rendered; None: found from the cameras"
    )
    min_views: int = option(2, "no Gaussian starts where fewer cameras than this look")
    rate_position: float = option(0.4, "learning rate of positions at the start of a fit, in pixels")
    rate_scale: float = option(0.08, "learning rate of the logarithms of scales")
    rate_rotation: float = option(0.02, "learning rate of quaternions")
    rate_opacity: float = option(0.15, "learning rate of opacities before the sigmoid")
    rate_color: float = option(0.02, "learning rate of colors; a tenth of it for harmonics")
    settle_after: float = option(300.0, "steps for which a Gaussian trains at full rates; then they fall as 1 / steps")
    rate_settled: float = option(0.1, "minimum share of the full rates, reached after ``settle_after``")
    epsilon: float = option(1e-3, "Adam's epsilon, on gradients summed over pixels")
    fade: float = option(0.0, "penalty on opacity: removes Gaussians that no view needs")
    densify_every: int = option(
        50, "minimum number of steps between densifications, and at least one pass over all views"
    )
    grow: float = option(0.15, "share of Gaussians split by a densification, largest gradient first")
    prune: float = option(0.02, "opacity below which Gaussians are removed")
    opacity_reset: int = option(0, "steps after which opacities are lowered to a tenth; 0: never")
    largest: float = option(0.5, "largest standard deviation in scene units (half the box's side is 1)")
    widest: float = option(0.2, "share of an image's width above which Gaussians are split first")
    aspect: float = option(20.0, "largest ratio of longest to shortest axis")
    changed_share: float = option(0.25, "share of steps that train only on tiles that changed")
    follow: int = option(8, "steps at the start of an update that track moving Gaussians; 0: none")
    reseed: float = option(0.25, "largest share of ``gaussians`` that is seeded anew where something moved")
    flatten: float = option(0.0, "decrease a step of each Gaussian's smallest log scale, for surfaces (.02); 0: none")
    align: float = option(
        0.0, "share by which Gaussians turn to the normals of the rendered depth, for surfaces (.3); 0: none"
    )
    align_every: int = option(5, "steps between two alignments")
    layers: bool = option(
        False, "plates, a static field and a moving set instead of one field, where cameras stand still"
    )

    def __post_init__(self) -> None:
        self._within(
            ("gaussians", 1, 1 << 20),
            ("start", 1, 1 << 20),
            ("views_a_step", 1, 64),
            ("seed_cells", 0, 256),
            ("densify_every", 1, 1 << 30),
            ("opacity_reset", 0, 1 << 30),
            ("follow", 0, 1000),
            ("settle_after", 1.0, 1e9),
            ("rate_settled", 0.0, 1.0),
            ("dssim", 0.0, 1e3),
            ("seed_scale", 0.01, 100.0),
            ("seed_opacity", 0.001, 0.99),
            ("fade", 0.0, 1e3),
            ("grow", 0.0, 1.0),
            ("prune", 0.0, 0.9),
            ("largest", 1e-3, 50.0),
            ("widest", 1e-3, 1e3),
            ("aspect", 1.0, 1e4),
            ("reseed", 0.0, 1.0),
            ("rate_position", 0.0, 100.0),
            ("rate_scale", 0.0, 10.0),
            ("rate_rotation", 0.0, 10.0),
            ("rate_opacity", 0.0, 10.0),
            ("rate_color", 0.0, 10.0),
            ("flatten", 0.0, 1.0),
            ("align", 0.0, 1.0),
            ("align_every", 1, 1 << 30),
        )
        for name, allowed in (("harmonics", (1, 4, 9)), ("loss", ("mse", "l1"))):
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"splat: {name} must be one of {', '.join(map(str, allowed))}, not {getattr(self, name)!r}"
                )
        if self.layers and self.device == "cuda":
            raise ValueError("splat: layers work on the CPU: device must be cpu or auto, not cuda")
        super().__post_init__()

    @property
    def planar(self) -> bool:
        """Whether Gaussians are made flat, so that depth is rendered from their planes."""
        return self.flatten > 0.0 or self.align > 0.0

    @property
    def scale_bounds(self) -> tuple[np.float32, np.float32]:
        """``largest``, and the logarithm of ``aspect``, as ``kernels.optimizer_step`` takes them."""
        return np.float32(self.largest), np.float32(np.log(self.aspect))


SETTINGS = SplatSettings
EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"gaussians": 4096, "start": 2048},
    "medium": {},
    "high": {"gaussians": 32768, "start": 8192},
}
