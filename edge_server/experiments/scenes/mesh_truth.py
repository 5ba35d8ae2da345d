"""Compares a run's mesh with the true surface that its cameras saw, which is known for static synthetic
scenes."""

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

# Spacing of the points of the truth: half the distance that counts as complete; casting the rays then takes
# seconds instead of minutes.
SPACING_M = 0.5 * WITHIN_M


def compare_with_scene(scenario: str) -> Callable[[Mesh, Sequence[View]], tuple[dict[str, Any] | None, str]]:
    """The function with which ``edge-server export --measure`` measures a mesh: it returns ``distances`` and
    one line of text. Raises ScenarioError immediately, before there is a mesh."""
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
    """A scenario's scene; None if its surface is unknown: with recorded data, real cameras or a moving scene.
    Raises ScenarioError."""
    loaded = load(scenario)
    source = source_config(loaded)
    if not isinstance(source, WorldConfig):
        return None
    scene, _ = exact_scene(loaded, source)
    return None if scene.moving else scene


def distances(mesh: Mesh, scene: Scene, views: Sequence[View]) -> dict[str, Any]:
    """The ``surface.metrics.Comparison`` of a mesh with the surface that cameras see of a scene, and the
    targets. Raises SurfaceError if one of the two is empty."""
    found = compare(mesh, surface_truth(Scan(scene, tuple(views)), SPACING_M))
    return {
        **dataclasses.asdict(found),
        "within_mm": 1e3 * WITHIN_M,
        "target_chamfer_mm": TARGET_CHAMFER_MM,
        "target_complete": TARGET_COMPLETE,
    }
