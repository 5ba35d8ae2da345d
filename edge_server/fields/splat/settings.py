"""Settings of the Gaussian field: options that a scenario may set, and the numbers that were tuned once.

The texts of the options become help. Numbers of the layers stand in ``layers.settings``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from edge_server.fields.common.trainer_settings import FieldSettings, option

# Seeding: scale of new Gaussians in distances to their neighbors, their opacity, and pixels tried for each,
# because those whose rays meet no surface are discarded.
SEED_SCALE, SEED_OPACITY, SEED_CANDIDATES = 0.5, 0.3, 4

# Learning rates at the start of a fit: positions in pixels; logarithms of scales; quaternions; opacities
# before the sigmoid; colors, and further spherical harmonics.
RATE_POSITION, RATE_SCALE, RATE_ROTATION, RATE_OPACITY = 0.4, 0.08, 0.02, 0.15
RATE_COLOR, RATE_HARMONICS = 0.02, 0.002
# A Gaussian trains at full rates for SETTLE_STEPS steps; then they fall as 1 / steps, down to RATE_SETTLED.
SETTLE_STEPS, RATE_SETTLED = 300.0, 0.1

# Density control: share of Gaussians that are split at once, those of largest gradient first; opacity below
# which they are removed; share of an image's width above which they are split first.
GROW_SHARE, PRUNE_OPACITY, WIDEST = 0.15, 0.02, 0.2
SPLIT_SHRINK = 1.6  # divides the scales of both halves of a split Gaussian (Kerbl et al.)
SHARP_PX = 1.0  # Gaussians about this wide in the image are cloned without shrinking

# Bounds of parameters.
POSITION_LIMIT = 100.0  # scene units
LARGEST, ASPECT = 0.5, 20.0  # standard deviation, times the distance from the center; longest to shortest axis
LOG_SCALE_LOW, LOG_SCALE_HIGH = -12.0, 4.0
RAW_OPACITY_LIMIT = 9.0  # before the sigmoid: 1.2e-4 to .99988
COLOR_LOW, COLOR_HIGH = -0.5, 1.5  # a Gaussian's color may leave [0, 1] a little: rendered ones are clamped
GRADIENT_LIMIT = 1e6
# Of what a Gaussian adds to one pixel. At most: no Gaussian hides everything, and an alpha that is clamped has
# no gradient. At least: a Gaussian ends where its alpha is lower.
ALPHA_MAX, ALPHA_MIN = 0.99, 1.0 / 255.0

ALIGN_EVERY = 5  # steps between two alignments with the rendered normals


@dataclass(frozen=True)
class SplatSettings(FieldSettings):
    """The options of a Gaussian field. Lengths in meters; None means: found from the cameras."""

    name = "splat"

    gaussians: int = option(8192, "largest number of Gaussians")
    start: int = option(4096, "number of Gaussians at the start, at most ``gaussians``")
    harmonics: int = option(1, "view dependence of color: 1 (none), 4 or 9 spherical harmonics")
    seed_cells: int = option(64, "cells a side of the grid that gives initial positions")
    epsilon: float = option(1e-3, "Adam's epsilon, on gradients summed over pixels")
    densify_every: int = option(
        50, "minimum number of steps between densifications, and at least one pass over all views"
    )
    flatten: float = option(0.0, "decrease a step of each Gaussian's smallest log scale, for surfaces (.02); 0: none")
    align: float = option(
        0.0, "share by which Gaussians turn to the normals of the rendered depth, for surfaces (.3); 0: none"
    )
    layers: bool = option(
        False, "background plates, a still field and a moving set instead of one field, where cameras stand still"
    )

    def __post_init__(self) -> None:
        self._within(
            ("gaussians", 1, 1 << 20),
            ("start", 1, 1 << 20),
            ("seed_cells", 8, 256),
            ("densify_every", 1, 1 << 30),
            ("flatten", 0.0, 1.0),
            ("align", 0.0, 1.0),
        )
        if self.harmonics not in (1, 4, 9):
            raise ValueError(f"splat: harmonics must be one of 1, 4, 9, not {self.harmonics!r}")
        super().__post_init__()

    @property
    def planar(self) -> bool:
        """Whether Gaussians are made flat, so that depth is rendered from their planes."""
        return self.flatten > 0.0 or self.align > 0.0


SETTINGS = SplatSettings
EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"gaussians": 4096, "start": 2048},
    "medium": {},
    "high": {"gaussians": 32768, "start": 8192},
}
