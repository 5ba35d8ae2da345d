"""PLY (Turk 1994), binary and little-endian: points with colors, tables of properties. Meshes are trimesh's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from freshfield.files import write_bytes

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def write_points(path: Path, points: NDArray[np.float32], color: NDArray[np.uint8]) -> None:
    """Write points (N, 3) in meters with color (N, 3)."""
    kinds = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    write_table(path, np.rec.fromarrays([*points.T, *color.T], dtype=kinds))


def write_table(path: Path, table: NDArray[np.void]) -> None:
    """Write a structured array (N,) as the element ``vertex``; its fields become the properties, in order."""
    assert table.dtype.names is not None
    properties = "".join(f"property {_TYPES[table.dtype[n].str[1:]]} {n}\n" for n in table.dtype.names)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{properties}end_header\n"
    write_bytes(path, head.encode() + table.tobytes())
