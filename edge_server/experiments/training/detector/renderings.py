"""Renderings of half-fitted and well-fitted fields, on which a perceptual distance is tested."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.scene import SCENES
from edge_server.experiments.common.progress import Progress
from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields import Budget, View
from edge_server.fields.registry import make_field

FIELD = "ngp"
# Optimizer steps between renderings.
STEPS = (15, 25, 60, 150, 250)
INSTANT_S = 0.4


def field_renderings(side: int, seed: int) -> tuple[NDArray[np.uint8], list[str]]:
    """Pairs of rendering and truth, uint8 (n, 2, side, side, 3), and the scene and steps of each. Every third
    camera of the shipped scenes is left out of the fit and rendered after each of ``STEPS``."""
    pairs, names = [], []
    progress = Progress(len(SCENES) * sum(STEPS))
    for scene in SCENES:
        still = synthetic_still(scene, size=side, t_s=INSTANT_S)
        views: list[View] = [*still.held_out, *still.training]
        known = [view for k, view in enumerate(views) if k % 3]
        field, steps = make_field(FIELD, {}, seed=seed), 0
        for more in STEPS:
            field.fit(known, Budget(steps=more))
            steps += more
            for view in views[::3]:
                shown = field.render(view.camera_to_world, view.intrinsics).color
                pairs.append((np.clip(np.rint(shown * 255.0), 0, 255).astype(np.uint8), view.image))
                names.append(f"{scene} {steps} steps")
            progress.advance(more)
        progress.report("field renderings", scene, f"{len(pairs)} pairs")
    return np.array(pairs), names
