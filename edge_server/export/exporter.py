"""Writes a field and its cameras as files for other programs: what several files need is computed once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge_server.export import ExportError
from edge_server.export.export_constants import COARSE_SHARE, PIXELS_A_POINT, POINTS
from edge_server.fields import Field, View
from edge_server.surface.settings import MeshSettings
from freshfield.files import write_bytes

if TYPE_CHECKING:  # of the extra surface
    from trimesh import Trimesh

ENDINGS = {"mesh": (".ply", ".glb"), "splats": (".ply", ".spz"), "points": (".ply",)}
KINDS = ("splats", "transforms", "colmap", "points", "mesh")  # in the order of writing


# glTF's y points up, our z does.
_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def check(files: Mapping[str, Path], count: int = POINTS) -> None:
    """Check what can be checked before a run is opened: the options, then what is installed. Raises ExportError,
    SurfaceError.

    files, count: see ``Exporter``.
    """
    for kind, endings in ENDINGS.items():
        if kind in files and files[kind].suffix.lower() not in endings:
            raise ExportError(f"--{kind} {files[kind]}: expected a file that ends in {' or '.join(endings)}")
    if count < 1:
        raise ExportError(f"--count {count}: expected 1 or more")
    if "splats" in files and files["splats"].suffix.lower() == ".spz":
        from edge_server.export.splats import import_gsply

        import_gsply()
    if "mesh" in files:
        from edge_server.surface.mesh import import_marching_cubes

        import_marching_cubes()


class Exporter:
    """Writes one field.

    name: of the representation. field: what is exported. shots: the views that it learned from, at the poses that
        belong to it, each under a file's name.
    count: number of points in points, colmap and transforms.
    mesh: settings of a mesh.
    say: gets a line for each file. progress: gets the stage and the share that is done.
    """

    def __init__(
        self,
        name: str,
        field: Field,
        shots: Sequence[View],
        *,
        count: int = POINTS,
        mesh: MeshSettings | None = None,
        say: Callable[[str], None] = lambda line: None,
        progress: Callable[[str, float], None] = lambda stage, share: None,
    ) -> None:
        self._name, self._field, self._shots = name, field, shots
        self._views = shots  # of which depth is rendered, maybe smaller
        self._count, self._settings = count, mesh or MeshSettings()
        self._say, self._progress = say, progress

    def write(self, files: Mapping[str, Path]) -> None:
        """Write every file. files: kind, one of KINDS -> its file or folder. Raises ExportError and SurfaceError."""
        check(files, self._count)
        centers = np.stack([shot.camera_to_world[:3, 3] for shot in self._shots])
        spacing_m = float(np.spacing(np.float32(np.abs(centers).max())))
        if 0.0 < COARSE_SHARE * float(np.ptp(centers, axis=0).max()) < spacing_m:
            self._say(
                f"these files hold 32-bit positions, which are {spacing_m:g} m apart at these coordinates: "
                "subtract one offset from all poses and fit again"
            )
        if "mesh" not in files:
            # Sharpening takes minutes, and points are drawn from the depth as well as it is, and from a part of it.
            self._settings = replace(self._settings, sharpen=False)
            pixels = sum(view.intrinsics.width * view.intrinsics.height for view in self._views)
            share = min(1.0, math.sqrt(PIXELS_A_POINT * self._count / max(pixels, 1)))
            self._views = [replace(view, intrinsics=view.intrinsics.scaled(share)) for view in self._views]
        for kind in KINDS:
            if kind in files:
                files[kind].parent.mkdir(parents=True, exist_ok=True)
                getattr(self, f"_{kind}")(files[kind])

    @cached_property
    def maps(self):
        """Depth maps, rendered at the cameras."""
        from edge_server.surface.reconstruct import make_depth_maps

        return make_depth_maps(self._field.snapshot(), self._views, self._settings, self._progress)

    @cached_property
    def cloud(self):
        """Surface points, and the cameras that see them."""
        from edge_server.export.point_cloud import sparse_points

        return sparse_points(self.maps, self._count)

    def _mesh(self, path: Path) -> None:
        from edge_server.surface.reconstruct import mesh_from_depth_maps

        mesh = mesh_from_depth_maps(self.maps, self._settings, self._progress)
        write_mesh(path, mesh)
        self._say(f"{path}: {len(mesh.faces)} triangles, {len(mesh.vertices)} vertices")

    def _points(self, path: Path) -> None:
        from edge_server.export.ply import write_points

        write_points(path, self.cloud.points.astype("float32"), self.cloud.color)
        self._say(f"{path}: {len(self.cloud.points)} points")

    def _splats(self, path: Path) -> None:
        from edge_server.export.splats import write_splats
        from edge_server.fields.splat.snapshot import SplatSnapshot

        snapshot = self._field.snapshot()
        if not isinstance(snapshot, SplatSnapshot):
            raise ExportError(f"--splats: {self._name} has no Gaussians: use a run or fit of field splat")
        self._say(f"{path}: {write_splats(path, snapshot.params, snapshot.box)} Gaussians")

    def _colmap(self, folder: Path) -> None:
        from edge_server.export.colmap import write_model
        from edge_server.export.images_and_video import write_images

        write_model(folder / "sparse" / "0", self._shots, self.cloud)
        write_images(folder / "images", self._shots)
        self._say(f"{folder}: {len(self._shots)} images, {len(self.cloud.points)} points")

    def _transforms(self, folder: Path) -> None:
        from edge_server.export.images_and_video import write_images
        from edge_server.export.transforms import write_transforms

        write_images(folder / "images", self._shots)
        self._points(folder / "points.ply")
        path = write_transforms(folder, self._shots, "points.ply")
        self._say(f"{path}: {len(self._shots)} frames")


def write_mesh(path: Path, mesh: Trimesh) -> None:
    """Write a mesh in world meters as its file's ending says, .ply (binary) or .glb, where y points up."""
    kind = path.suffix.lower().removeprefix(".")
    turned = mesh.copy().apply_transform(_UP) if kind == "glb" else mesh
    data = turned.export(file_type=kind)
    assert isinstance(data, bytes)  # of these two kinds
    write_bytes(path, data)
