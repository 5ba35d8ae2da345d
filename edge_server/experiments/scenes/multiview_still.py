"""Views of one instant, by name: of a synthetic scene or a recorded data set."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic import make_scene
from camera_node.synthetic.scene import HELD_OUT, Scene
from edge_server.experiments.scenes.recorded import LEAST_WEIGHT, MultiviewStill
from edge_server.fidelity.baselines import baseline
from edge_server.fidelity.images import BLACK, Color
from edge_server.fidelity.refined import render_refined, with_refined
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fields import Field, View

WHITE: Color = (1.0, 1.0, 1.0)


def synthetic_still(name: str, cameras: int = 19, size: int = 128, t_s: float = 0.0) -> MultiviewStill:
    """The cameras of scene ``name`` at one instant, ``size`` pixels a side; cam00 is held out. Raises
    camera_node's SceneError."""
    scene = make_scene(name, {"count": cameras, "width": size, "height": size})
    views = [View(c, scene.render(c, t_s), pose, lens) for c, (lens, pose) in scene.cameras.items()]
    held_out = tuple(v for v in views if v.camera == HELD_OUT)
    return MultiviewStill(name, tuple(v for v in views if v.camera != HELD_OUT), held_out, Path(name))


def mean_baselines(training: Sequence[View], held_out: Sequence[View], color: Color = BLACK) -> dict[str, float | None]:
    """PSNR of the baselines without a field, as means over the held-out views; None without any, or with masks. color:
    the background."""
    masked = any(v.weight is not None for v in held_out)  # the baselines know no masks
    found = [] if masked else [baseline(training, v.image, v.camera_to_world, color) for v in held_out]
    names = ("mean_colour_db", "nearest_view_db")
    return {name: statistics.fmean(getattr(b, name) for b in found) if found else None for name in names}


def known_options(scene: Scene, nearest_m: float) -> dict[str, Any]:
    """Options of a field for a scene whose place and background are known. nearest_m: least distance of
    cameras."""
    low, high = scene.bounds
    return {
        "centre_m": [float(c) for c in 0.5 * (low + high)],
        "radius_m": float(0.5 * (high - low).max()) + 0.01,
        "near_m": nearest_m,
        "contracted": False,
        "background": "#" + "".join(f"{round(255 * c):02x}" for c in scene.world.background),
    }


def score_views(field: Field, views: Sequence[View], scorer: Scorer) -> tuple[Score, NDArray[np.float32]]:
    """Mean score over ``views``, within their masks, and the rendering (H, W, 3) of the first, at the field's
    correction if it has one."""
    scores, shown = [], None
    for view in views:
        mask = None if view.weight is None else view.weight > LEAST_WEIGHT
        image = field.render(view.camera_to_world, view.intrinsics).color
        score = scorer.score(view.camera, image, 0, view.image, 0, mask=mask)
        refined = render_refined(field, view)
        scores.append(with_refined(score, refined, view, scorer, mask))
        shown = (image if refined is None else refined) if shown is None else shown
    assert shown is not None
    return mean_score(scores), shown
