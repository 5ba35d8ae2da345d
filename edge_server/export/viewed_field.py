"""A field with the views that it learned from: renders new viewpoints, and writes files for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge_server.export import ExportError, file_names
from edge_server.export.camera_paths import Step, lens, orbit, vertical_fov_deg
from edge_server.export.export_constants import DEFAULT_HEIGHT_PX, MOST_NAMED
from edge_server.fields import SEPARATOR, Field, RefinesCameras, Rendering, View
from freshfield.geometry import Pinhole
from freshfield.limits import MAX_IMAGE_SIDE_PX

Kind = Literal["splats", "points", "mesh"]


class ViewedField:
    """A field and the views that it learned from.

    name: name of the representation.
    field: renders, saves and goes on learning.
    views: the last view of each camera. others: further views, such as held-out ones, that ``render`` knows by name.
    """

    def __init__(self, name: str, field: Field, views: tuple[View, ...], others: tuple[View, ...] = ()) -> None:
        self.name, self.field, self.views, self.others = name, field, views, others

    def render(
        self, camera: str | NDArray[np.float64], size: tuple[int, int] | None = None, fov_deg: float | None = None
    ) -> NDArray[np.float32]:
        """The colors of a viewpoint: float32 (height, width, 3) in [0, 1], RGB.

        camera: name of one of the views, which is rendered through its own lens at its corrected pose; or
            camera-to-world, float (4, 4), OpenCV axes (x right, y down, z forward), meters.
        size: (width, height) in pixels; None: the named camera's, else 480 high at the shape of the cameras' images.
        fov_deg: vertical field of view; None: the camera's.
        Raises ExportError for an unknown camera, a matrix that is no pose, or a size out of range.
        """
        return self._rendered(camera, size, fov_deg).color

    def depth(
        self, camera: str | NDArray[np.float64], size: tuple[int, int] | None = None, fov_deg: float | None = None
    ) -> NDArray[np.float32]:
        """Depth along each pixel's ray, float32 (height, width), meters; 0 where nothing is. As ``render``."""
        return self._rendered(camera, size, fov_deg).depth

    def _rendered(
        self, camera: str | NDArray[np.float64], size: tuple[int, int] | None, fov_deg: float | None
    ) -> Rendering:
        if isinstance(camera, str):
            step, size = self.camera_step(camera, size, fov_deg)
        else:
            pose = np.asarray(camera, np.float64)
            if pose.shape != (4, 4) or not np.isfinite(pose).all():
                raise ExportError(f"camera: expected a name or a finite (4, 4) camera-to-world, got {pose.shape}")
            step = Step(pose, vertical_fov_deg(self.views[0].intrinsics))
        width, height = checked_size(size or self.usual_size())
        through = step.lens or lens(width, height, fov_deg or step.fov_deg)
        return self.field.render(step.camera_to_world, through)

    def camera_step(
        self, camera: str, size: tuple[int, int] | None = None, fov_deg: float | None = None
    ) -> tuple[Step, tuple[int, int]]:
        """The viewpoint of one of the cameras, and the size of its image. See ``render``.

        A carried camera's views are called hand#0, hand#1, ...: its newest one stands for it.
        """
        known = (*self.views, *self.others)
        shots = {view.camera.rpartition(SEPARATOR)[0]: view for view in known if SEPARATOR in view.camera}
        shots |= {view.camera: view for view in known}
        if camera not in shots:
            more = f", and {len(shots) - MOST_NAMED} more" if len(shots) > MOST_NAMED else ""
            raise ExportError(f"--camera {camera}: the run has {', '.join(list(shots)[:MOST_NAMED])}{more}")
        view = shots[camera]
        own = view.intrinsics
        size = size or (own.width, own.height)
        scaled = own.scaled(size[1] / own.height)
        through = scaled if fov_deg is None and (scaled.width, scaled.height) == size else None
        return Step(self.pose(view), vertical_fov_deg(own), through), size

    def orbit(self, count: int, fov_deg: float | None = None) -> list[NDArray[np.float64]]:
        """Camera-to-world (4, 4) of ``count`` viewpoints round what the cameras look at, where they stand: a closed
        path for ``render``."""
        fov = fov_deg or vertical_fov_deg(self.views[0].intrinsics)
        return [step.camera_to_world for step in orbit(self.views, count, fov)]

    def usual_size(self) -> tuple[int, int]:
        """Width and height near DEFAULT_HEIGHT_PX, even: video codecs ask for that."""
        like: Pinhole = self.views[0].intrinsics
        return 2 * round(DEFAULT_HEIGHT_PX * like.width / like.height / 2), DEFAULT_HEIGHT_PX

    def export(self, file: Path | str, kind: Kind | None = None) -> None:
        """Write the field for other programs.

        file: ends in .ply; of a mesh also in .glb, of splats also in .spz.
        kind: splats (the Gaussians of a splat field), points of the surface, or a mesh; None: a mesh if the file ends
            in .glb, else splats.
        Raises ExportError where the field has no Gaussians, the ending is another, or a package is missing.
        """
        from edge_server.export.exporter import Exporter

        file = Path(file)
        Exporter(self.name, self.field, self.shots).write(
            {kind or ("mesh" if file.suffix.lower() == ".glb" else "splats"): file}
        )

    @property
    def shots(self) -> list[View]:
        """The views as images to write, each under the name of its file, at the poses that belong to the field's
        Gaussians: corrected ones, if it corrects them."""
        named = zip(file_names(self.views), self.views)
        return [replace(view, camera=name, camera_to_world=self.pose(view)) for name, view in named]

    def pose(self, view: View) -> NDArray[np.float64]:
        """Camera to world (4, 4) of a view, corrected where the field corrects it."""
        if isinstance(self.field, RefinesCameras):
            known = self.field.correction(view)
            pose = None if known is None else known.camera_to_world
        else:  # fields of rays learn the poses of their own views alone
            pose = self.field.learned_pose(view) if hasattr(self.field, "learned_pose") else None
        return np.asarray(view.camera_to_world if pose is None else pose, np.float64)


def checked_size(size: Sequence[int]) -> tuple[int, int]:
    """Width and height in pixels. Raises ExportError for a size that no image has."""
    if len(size) != 2 or not all(2 <= side <= MAX_IMAGE_SIDE_PX for side in size):
        text = "x".join(str(side) for side in size)
        raise ExportError(f"--size {text}: expected pixels such as 1280x720")
    return int(size[0]), int(size[1])
