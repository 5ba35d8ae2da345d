"""A run's mesh against the surface that its cameras saw, where that is known: of a still synthetic scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from camera_node.config import WorldConfig, source_config
from edge_server.experiments.scenes.tile_scan import Scan, surface_truth
from edge_server.experiments.virtual.from_scenario import exact_scene
from edge_server.fields import View
from edge_server.surface.mesh import Mesh
from edge_server.surface.metrics import TARGET_CHAMFER_MM, TARGET_COMPLETE, WITHIN_M, compare
from freshfield.scenario import load

# Between points of the truth: half of what counts as complete, and seconds instead of minutes of casting.
SPACING_M = 0.5 * WITHIN_M


def compare_with_scene(mesh: Mesh, scenario: str, views: Sequence[View]) -> tuple[dict[str, Any] | None, str]:
    """What ``edge-server export --measure`` does: ``distances``, and one line for people."""
    found = distances(mesh, scenario, views)
    if found is None:
        return None, "not measured: the true surface is known of synthetic scenes that stand still"
    return found, (
        f"chamfer {found['chamfer_mm']:.2f} mm (target {found['target_chamfer_mm']:g}), "
        f"{100 * found['complete']:.1f} % of the surface within {found['within_mm']:g} mm "
        f"(target {100 * found['target_complete']:g})"
    )


def distances(mesh: Mesh, scenario: str, views: Sequence[View]) -> dict[str, Any] | None:
    """``surface.metrics.Comparison`` of a mesh with what cameras see of a scenario's scene, and the targets.

    None where nobody knows the surface: recorded data, real cameras, a scene that moves. Raises
    ScenarioError, and SurfaceError where one of the two is empty.
    """
    loaded = load(scenario)
    source = source_config(loaded)
    if not isinstance(source, WorldConfig):
        return None
    scene, _ = exact_scene(loaded, source)
    if scene.moving:
        return None
    found = compare(mesh, surface_truth(Scan(scene, tuple(views)), SPACING_M))
    return {
        **dataclasses.asdict(found),
        "within_mm": 1e3 * WITHIN_M,
        "target_chamfer_mm": TARGET_CHAMFER_MM,
        "target_complete": TARGET_COMPLETE,
    }
