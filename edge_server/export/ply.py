"""PLY (Turk 1994), binary and little-endian: meshes and points with colors, tables of properties."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from freshfield.files import write_bytes

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def write_mesh(path: Path, vertices: NDArray[np.float32], faces: NDArray[np.int32], color: NDArray[np.uint8]) -> None:
    """Write vertices (V, 3) in meters, color (V, 3) and faces (F, 3)."""
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    rows["count"], rows["corner"] = 3, faces
    table = _colored(vertices, color)
    more = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    write_bytes(path, _header(table, more) + table.tobytes() + rows.tobytes())


def write_points(path: Path, points: NDArray[np.float32], color: NDArray[np.uint8]) -> None:
    """Write points (N, 3) in meters with color (N, 3)."""
    write_table(path, _colored(points, color))


def write_table(path: Path, table: NDArray[np.void]) -> None:
    """Write a structured array (N,) as the element ``vertex``; its fields become the properties, in order."""
    write_bytes(path, _header(table) + table.tobytes())


def _colored(points: NDArray[np.float32], color: NDArray[np.uint8]) -> NDArray[np.void]:
    places, colors = [(n, "<f4") for n in "xyz"], [(n, "u1") for n in ("red", "green", "blue")]
    table = np.zeros(len(points), dtype=[*places, *colors])
    for k, name in enumerate("xyz"):
        table[name] = points[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        table[name] = color[:, k]
    return table


def _header(table: NDArray[np.void], more: str = "") -> bytes:
    assert table.dtype.names is not None
    properties = "".join(f"property {_TYPES[table.dtype[n].str[1:]]} {n}\n" for n in table.dtype.names)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{properties}{more}end_header\n"
    return head.encode()
