"""GLB (glTF 2.0, binary) of a mesh with colors, written by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_server.export import ExportError
from freshfield.files import write_bytes

# glTF's y points up, our z does.
_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def write_mesh(path: Path, vertices: NDArray[np.float32], faces: NDArray[np.int32], color: NDArray[np.uint8]) -> None:
    """Write vertices (V, 3) in meters, uint8 color (V, 3) and faces (F, 3). The scene is turned so that our z
    is glTF's y, up. ExportError: trimesh is missing."""
    try:
        import trimesh
    except ImportError:
        raise ExportError("GLB needs trimesh: pip install 'freshfield[surface]', or write .ply") from None
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=color, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=_UP)
    write_bytes(path, scene.export(file_type="glb"))
