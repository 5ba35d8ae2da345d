"""COLMAP models: cameras, images and points3D as text (COLMAP's documentation, "Output Format").

COLMAP's poses are world-to-camera with OpenCV axes, its quaternions w-first and its pixels counted from the
image's corner, as here. A camera without distortion becomes PINHOLE, another one OPENCV (k1 k2 p1 p2).
Points have tracks: where in which images they are seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from freshfield.files import write_text
from freshfield.geometry import Pinhole, matrix_to_quaternion, se3_inverse


@dataclass(frozen=True)
class Cloud:
    """A point cloud. points: float64 (N, 3), meters. color: uint8 (N, 3). seen: bool (N, S), which shots see
    each point."""

    points: NDArray[np.float64]
    color: NDArray[np.uint8]
    seen: NDArray[np.bool_]


def write_model(folder: Path, shots: Sequence[View], cloud: Cloud) -> None:
    """Write cameras.txt, images.txt and points3D.txt to ``folder``, which is created. shots: see ``Exporter``."""
    folder.mkdir(parents=True, exist_ok=True)
    lenses = list(dict.fromkeys(shot.intrinsics for shot in shots))
    images: list[str] = []
    tracks: list[list[str]] = [[] for _ in cloud.points]  # of each point: image number and index of the pixel there
    for number, shot in enumerate(shots, 1):
        inverse = se3_inverse(shot.camera_to_world)
        which = np.flatnonzero(cloud.seen[:, number - 1])
        pixels = shot.intrinsics.project(cloud.points[which] @ inverse[:3, :3].T + inverse[:3, 3])
        for place, point in enumerate(which):
            tracks[point].append(f"{number} {place}")
        pose = f"{_numbers(matrix_to_quaternion(inverse[:3, :3]))} {_numbers(inverse[:3, 3])}"
        images.append(f"{number} {pose} {lenses.index(shot.intrinsics) + 1} {shot.camera}")
        images.append(" ".join(f"{_numbers(pixel)} {point + 1}" for pixel, point in zip(pixels, which)))
    cameras = [
        f"{k} {_model(lens)[0]} {lens.width} {lens.height} {_numbers(_model(lens)[1])}"
        for k, lens in enumerate(lenses, 1)
    ]
    points = [
        f"{k} {_numbers(at)} {color[0]} {color[1]} {color[2]} 0.0 {' '.join(track)}".rstrip()
        for k, (at, color, track) in enumerate(zip(cloud.points, cloud.color, tracks), 1)
    ]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_text(folder / f"{name}.txt", "".join(f"{line}\n" for line in lines))


def _model(lens: Pinhole) -> tuple[str, list[float]]:
    """Name of COLMAP's camera model, and its parameters."""
    focal = [lens.fx, lens.fy, lens.cx, lens.cy]
    return ("OPENCV", [*focal, *lens.distortion]) if lens.distorted else ("PINHOLE", focal)


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(repr(float(v)) for v in values)  # the shortest text that reads back to the same bits
