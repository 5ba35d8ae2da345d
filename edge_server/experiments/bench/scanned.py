"""Measures meshes of one object: the tile on its bench (scenario ``scan``), segmented in several ways.

The viewpoints are those of the scenario's arm. A field is fitted to whole images, to images cut by the
scenario's ``edge.foreground``, and by true masks. Each mesh is compared with the tile's surface, without bench and
tools: error, the share of the surface within 3 mm of the mesh, and the share of the mesh within 3 mm of the surface.
From whole images, a mesh is also made within the tile's bounding box, given by hand.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from time import perf_counter as _now
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.config import WorldConfig, source_config
from camera_node.synthetic.camera_rig import on_sphere
from camera_node.synthetic.scene import Scene, make_scene, pinhole
from edge_server.config import EdgeConfig, read_config
from edge_server.experiments.bench.run import BenchError, BenchRun
from edge_server.experiments.common.tables import markdown_table, number
from edge_server.experiments.scenes.tile_scan import Scan, surface_truth
from edge_server.fields import Budget, View
from edge_server.fields.registry import make_field
from edge_server.foreground import ForegroundError
from edge_server.foreground.foreground import make_foreground
from edge_server.surface import SurfaceError
from edge_server.surface.depth import DepthMap
from edge_server.surface.metrics import Truth, compare
from edge_server.surface.reconstruct import make_depth_maps, mesh_from_depth_maps
from edge_server.surface.settings import Corner, MeshSettings
from freshfield.machine_load import LoadMeter
from freshfield.scenario import load

SCENARIO = "scan"
SPACING_M = 0.0015  # spacing of the points of the truth
ABOVE_M = 0.015  # lower end of the box by hand, above that of the scene's bounds
_WHOLE, _BY_HAND, _TRUE = "whole images", "whole images, mesh cut to a box by hand", "true masks"
WAYS: tuple[str, ...] = (_WHOLE, "detector", _TRUE)

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Point:
    """What is measured: a key of ``WAYS``, images of ``size`` pixels a side every ``step_deg`` around the tile, and
    ``steps`` of fitting."""

    way: str
    size: int
    step_deg: float
    steps: int


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {views, size, steps, rows: {way: facts}}. Raises BenchError if an extra is missing."""
    try:
        import skimage  # noqa: F401 -- checked before the fits, which take minutes
    except ImportError:
        raise BenchError("marching cubes needs scikit-image: pip install 'freshfield[surface]'") from None
    size, step_deg, steps = (96, 24.0, 100) if run.quick else (192, 15.0, 400)
    points = [Point(way, size, step_deg, steps) for way in WAYS]
    found = run.engine.run(measure_point, points, "scanned", describe=lambda p, rows: f"{p.way}: {_said(rows[p.way])}")
    return {
        "views": len(_bench(size, step_deg)[1]),
        "size": size,
        "steps": steps,
        "field": read_config(load(SCENARIO)).field,
        "rows": {way: row for rows in found for way, row in rows.items()},
    }


@cache
def _bench(size: int, step_deg: float) -> tuple[Scene, list[View], list[Mask], Truth]:
    """The scene, its views, their true masks, and the tile's surface."""
    source = source_config(load(SCENARIO))
    assert isinstance(source, WorldConfig) and source.arm is not None and source.arm.path is not None
    scene = make_scene(source.scene, {**source.scene_parameters(), "count": 1, "width": size, "height": size})
    lens, path = pinhole(scene.params), source.arm.path
    poses = [
        on_sphere(path.target_m, path.radius_m, azimuth, elevation)
        for elevation in path.elevations_deg
        for azimuth in np.arange(path.azimuths_deg[0], path.azimuths_deg[1] + 1e-9, step_deg)
    ]
    views = [View(f"v{k:02d}", scene.view(lens, p).image(0.0), p, lens) for k, p in enumerate(poses)]
    masks = [scene.object_mask(lens, pose) for pose in poses]
    return scene, views, masks, surface_truth(Scan(scene, tuple(views)), SPACING_M)


def measure_point(point: Point) -> dict[str, dict[str, Any]]:
    """Measure one way; returns its row, and of whole images also that of the mesh cut by hand. Raises BenchError."""
    scene, views, masks, truth = _bench(point.size, point.step_deg)
    edge, way, load_meter = read_config(load(SCENARIO)), point.way, LoadMeter()
    given, facts = _cut(way, views, masks, edge)
    # Whole images show more than the tile, so the bounds of their field are unknown.
    field, began = make_field(edge.field, {} if way == _WHOLE else edge.field_options, seed=0), _now()
    field.fit(given, Budget(steps=point.steps))
    maps = make_depth_maps(field.snapshot(), given, MeshSettings())
    rows = {way: {**facts, **_compared(maps, MeshSettings(), truth), "seconds": _now() - began}}
    if way == _WHOLE:
        rows[_BY_HAND] = {**_compared(maps, MeshSettings(bounds=_box(scene)), truth), "seconds": _now() - began}
    outside = load_meter.outside_cores()
    return {name: {**row, "outside_cores": outside} for name, row in rows.items()}


def _cut(way: str, views: Sequence[View], masks: Sequence[Mask], edge: EdgeConfig) -> tuple[list[View], dict[str, Any]]:
    """The views as given to the field; and the masks' IoU (mean, least) and milliseconds per image. Raises
    BenchError."""
    if way == _WHOLE:
        return list(views), {}
    if way == _TRUE:
        images = [
            np.dstack([np.where(m[..., None], v.image, 0), np.where(m, 255, 0)]).astype(np.uint8)
            for v, m in zip(views, masks)
        ]
        return [dataclasses.replace(v, image=i) for v, i in zip(views, images)], {"iou": 1.0, "least": 1.0}
    try:
        cut = make_foreground(edge.foreground)
    except ForegroundError as error:
        raise BenchError(str(error)) from None
    out, ious = [], []
    for view, mask in zip(views, masks):
        image = cut.apply(view.camera, view.image)
        # An image in which nothing is found is used whole, and has no alpha.
        ious.append(iou(image[..., 3] > 0 if image.shape[2] == 4 else np.ones_like(mask), mask))
        out.append(dataclasses.replace(view, image=image))
    status = cut.status()
    return out, {
        "iou": float(np.mean(ious)),
        "least": min(ious),
        "whole": len(views) - cut.counts.masked,
        "ms": status["ms_per_image"],
    }


def iou(a: Mask, b: Mask) -> float:
    """Intersection over union of two masks (H, W)."""
    return float((a & b).sum() / max(int((a | b).sum()), 1))


def _box(scene: Scene) -> tuple[Corner, Corner]:
    """A bounding box of the tile as a person would choose it: its bounds, from slightly above the bench."""
    (x0, y0, z0), (x1, y1, z1) = make_scene(scene.name, {"count": 1}).bounds.tolist()
    return (x0, y0, z0 + ABOVE_M), (x1, y1, z1)


def _compared(maps: Sequence[DepthMap], settings: MeshSettings, truth: Truth) -> dict[str, Any]:
    try:
        mesh = mesh_from_depth_maps(maps, settings)
        return {**dataclasses.asdict(compare(mesh, truth)), "triangles": len(mesh.faces)}
    except SurfaceError as error:
        return {"failed": str(error)}


def _said(row: dict[str, Any]) -> str:
    if "failed" in row:
        return str(row["failed"])
    return f"chamfer {row['chamfer_mm']:.2f} mm, {100 * row['complete']:.1f} % of the surface within 3 mm"


def table(figures: dict[str, Any]) -> str:
    """A Markdown table with a row per segmentation."""
    about = (
        f"The tile on the bench of `{SCENARIO}`, {figures['views']} images of {figures['size']} x "
        f"{figures['size']}, {figures['field']}, {figures['steps']} steps."
    )
    rows: list[tuple[Any, ...]] = []
    for way, row in figures["rows"].items():
        masks = (number(row.get("iou")), number(row.get("least")), number(row.get("ms")))
        if "failed" in row:
            rows.append((way, *masks, row["failed"], *[""] * 6))
            continue
        rows.append(
            (
                way,
                *masks,
                f"{row['chamfer_mm']:.2f}",
                f"{row['accuracy_mm']:.2f}",
                f"{row['completeness_mm']:.2f}",
                f"{100 * row['complete']:.0f} %",
                f"{100 * row['precise']:.0f} %",
                f"{row['seconds']:.0f}",
                number(row["outside_cores"]),
            )
        )
    head = (
        "cut by|mask IoU|least|ms|chamfer mm|mesh to tile mm|tile to mesh mm|surface within 3 mm|"
        "mesh within 3 mm|seconds|outside cores"
    )
    return f"{about}\n\n{markdown_table(head.split('|'), rows)}"
