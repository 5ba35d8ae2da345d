"""Views of one instant, by name: of a synthetic scene or a recorded data set."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.settings import WORLD_FPS
from camera_node.synthetic import SCENES, make_scene
from camera_node.synthetic.scene import HELD_OUT, Scene
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.arguments import OptionError
from edge_server.experiments.scenes.captures import SUFFIXES, load_captures
from edge_server.experiments.scenes.recorded import MultiviewStill, load_recorded
from edge_server.fidelity.baselines import baseline
from edge_server.fidelity.images import BLACK, Color
from edge_server.fidelity.refined import render_refined, with_refined
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fields import Field, View
from freshfield.scenario import SCENARIO_FOLDER

WHITE: Color = (1.0, 1.0, 1.0)


def synthetic_still(name: str, cameras: int = 19, size: int = tuned.STILL_SIZE_PX, t_s: float = 0.0) -> MultiviewStill:
    """The cameras of scene ``name`` at one instant, ``size`` pixels a side; cam00 is held out. Raises
    ScenarioError."""
    scene = make_scene(name, {"count": cameras, "width": size, "height": size})
    views = [View(c, scene.render(c, t_s), pose, lens) for c, (lens, pose) in scene.cameras.items()]
    held_out = tuple(v for v in views if v.camera == HELD_OUT)
    return MultiviewStill(name, tuple(v for v in views if v.camera != HELD_OUT), held_out, Path(name))


def open_still(
    data: Path, holdout: str | None = None, scale: float = 1.0, frame: int = 0, format: str | None = None
) -> MultiviewStill:
    """The views of a data set, of the carried camera of a scenario (its file, or the name of a shipped one), or of a
    synthetic scene by its name. A file or folder hides a scene or shipped scenario of its name.

    The arguments are those of ``load_recorded``. Raises DatasetError; OptionError for an argument that a scenario, or
    a synthetic scene, whose held-out camera is given, cannot have.
    """
    if _is_scenario(data):
        if scale != 1.0 or frame or format is not None:
            raise OptionError(f"--scale, --frame and --format are for data sets: {data} says its scale and its kind")
        return load_captures(data, holdout)
    if not _is_scene(data):
        return replace(load_recorded(data, holdout, scale, frame, format), name=data_name(data))
    for name, value in (("format", format), ("holdout", holdout)):
        if value is not None:
            raise OptionError(f"--{name} is for data sets; the scene {data} holds out {HELD_OUT}")
    t_s = frame / WORLD_FPS
    still = synthetic_still(str(data), size=max(8, round(tuned.STILL_SIZE_PX / scale)), t_s=t_s)
    return replace(still, instant=f"at {t_s:g} s")


def data_name(data: Path) -> str:
    """The name of a scene or data set in folders and reports."""
    if _is_scenario(data):
        return data.stem
    return str(data) if _is_scene(data) else (data if data.is_dir() else data.parent).resolve().name


def _is_scene(data: Path) -> bool:
    return str(data) in SCENES and not data.exists()


def _is_scenario(data: Path) -> bool:
    named = data.name == str(data) and data.name not in SCENES and not data.exists()
    shipped = named and (SCENARIO_FOLDER / f"{data}.yaml").is_file()
    return data.suffix in SUFFIXES or shipped


def mean_baselines(training: Sequence[View], held_out: Sequence[View], color: Color = BLACK) -> dict[str, float | None]:
    """PSNR of the baselines without a field, as means over the held-out views; None without any, or with masks. color:
    the background."""
    masked = any(v.weight is not None for v in held_out)  # the baselines know no masks
    found = [] if masked else [baseline(training, v.image, v.camera_to_world, color) for v in held_out]
    names = ("mean_color_db", "nearest_view_db")
    return {name: statistics.fmean(getattr(b, name) for b in found) if found else None for name in names}


def known_options(scene: Scene, nearest_m: float) -> dict[str, Any]:
    """Options of a field for a scene whose place and background are known. nearest_m: least distance of
    cameras."""
    low, high = scene.bounds
    return {
        "center_m": [float(c) for c in 0.5 * (low + high)],
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
        mask = None if view.weight is None else view.weight > tuned.LEAST_SCORED_WEIGHT
        image = field.render(view.camera_to_world, view.intrinsics).color
        score = scorer.score(view.camera, image, 0, view.image, 0, mask=mask)
        refined = render_refined(field, view)
        scores.append(with_refined(score, refined, view, scorer, mask))
        shown = (image if refined is None else refined) if shown is None else shown
    assert shown is not None
    return mean_score(scores), shown
