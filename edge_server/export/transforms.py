"""transforms.json as nerfstudio and instant-ngp read it: OpenGL camera axes, intrinsics per frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edge_server.fields import View
from freshfield.files import write_json
from freshfield.geometry import OPENGL_TO_OPENCV


def write_transforms(folder: Path, shots: Sequence[View], points: str | None = None) -> Path:
    """Write ``folder``/transforms.json for images in ``folder``/images; returns its path. points: name of a
    PLY file in ``folder`` from which nerfstudio initializes splats. shots: see ``Exporter``."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for shot in shots:
        lens = shot.intrinsics
        k1, k2, p1, p2 = lens.distortion
        frames.append(
            {
                "file_path": f"images/{shot.camera}",
                "w": lens.width,
                "h": lens.height,
                "fl_x": lens.fx,
                "fl_y": lens.fy,
                "cx": lens.cx,
                "cy": lens.cy,
                "k1": k1,
                "k2": k2,
                "p1": p1,
                "p2": p2,
                "transform_matrix": (shot.camera_to_world @ OPENGL_TO_OPENCV).tolist(),
            }
        )
    more = {} if points is None else {"ply_file_path": points}
    path = folder / "transforms.json"
    write_json(path, {"camera_model": "OPENCV", **more, "frames": frames}, indent=1)
    return path
