"""Gaussians as PLY in the layout of Kerbl et al.'s code, which the common splat viewers open, or as Niantic's SPZ.

There, color is 0.5 + Y0 f_dc + sum of Y_k f_rest, with spherical harmonics whose odd orders have the opposite
sign. Scales are logarithms, opacities are before the sigmoid, quaternions are w-first: as here.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.export import ExportError
from edge_server.export.ply import write_table
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, POSITION, QUATERNION, SCALE
from edge_server.fields.splat.planar import unit_quaternions
from edge_server.fields.splat.splat_constants import LOG_SCALE_HIGH, LOG_SCALE_LOW
from freshfield.files import write_bytes

SPZ_BITS = 12  # of a position behind the binary point, as others write it; of scenes under a meter: of their size
SPZ_WHOLE_BITS = 23  # of a position in all, without its sign
Y0 = 0.28209479177387814
# Signs of the harmonics of degree 1: Kerbl et al. negate those of odd order.
SIGNS = np.array([-1, 1, -1], np.float32)


def write_splats(path: Path, params: NDArray[np.float32], box: SceneBox) -> int:
    """Write Gaussians of parameters (N, P); returns their number. ExportError: there are none."""
    table = splat_table(params, box)
    if not len(table):
        raise ExportError("the field has no Gaussians yet: fit it first")
    if path.suffix.lower() == ".spz":
        write_bytes(path, spz_bytes(table))
    else:
        write_table(path, table)
    return len(table)


def spz_bytes(table: NDArray[np.void]) -> bytes:
    """The rows of ``splat_table`` as SPZ, version 3: positions as multiples of 2^-12 m (coarser beyond 2 km, finer
    where most lie within a meter), the rest in a byte a number. Raises ExportError without gsply."""
    gsply = import_gsply()

    def columns(*names: str) -> NDArray[np.float32]:
        return np.stack([table[name] for name in names], axis=-1) if names else np.zeros((len(table), 0), np.float32)

    assert table.dtype.names is not None
    rest = columns(*(name for name in table.dtype.names if name.startswith("f_rest_")))
    means = columns("x", "y", "z")
    gaussians = gsply.GSData(
        means=means,
        scales=columns("scale_0", "scale_1", "scale_2"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacities=table["opacity"],
        sh0=columns("f_dc_0", "f_dc_1", "f_dc_2"),
        shN=rest.reshape(len(table), 3, -1).transpose(0, 2, 1),
    )
    usual_m = np.median(np.abs(means - np.median(means, axis=0)).max(axis=1))
    finest = SPZ_WHOLE_BITS - int(np.frexp(np.abs(means).max())[1])
    bits = min(SPZ_BITS - min(int(np.frexp(usual_m)[1]), 0), finest, SPZ_WHOLE_BITS)
    with tempfile.TemporaryDirectory() as folder:
        gsply.write_spz(file := Path(folder) / "splats.spz", gaussians, fractional_bits=max(bits, 1))
        return file.read_bytes()


def import_gsply() -> Any:
    """The library that writes SPZ. Raises ExportError where it is missing."""
    try:
        import gsply
    except ImportError:
        raise ExportError("SPZ needs gsply: pip install 'freshfield[spz]', or write .ply") from None
    return gsply


def splat_table(params: NDArray[np.float32], box: SceneBox) -> NDArray[np.void]:
    """The rows (N,) of the file, in world meters."""
    p, extra = params.astype(np.float64), (params.shape[1] - BASE) // 3
    rest = p[:, BASE:].reshape(len(p), extra, 3) * SIGNS[:extra, None]
    columns = {
        **_three("xyz", p[:, POSITION:SCALE] * box.radius_m + np.array(box.center_m)),
        **_three(("nx", "ny", "nz"), np.zeros((len(p), 3))),
        **_three(("f_dc_0", "f_dc_1", "f_dc_2"), (p[:, COLOR:BASE] - 0.5) / Y0),
        # Channel by channel: all of red, then green, then blue.
        **{f"f_rest_{c * extra + k}": rest[:, k, c] for c in range(3) for k in range(extra)},
        "opacity": p[:, OPACITY],
        **_three(
            ("scale_0", "scale_1", "scale_2"),
            np.clip(p[:, SCALE:QUATERNION], LOG_SCALE_LOW, LOG_SCALE_HIGH) + np.log(box.radius_m),
        ),
    }
    turn = unit_quaternions(params)
    columns |= {f"rot_{k}": turn[:, k] for k in range(4)}
    table = np.zeros(len(p), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        table[name] = values
    return table


def _three(names: str | tuple[str, ...], values: NDArray) -> dict[str, NDArray]:
    return {name: values[:, k] for k, name in enumerate(names)}
