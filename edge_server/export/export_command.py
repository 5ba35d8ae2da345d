"""``edge-server export``: writes a run or a fit as files for other programs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from edge_server.command import command_parser, exit_status
from edge_server.export import ExportError
from edge_server.export.export_constants import POINTS
from edge_server.export.exporter import KINDS, Exporter, check
from edge_server.export.run_source import open_source
from edge_server.progress import ProgressLine
from edge_server.surface import SurfaceError
from edge_server.surface.settings import MeshSettings
from edge_server.surface.surface_constants import SHARPENED_PIXELS
from freshfield.files import out_file, out_folder

SAVED_STREAM = ".ffsplats"

DESCRIPTION = f"""\
Write the results of a run or fit as files for other programs. RUN is its folder, or a checkpoint in it.

  edge-server export runs/demo --mesh tile.ply
  edge-server export runs/fit-tile --mesh tile.glb --voxel 1
  edge-server export runs/demo/snapshot-000120.npz --splats tile.ply
  edge-server export runs/demo --colmap out/colmap --transforms out/nerf
  edge-server export room.ffsplats --splats room.ply    a saved splat stream: room-0000.ply and so on

--mesh         triangles with colors: .ply or .glb (pip install 'freshfield[surface]')
--splats       the Gaussians of a splat field, in the layout that splat viewers open (.ply), or a quarter as
               large (.spz: pip install 'freshfield[spz]'); of a stream that the page /splats/ saved,
               a sequence of 30 files a second
--points       surface points with colors (.ply)
--colmap       DIR/images, under the pictures' own names, and a model in DIR/sparse/0, as text
--transforms   DIR/transforms.json, DIR/images and DIR/points.ply, for nerfstudio and others

Several can be given at once. Lengths in the files are meters, and z points up (in GLB: y). A mesh is fused on
a grid from the depth that the cameras see; what no camera saw stays open. Of more than
{SHARPENED_PIXELS // 10**6} million pixels only the depth of those images is sharpened and used that see most together.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = _parser()
    args = parser.parse_args(argv)
    files = {kind: path for kind in KINDS if (path := getattr(args, kind)) is not None}
    if not files:
        parser.error(f"say what to write: {', '.join(f'--{kind}' for kind in KINDS)}")
    return exit_status(parser.prog, lambda: _export(args, files), (ExportError, SurfaceError))


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("edge-server export", DESCRIPTION)
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="folder of a run or fit (its --out), a checkpoint, or .ffsplats")
    add("--mesh", type=out_file, metavar="FILE", help="mesh: .ply or .glb")
    add("--splats", type=out_file, metavar="FILE", help="Gaussians: .ply or .spz")
    add("--points", type=out_file, metavar="FILE", help="surface points: .ply")
    add("--colmap", type=out_folder, metavar="DIR", help="COLMAP model with images")
    add("--transforms", type=out_folder, metavar="DIR", help="transforms.json with images and points")
    add(
        "--count",
        type=int,
        default=POINTS,
        metavar="N",
        help="points in --points, --colmap, --transforms [%(default)s]",
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
    mesh("--method", default="tsdf", help="tsdf, or sdf: a distance function fitted with an eikonal term [tsdf]")
    mesh(
        "--no-sharpen",
        action="store_true",
        help="use the field's depth as it is, without refining it by "
        "multi-view consistency: faster, works for moving scenes, less accurate",
    )
    return parser


def _export(args: argparse.Namespace, files: dict[str, Path]) -> None:
    """Check all options, then write every file. Raises ExportError, SurfaceError."""
    settings = _mesh_settings(args)
    saved = args.run.suffix == SAVED_STREAM
    if saved and set(files) != {"splats"}:
        raise ExportError(f"{args.run}: a saved stream has Gaussians alone: give --splats FILE.ply only")
    check(files, args.count)
    if saved:
        from edge_server.export.splat_sequence import write_sequence

        print(f"{args.run}: {write_sequence(files['splats'], args.run)} frames", flush=True)
        return
    source = open_source(args.run, args.allow_plugins)
    print(f"{source.file}: {source.name}, {len(source.views)} cameras", flush=True)
    progress = ProgressLine(sys.stderr)
    exporter = Exporter(
        source.name,
        source.field,
        source.shots,
        count=args.count,
        mesh=settings,
        say=lambda line: print(line, flush=True),
        progress=progress,
    )
    with progress.running():
        exporter.write(files)


def _mesh_settings(args: argparse.Namespace) -> MeshSettings:
    if args.voxel is not None and not args.voxel > 0:
        raise ExportError(f"--voxel {args.voxel:g}: expected more than 0 mm")
    box = None if args.bounds is None else (tuple(args.bounds[:3]), tuple(args.bounds[3:]))
    if box is not None and not all(low < high for low, high in zip(*box)):
        raise ExportError("--bounds: each lower corner must be below its upper one")
    return MeshSettings(
        method=args.method,
        sharpen=not args.no_sharpen,
        voxel_m=None if args.voxel is None else 1e-3 * args.voxel,
        bounds=box,
    )
