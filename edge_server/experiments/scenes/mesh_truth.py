"""A run's mesh against the surface that its cameras saw, where that is known: of a still synthetic scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from camera_node.config import WorldConfig, source_config
from camera_node.synthetic.scene import Scene
from edge_server.experiments.scenes.tile_scan import Scan, surface_truth
from edge_server.experiments.virtual.from_scenario import exact_scene
from edge_server.fields import View
from edge_server.surface.mesh import Mesh
from edge_server.surface.metrics import TARGET_CHAMFER_MM, TARGET_COMPLETE, WITHIN_M, compare
from freshfield.scenario import load

# Between points of the truth: half of what counts as complete, and seconds instead of minutes of casting.
SPACING_M = 0.5 * WITHIN_M


def compare_with_scene(scenario: str) -> Callable[[Mesh, Sequence[View]], tuple[dict[str, Any] | None, str]]:
    """What ``edge-server export --measure`` does with a mesh: ``distances``, and one line for people. Raises
    ScenarioError at once, before there is a mesh."""
    return partial(_compare, still_scene(scenario))


def _compare(scene: Scene | None, mesh: Mesh, views: Sequence[View]) -> tuple[dict[str, Any] | None, str]:
    if scene is None:
        return None, "not measured: the true surface is known of synthetic scenes that stand still"
    found = distances(mesh, scene, views)
    return found, (
        f"chamfer {found['chamfer_mm']:.2f} mm (target {found['target_chamfer_mm']:g}), "
        f"{100 * found['complete']:.1f} % of the surface within {found['within_mm']:g} mm "
        f"(target {100 * found['target_complete']:g})"
    )


def still_scene(scenario: str) -> Scene | None:
    """A scenario's scene; None where nobody knows the surface: recorded data, real cameras, a scene that
    moves. Raises ScenarioError."""
    loaded = load(scenario)
    source = source_config(loaded)
    if not isinstance(source, WorldConfig):
        return None
    scene, _ = exact_scene(loaded, source)
    return None if scene.moving else scene


def distances(mesh: Mesh, scene: Scene, views: Sequence[View]) -> dict[str, Any]:
    """``surface.metrics.Comparison`` of a mesh with what cameras see of a scene, and the targets. Raises
    SurfaceError where one of the two is empty."""
    found = compare(mesh, surface_truth(Scan(scene, tuple(views)), SPACING_M))
    return {
        **dataclasses.asdict(found),
        "within_mm": 1e3 * WITHIN_M,
        "target_chamfer_mm": TARGET_CHAMFER_MM,
        "target_complete": TARGET_COMPLETE,
    }
