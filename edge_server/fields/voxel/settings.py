"""Settings of the voxel field; their texts become help and error messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.trainer_settings import FieldSettings, option


@dataclass(frozen=True)
class VoxelSettings(FieldSettings):
    """What can be chosen about a ``VoxelField``. Lengths in meters; None: found from the cameras."""

    name = "voxel"

    sizes: tuple[int, ...] | None = option(None, "vertices a side, coarse to fine; None: to about a pixel")
    refine_at: tuple[int, ...] = option((15, 40, 80), "steps after which the next of ``sizes`` is taken")
    rays: int = option(8192, "rays in one training step")
    rate: float = option(0.05, "learning rate of density at the start of a fit")
    rate_color: float = option(0.06, "learning rate of color at the start of a fit")
    settle: float = option(3.0, "passes over all pixels, after which a fit's rates decay as 1 / steps; 0: never")
    warm: float = option(0.3, "share of the rates that a fit uses if it starts from a grid at its final size")
    soften: float = option(0.2, "cap on the optical depth of one step where something moved")
    growth: float = option(20.0, "density x has 1 + growth x times the learning rate ``rate``")
    l1: float = option(0.003, "L1 penalty on density, in learning rates: empties what no image needs")
    outline: float = option(0.25, "weight of the opacity loss, where alpha or a plain background gives the truth")
    diffuse: float = option(
        1.0, "share of the difference to its neighbors' mean that a vertex loses in four steps at full rates"
    )
    diffuse_edge: float = option(
        0.025, "largest difference between neighbors that ``diffuse`` counts, as a share of the range"
    )
    diffuse_views: int = option(32, "number of viewpoints above which ``diffuse`` falls in inverse proportion to them")
    first: float = option(0.1, "initial optical depth of one step")
    prune: float = option(0.2, "optical depth of one step below which a cell counts as empty")
    prune_from: int = option(15, "step from which empty cells are skipped and ``diffuse`` acts")
    cells: int = option(48, "cells a side of the occupancy grid, a multiple of 4")
    parts: int = option(2, "gradient buffers, the number of cores that train at once; results depend on it")

    def __post_init__(self) -> None:
        self._within(
            ("parts", 1, 64),
            ("rays", 1, 1 << 20),
            ("cells", 8, 256),
            ("first", 0.0, 4.0),
            ("rate", 0.0, 10.0),
            ("rate_color", 0.0, 10.0),
            ("settle", 0.0, 1e6),
            ("warm", 0.0, 1.0),
            ("growth", 0.0, 1e3),
            ("l1", 0.0, 1e2),
            ("outline", 0.0, 1e2),
            ("diffuse", 0.0, 1.0),
            ("diffuse_edge", 0.0, 1.0),
            ("diffuse_views", 1, 1 << 20),
            ("prune", 0.0, 4.0),
            ("prune_from", 0, 1 << 30),
            ("soften", 0.0, 4.0),
        )
        if self.cells % 4:
            raise ValueError(f"voxel: cells must be a multiple of 4, not {self.cells}")
        at = list(self.refine_at)
        if len(at) > 8:
            raise ValueError(f"voxel: refine_at has at most 8 step numbers, not {len(at)}")
        if at != sorted(set(at)) or any(step < 1 for step in at):
            raise ValueError(f"voxel: refine_at must be rising step numbers, not {at}")
        if self.sizes is not None:
            sizes = list(self.sizes)
            if not sizes or sizes != sorted(set(sizes)) or sizes[0] < 4 or sizes[-1] > 512:
                raise ValueError(f"voxel: sizes must be rising numbers in 4..512, not {sizes}")
            if len(at) != len(sizes) - 1:
                raise ValueError(f"voxel: refine_at must be {len(sizes) - 1} rising step numbers, not {at}")
        super().__post_init__()


SETTINGS = VoxelSettings
EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"sizes": (32, 64, 96), "refine_at": (15, 40)},
    "medium": {},
    "high": {"sizes": (32, 64, 96, 128, 192), "refine_at": (15, 40, 80, 200), "rays": 16384, "cells": 64},
}

COARSEST, FINEST = 64, 192  # last grid size chosen from the images: finer ones outgrow caches and patience


def sizes_of(settings: VoxelSettings, box: SceneBox | None) -> tuple[int, ...]:
    """Vertices a side at each stage: as set, or in even strides to the pixel that cameras see in ``box``."""
    if settings.sizes is not None:
        return settings.sizes
    pixels = box.pixels_across if box is not None else COARSEST
    stages = len(settings.refine_at) + 1
    last = -(-int(np.clip(pixels, COARSEST, FINEST)) // 32) * 32
    return tuple(last * (k + 1) // stages for k in range(stages))
