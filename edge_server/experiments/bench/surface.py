"""Measures mesh error and completeness against fit seconds and voxel size, with the seconds of every stage.

A field is fitted to a scan of ``tile`` from 0.3 m (``scenes.tile_scan``). After each fitting time its depth
is compared with the exact depth, and meshes are made: from the depth of the field, and from depth sharpened
by the images (``surface.refine_depth``), with truncated signed distances at several voxel sizes and with a
fitted distance function. Row ``exact`` fuses the exact depth, which is the best possible result with images
of this size and these cameras.

``measure_cell`` measures the same from the viewpoints of scenario ``cell``, with its field after ``CELL_STEPS``
steps.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.bench.run import BenchError, BenchRun
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.scenes.mesh_truth import SPACING_M
from edge_server.experiments.scenes.tile_scan import DISTANCE_M, Scan, cell_scan, exact_depth, scan, surface_truth
from edge_server.fields import Budget
from edge_server.fields.registry import make_field
from edge_server.surface import SurfaceError
from edge_server.surface.depth import DepthMap, depth_map
from edge_server.surface.metrics import (
    SEEN_BY,
    TARGET_CHAMFER_MM,
    TARGET_COMPLETE,
    WITHIN_M,
    Truth,
    compare,
    depth_error_mm,
)
from edge_server.surface.reconstruct import make_depth_maps, mesh_from_depth_maps
from edge_server.surface.settings import MeshSettings
from freshfield.machine_load import LoadMeter

# Cases by name: representation and options.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "splat": ("splat", {}),
    "splat, planar": ("splat", {"flatten": 0.02, "align": 0.3}),
    "ngp": ("ngp", {}),
}
# Kinds of depth for meshes, and their settings.
DEPTHS = {"of the field": MeshSettings(sharpen=False), "sharpened": MeshSettings()}
CELL_FIELD, CELL_STEPS = "ngp", 300
TARGET = (
    f"chamfer at most {TARGET_CHAMFER_MM:g} mm, completeness at least {100 * TARGET_COMPLETE:g} % at "
    f"{1e3 * WITHIN_M:g} mm"
)


@dataclass(frozen=True)
class Workload:
    """The amount of work.

    size: width and height of the images.
    fit_s: seconds of fitting after which meshes are made.
    voxels_mm: voxel sizes of the sharpened meshes; the others are made with the middle one.
    cases: keys of ``CASES``.
    cell_sizes: widths (and heights) of the images from the cell's viewpoints.
    """

    size: int
    fit_s: tuple[float, ...]
    voxels_mm: tuple[float, ...]
    cases: tuple[str, ...]
    cell_sizes: tuple[int, ...]


FULL = Workload(192, (5.0, 20.0, 60.0), (4.0, 2.0, 1.0), tuple(CASES), (128, 384))
QUICK = Workload(96, (10.0,), (2.0, 4.0), ("splat", "splat, planar"), (128,))


@dataclass(frozen=True)
class Point:
    """What is measured: a case (a key of ``CASES``), or exact depth ("")."""

    case: str
    workload: Workload


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {scan: facts, exact: {meshes}, cases: {CASE: {fits: [...]}}}. Raises BenchError if scikit-image is
    missing."""
    _check_extra()
    workload = QUICK if run.quick else FULL
    names = workload.cases
    if run.fields:
        names = tuple(n for n, (representation, _) in CASES.items() if representation in run.fields)
    points = [Point(name, workload) for name in ("", *names)]
    exact, *cases = run.engine.run(measure_point, points, "surface", describe=lambda p, _: p.case or "exact depth")
    close, truth, _ = _scanned(workload.size)
    facts = {
        "views": len(close.views),
        "size": workload.size,
        "distance_m": DISTANCE_M,
        "truth_points": len(truth.points),
        "seen_by_two": float((truth.cameras >= SEEN_BY).mean()),
    }
    return {"scan": facts, "exact": exact, "cases": dict(zip(names, cases))}


def measure_cell(run: BenchRun) -> dict[str, Any]:
    """Measure {SIZE: figures} of the meshes from the viewpoints of ``cell``. Raises BenchError if scikit-image is
    missing."""
    _check_extra()
    sizes = (QUICK if run.quick else FULL).cell_sizes
    return {str(size): row for size, row in zip(sizes, run.engine.run(cell_mesh, sizes, "cell"))}


def _check_extra() -> None:
    try:
        import skimage  # noqa: F401 -- checked before the fits, which take minutes
    except ImportError:
        raise BenchError("marching cubes needs scikit-image: pip install 'freshfield[surface]'") from None


@cache
def _scanned(size: int) -> tuple[Scan, Truth, list[NDArray[np.float64]]]:
    """The scan, its surface, and the exact depth of its views."""
    close = scan(size)
    return close, surface_truth(close), [exact_depth(close.scene, view) for view in close.views]


def measure_point(point: Point) -> dict[str, Any]:
    """Measure one case: fits that each continue the previous one; or the meshes of the exact depth."""
    close, truth, exact = _scanned(point.workload.size)
    if point.case:
        return _case(point.case, point.workload, close, exact, truth)
    maps = _exact_maps(close, exact)
    return {"meshes": [_mesh(maps, "tsdf", "exact", mm, truth) for mm in point.workload.voxels_mm]}


def cell_mesh(size: int) -> dict[str, Any]:
    """Measure the mesh of ``edge-server export`` from the cell's viewpoints, and the one from exact depth."""
    close = cell_scan(size)
    truth, exact = surface_truth(close, SPACING_M), [exact_depth(close.scene, v) for v in close.views]
    field = make_field(CELL_FIELD, close.options)
    field.fit(close.views, Budget(steps=CELL_STEPS))
    began = time.perf_counter()
    maps = make_depth_maps(field.snapshot(), close.views, MeshSettings())
    row: dict[str, Any] = {"views": len(close.views), **_depth_error(maps, exact)}
    mesh = mesh_from_depth_maps(maps, MeshSettings())
    row["seconds"] = time.perf_counter() - began
    best = compare(mesh_from_depth_maps(_exact_maps(close, exact), MeshSettings()), truth)
    return {
        **row,
        **dataclasses.asdict(compare(mesh, truth)),
        "triangles": len(mesh.faces),
        "exact_chamfer_mm": best.chamfer_mm,
        "exact_complete": best.complete,
    }


def _exact_maps(close: Scan, exact: Sequence[NDArray[np.float64]]) -> list[DepthMap]:
    return [
        depth_map(d.astype(np.float32), v.image, v.camera_to_world, v.intrinsics) for d, v in zip(exact, close.views)
    ]


def _case(
    name: str, workload: Workload, close: Scan, exact: Sequence[NDArray[np.float64]], truth: Truth
) -> dict[str, Any]:
    representation, options = CASES[name]
    field = make_field(representation, {**close.options, **options})
    field.warm_up()
    load, fits, spent, steps = LoadMeter(), [], 0.0, 0
    for until in workload.fit_s:
        report = field.fit(close.views, Budget(seconds=until - spent))
        spent, steps = until, steps + report.steps
        fit: dict[str, Any] = {"fit_s": until, "steps": steps, "meshes": []}
        snapshot = field.snapshot()
        middle = workload.voxels_mm[len(workload.voxels_mm) // 2]
        every = [("tsdf", mm) for mm in workload.voxels_mm]
        for depth, wanted in (("of the field", [("tsdf", middle)]), ("sharpened", [*every, ("sdf", middle)])):
            seconds: dict[str, float] = {}
            began = time.perf_counter()

            def say(what: str, share: float, seconds=seconds, began=began) -> None:
                seconds[what] = time.perf_counter() - began - sum(v for k, v in seconds.items() if k != what)

            maps = make_depth_maps(snapshot, close.views, DEPTHS[depth], say)
            fit[depth] = {**_depth_error(maps, exact), **{f"{k}_s": v for k, v in seconds.items()}}
            fit["meshes"] += [_mesh(maps, method, depth, mm, truth) for method, mm in wanted]
        fits.append(fit)
        best = min((m["chamfer_mm"] for m in fit["meshes"] if "chamfer_mm" in m), default=float("nan"))
        print(f"  {name}, {until:g} s: {steps} steps, best chamfer {best:.2f} mm", flush=True)
    return {"fits": fits, "outside_cores": load.outside_cores()}


def _depth_error(maps: Sequence[DepthMap], exact: Sequence[NDArray[np.float64]]) -> dict[str, float]:
    """Mean depth errors over the maps, and the share of surface pixels that have a depth."""
    rows = [depth_error_mm(np.where(m.seen, m.depth, 0), e) for m, e in zip(maps, exact)]
    out = {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}
    covered = [float(m.seen[np.isfinite(e)].mean()) for m, e in zip(maps, exact)]
    return {**out, "covered": float(np.mean(covered))}


def _mesh(maps: Sequence[DepthMap], method: str, depth: str, voxel_mm: float, truth: Truth) -> dict[str, Any]:
    """Make and measure one mesh. ``seconds``: of all stages after the depth maps."""
    row: dict[str, Any] = {"method": method, "depth": depth, "voxel_mm": voxel_mm}
    began = time.perf_counter()
    try:
        mesh = mesh_from_depth_maps(maps, MeshSettings(method=method, voxel_m=1e-3 * voxel_mm))
    except SurfaceError as error:
        return {**row, "failed": str(error)}
    row |= {"seconds": time.perf_counter() - began, "triangles": len(mesh.faces)}
    return {**row, **dataclasses.asdict(compare(mesh, truth))}


def table(figures: dict[str, Any]) -> str:
    """Two Markdown tables: depth, and meshes."""
    facts = figures["scan"]
    size = f"{facts['size']} x {facts['size']}"
    about = f"{facts['views']} images of {size} of `tile` from {facts['distance_m']:g} m. Target: {TARGET}."
    fits = [(name, fit) for name, case in figures["cases"].items() for fit in case["fits"]]
    depths = []
    for name, fit in fits:
        for depth in DEPTHS:
            d = fit[depth]
            seconds = ", ".join(f"{k[:-2]} {v:.1f}" for k, v in d.items() if k.endswith("_s"))
            depths.append(
                (
                    name,
                    f"{fit['fit_s']:g}",
                    fit["steps"],
                    depth,
                    f"{100 * d['covered']:.0f} %",
                    f"{d['bias_mm']:+.2f}",
                    f"{d['median_mm']:.2f}",
                    f"{d['p90_mm']:.2f}",
                    seconds,
                )
            )
    made = [("exact", "", m) for m in figures["exact"]["meshes"]]
    made += [(name, f"{fit['fit_s']:g}", m) for name, fit in fits for m in fit["meshes"]]
    meshes = []
    for name, fit_s, m in made:
        cells = [name, fit_s, m["depth"], m["method"], f"{m['voxel_mm']:g}"]
        if "failed" in m:
            meshes.append([*cells, m["failed"], *[""] * 5])
            continue
        meshes.append(
            [
                *cells,
                f"{m['chamfer_mm']:.2f}",
                f"{m['accuracy_mm']:.2f} ({m['accuracy_median_mm']:.2f})",
                f"{m['completeness_mm']:.2f}",
                f"{100 * m['complete']:.1f} %, {100 * m['precise']:.1f} %",
                m["triangles"],
                f"{m['seconds']:.1f}",
            ]
        )
    of_depth = "field|fit s|steps|depth|covered|bias mm|median mm|p90 mm|seconds"
    of_mesh = (
        "field|fit s|depth|method|voxel mm|chamfer mm|accuracy mm (median)|completeness mm|"
        "within 3 mm: surface, mesh|triangles|seconds"
    )
    every = ((of_depth, depths), (of_mesh, meshes))
    return "\n\n".join((about, *(markdown_table(head.split("|"), rows) for head, rows in every)))


def table_cell(figures: dict[str, Any]) -> str:
    """A Markdown table of the meshes of the cell."""
    cells = [
        (
            size,
            c["views"],
            f"{c['median_mm']:.2f}",
            f"{c['chamfer_mm']:.2f} ({c['exact_chamfer_mm']:.2f})",
            f"{c['accuracy_mm']:.2f} ({c['accuracy_median_mm']:.2f})",
            f"{100 * c['complete']:.1f} % ({100 * c['exact_complete']:.1f}), {100 * c['precise']:.1f} %",
            f"{c['seconds']:.0f}",
        )
        for size, c in figures.items()
    ]
    of_cell = (
        "cell at|views|depth, median mm|chamfer mm (exact depth)|accuracy mm (median)|"
        "within 3 mm: surface (exact depth), mesh|seconds"
    )
    return f"Target: {TARGET}.\n\n{markdown_table(of_cell.split('|'), cells)}"
