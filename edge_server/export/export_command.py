"""``edge-server export``: writes a run or a fit as files for other programs."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from edge_server.export import ExportError
from edge_server.surface import SurfaceError
from freshfield.files import out_file, out_folder

DESCRIPTION = """\
Write the results of a run or fit as files for other programs. RUN is its folder, or a checkpoint in it.

  edge-server export runs/demo --mesh tile.ply
  edge-server export runs/cell --mesh tile.ply --measure cell      and its distance to the true surface
  edge-server export runs/fit-tile --mesh tile.glb --voxel 1 --watertight
  edge-server export runs/demo/snapshot-000120.npz --splats tile.ply
  edge-server export runs/demo --colmap out/colmap --transforms out/nerf

--mesh         triangles with colors: .ply or .glb (scikit-image: pip install 'freshfield[surface]')
--splats       the Gaussians of a splat field, in the layout that splat viewers open (.ply)
--points       surface points with colors (.ply)
--colmap       DIR/images and a model in DIR/sparse/0, as text
--transforms   DIR/transforms.json, DIR/images and DIR/points.ply, for nerfstudio and others

Several can be given at once. Lengths in the files are meters, and z points up (in GLB: y). A mesh is fused on
a grid from the depth that the cameras see; what no camera saw stays open, or is closed with --watertight. Of more
than 10 million pixels only the depth of those images is sharpened and used that see most together.
"""


# scenario -> (mesh, views) -> a sentence on the distance to the true surface, to print.
Comparison = Callable[[str], Callable[[Any, Any], str]]


def main(argv: Sequence[str] | None = None, compare: Comparison | None = None) -> int:
    """Run the command; returns its exit status. compare: implements --measure. It is passed in because it
    needs the synthetic world, which the edge does not import."""
    parser = _parser()
    args = parser.parse_args(argv)
    wanted = ("mesh", "splats", "points", "colmap", "transforms")
    if all(getattr(args, name) is None for name in wanted):
        parser.error(f"say what to write: {', '.join(f'--{name}' for name in wanted)}")
    try:
        Export(args, compare).run()
    except (ExportError, SurfaceError) as error:
        print(f"edge-server export: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("edge-server export", description=DESCRIPTION, formatter_class=raw)
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="folder of a run or fit (its --out), or a checkpoint")
    add("--mesh", type=out_file, metavar="FILE", help="mesh: .ply or .glb")
    add("--splats", type=out_file, metavar="FILE", help="Gaussians: .ply")
    add("--points", type=out_file, metavar="FILE", help="surface points: .ply")
    add("--colmap", type=out_folder, metavar="DIR", help="COLMAP model with images")
    add("--transforms", type=out_folder, metavar="DIR", help="transforms.json with images and points")
    add(
        "--count", type=int, default=20000, metavar="N", help="points in --points, --colmap, --transforms [%(default)s]"
    )
    add(
        "--allow-plugins", action="store_true", help="run code from outside that the run's field names, if you trust it"
    )
    mesh = parser.add_argument_group("for --mesh").add_argument
    mesh("--voxel", type=float, metavar="MM", help="voxel size in millimeters [the width of a pixel at the surface]")
    mesh(
        "--bounds",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box to mesh: lower and upper corner, meters [what the cameras see]",
    )
    mesh("--watertight", action="store_true", help="close the surface where no camera looked")
    mesh("--method", default="tsdf", help="tsdf, or sdf: a distance function fitted with an eikonal term [tsdf]")
    mesh(
        "--no-sharpen",
        action="store_true",
        help="use the field's depth as it is, without refining it by "
        "multi-view consistency: faster, works for moving scenes, less accurate",
    )
    mesh(
        "--measure",
        metavar="SCENARIO",
        help="scenario of the run; if its scene is synthetic and static, print the mesh's distance to the true surface",
    )
    return parser


class Export:
    """One export. What several outputs need is computed once, on first use."""

    def __init__(self, args: argparse.Namespace, compare: Comparison | None = None) -> None:
        self.args, self._compare = args, compare
        self._said = ("", 0.0, 0.0)  # stage, when it was last mentioned, when it began

    @cached_property
    def source(self):
        """The field and its cameras."""
        from edge_server.export.run_source import open_source

        source = open_source(self.args.run, self.args.allow_plugins)
        print(f"{source.file}: {source.name}, {len(source.views)} cameras", flush=True)
        return source

    @cached_property
    def maps(self):
        """Depth maps, rendered at the cameras."""
        from edge_server.surface.reconstruct import make_depth_maps

        return make_depth_maps(self.source.field.snapshot(), self.source.views, self._settings(), self._progress)

    @cached_property
    def cloud(self):
        """Surface points, and the cameras that see them."""
        from edge_server.export.point_cloud import sparse_points

        return sparse_points(self.maps, self.args.count)

    def run(self) -> None:
        """Check all options, then write every output. Raises ExportError, SurfaceError."""
        args = self.args
        self._check()
        for name in ("splats", "transforms", "colmap", "points", "mesh"):
            if getattr(args, name) is not None:
                getattr(self, f"_{name}")(getattr(args, name))

    def _check(self) -> None:
        args = self.args
        for name, endings in (("mesh", (".ply", ".glb")), ("splats", (".ply",)), ("points", (".ply",))):
            path = getattr(args, name)
            if path is not None and path.suffix.lower() not in endings:
                raise ExportError(f"--{name} {path}: expected a file that ends in {' or '.join(endings)}")
        if args.count < 1:
            raise ExportError(f"--count {args.count}: expected 1 or more")
        if args.mesh is None and args.measure is not None:
            raise ExportError("--measure is for --mesh FILE")
        if args.measure is not None:
            if self._compare is None:
                raise ExportError("--measure: run it as edge-server export")
            self._measure = self._compare(args.measure)
        self._settings()
        if args.mesh is not None:
            from edge_server.surface.mesh import import_marching_cubes

            import_marching_cubes()

    def _settings(self):
        from edge_server.surface.settings import MeshSettings

        a = self.args
        if a.voxel is not None and not a.voxel > 0:
            raise ExportError(f"--voxel {a.voxel:g}: expected more than 0 mm")
        box = None if a.bounds is None else (tuple(a.bounds[:3]), tuple(a.bounds[3:]))
        if box is not None and not all(low < high for low, high in zip(*box)):
            raise ExportError("--bounds: each lower corner must be below its upper one")
        return MeshSettings(
            method=a.method,
            # It takes minutes, and points are drawn from the depth as well as it is.
            sharpen=a.mesh is not None and not a.no_sharpen,
            voxel_m=None if a.voxel is None else 1e-3 * a.voxel,
            bounds=box,
            watertight=a.watertight,
        )

    def _mesh(self, path: Path) -> None:
        from edge_server.surface.reconstruct import mesh_from_depth_maps

        mesh = mesh_from_depth_maps(self.maps, self._settings(), self._progress)
        if path.suffix.lower() == ".glb":
            from edge_server.export.glb import write_mesh
        else:
            from edge_server.export.ply import write_mesh
        path.parent.mkdir(parents=True, exist_ok=True)
        write_mesh(path, mesh.vertices, mesh.faces, mesh.color)
        closed = ", watertight" if mesh.watertight else ""
        print(f"{path}: {len(mesh.faces)} triangles, {len(mesh.vertices)} vertices{closed}", flush=True)
        if self.args.measure is not None:
            print(f"  {self._measure(mesh, self.source.views)}", flush=True)

    def _points(self, path: Path) -> None:
        from edge_server.export.ply import write_points

        path.parent.mkdir(parents=True, exist_ok=True)
        write_points(path, self.cloud.points.astype("float32"), self.cloud.color)
        print(f"{path}: {len(self.cloud.points)} points", flush=True)

    def _splats(self, path: Path) -> None:
        from edge_server.export.splats import write_splats

        snapshot = self.source.field.snapshot()
        if not hasattr(snapshot, "gaussians"):
            raise ExportError(f"--splats: {self.source.name} has no Gaussians: use a run or fit of field splat")
        path.parent.mkdir(parents=True, exist_ok=True)
        print(f"{path}: {write_splats(path, snapshot.gaussians, snapshot.box)} Gaussians", flush=True)

    def _colmap(self, folder: Path) -> None:
        from edge_server.export.colmap import write_model
        from edge_server.export.run_source import write_images

        write_model(folder / "sparse" / "0", self.source.shots, self.cloud)
        write_images(folder / "images", self.source.shots)
        print(f"{folder}: {len(self.source.shots)} images, {len(self.cloud.points)} points", flush=True)

    def _transforms(self, folder: Path) -> None:
        from edge_server.export.run_source import write_images
        from edge_server.export.transforms import write_transforms

        write_images(folder / "images", self.source.shots)
        self._points(folder / "points.ply")
        path = write_transforms(folder, self.source.shots, "points.ply")
        print(f"{path}: {len(self.source.shots)} frames", flush=True)

    def _progress(self, what: str, share: float) -> None:
        """One line in a terminal, nothing in a pipe."""
        if not sys.stderr.isatty():
            return
        name, at, begun = self._said
        now = time.perf_counter()
        if share >= 1.0 or what != name or now - at >= 1.0:
            self._said = (what, now, now if what != name else begun)
            left = f", {(now - begun) * (1.0 / share - 1.0):.0f} s left" if what == name and share < 1.0 else ""
            end = "\n" if share >= 1.0 else ""
            print(f"\r  {what:10} {100 * share:3.0f} %{left:16}", end=end, file=sys.stderr, flush=True)
