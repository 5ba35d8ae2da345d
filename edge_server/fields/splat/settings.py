"""Settings of the Gaussian field: options that a scenario may set. Their texts become help."""

from __future__ import annotations

from typing import Annotated

from edge_server.fields.common.settings import FieldSettings, ShDegree
from freshfield.settings import about, within


class SplatSettings(FieldSettings, frozen=True):
    """The options of a Gaussian field. Lengths in meters; None means: found from the cameras."""

    name = "splat"

    gaussians: Annotated[int, within(1, 1 << 20, "largest number of Gaussians")] = 8192
    start: Annotated[int, within(1, 1 << 20, "number of Gaussians at the start, at most ``gaussians``")] = 4096
    sh_degree: ShDegree = 0
    seed_cells: Annotated[int, within(8, 256, "cells a side of the grid that gives initial positions")] = 64
    epsilon: float = 1e-3
    densify_every: Annotated[
        int, within(1, 1 << 30, "minimum number of steps between densifications, and at least one pass over all views")
    ] = 50
    flatten: Annotated[
        float, within(0, 1, "decrease a step of each Gaussian's smallest log scale, for surfaces (.02); 0: none")
    ] = 0.0
    layers: Annotated[
        bool, about("background plates, a still field and a moving set instead of one field, where cameras stand still")
    ] = False

    scan: Annotated[
        bool, about("the views are of a scene that stands still, as photos or a video of it: seeds, growth and rates")
    ] = False
    refine: Annotated[
        bool, about("with ``scan``: learn each view's exposure, and correct its pose, as of a camera that was tracked")
    ] = False

    carried: Annotated[
        bool, about("with ``scan``: views come one after the other, from cameras that move, and keyframes are chosen")
    ] = False

    @property
    def module(self) -> str:
        """Layers, and what a scan needs, are imported only where they are asked for."""
        if self.layers:
            return "splat.layers.layered_field"
        return (
            f"splat.carried_camera.{'carried_field' if self.carried else 'scan_field'}" if self.scan else "splat.field"
        )

    @property
    def planar(self) -> bool:
        """Whether Gaussians are made flat, so that depth is rendered from their planes."""
        return self.flatten > 0.0


SETTINGS = SplatSettings
