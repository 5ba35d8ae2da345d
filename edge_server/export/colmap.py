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

from edge_server.export import ExportError, PosedImage
from freshfield.files import write_text
from freshfield.geometry import Pinhole, matrix_to_quaternion, se3_inverse


@dataclass(frozen=True)
class Cloud:
    """A point cloud. points: float64 (N, 3), meters. color: uint8 (N, 3). seen: bool (N, S), which shots see
    each point."""

    points: NDArray[np.float64]
    color: NDArray[np.uint8]
    seen: NDArray[np.bool_]


@dataclass(frozen=True)
class _Image:
    number: int
    name: str
    camera: int
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    pixels: NDArray[np.float64]  # (M, 2)
    points: NDArray[np.int64]  # (M,), numbers of points from 1


def write_model(folder: Path, shots: Sequence[PosedImage], cloud: Cloud) -> None:
    """Write cameras.txt, images.txt and points3D.txt to ``folder``, which is created. Images are named
    NAME.png. ExportError: no shots."""
    if not shots:
        raise ExportError("no camera has reported: there is nothing to write")
    folder.mkdir(parents=True, exist_ok=True)
    lenses = list(dict.fromkeys(shot.intrinsics for shot in shots))
    images = [_image(k, shot, lenses, cloud) for k, shot in enumerate(shots)]
    # For each point: (image number, index of its pixel among that image's).
    tracks: list[list[tuple[int, int]]] = [[] for _ in cloud.points]
    for image in images:
        for place, point in enumerate(image.points):
            tracks[point - 1].append((image.number, place))
    write_text(folder / "cameras.txt", _cameras_text(lenses))
    write_text(folder / "images.txt", _images_text(images))
    write_text(folder / "points3D.txt", _points_text(cloud, tracks))


def _image(k: int, shot: PosedImage, lenses: list[Pinhole], cloud: Cloud) -> _Image:
    inverse = se3_inverse(shot.camera_to_world)
    which = np.flatnonzero(cloud.seen[:, k])
    pixels = shot.intrinsics.project(cloud.points[which] @ inverse[:3, :3].T + inverse[:3, 3])
    return _Image(
        number=k + 1,
        name=f"{shot.name}.png",
        camera=lenses.index(shot.intrinsics) + 1,
        quaternion=matrix_to_quaternion(inverse[:3, :3]),
        translation=inverse[:3, 3],
        pixels=pixels,
        points=which + 1,
    )


def _model(lens: Pinhole) -> tuple[str, list[float]]:
    """Name of COLMAP's camera model, and its parameters."""
    focal = [lens.fx, lens.fy, lens.cx, lens.cy]
    return ("OPENCV", [*focal, *lens.distortion]) if lens.distorted else ("PINHOLE", focal)


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(repr(float(v)) for v in values)  # the shortest text that reads back to the same bits


def _cameras_text(lenses: list[Pinhole]) -> str:
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for k, lens in enumerate(lenses):
        model, params = _model(lens)
        lines.append(f"{k + 1} {model} {lens.width} {lens.height} {_numbers(params)}")
    return "\n".join(lines) + "\n"


def _images_text(images: list[_Image]) -> str:
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for i in images:
        pose = f"{_numbers(i.quaternion)} {_numbers(i.translation)}"
        lines.append(f"{i.number} {pose} {i.camera} {i.name}")
        lines.append(" ".join(f"{_numbers(pixel)} {point}" for pixel, point in zip(i.pixels, i.points)))
    return "\n".join(lines) + "\n"


def _points_text(cloud: Cloud, tracks: list[list[tuple[int, int]]]) -> str:
    lines = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    for k, (point, color, track) in enumerate(zip(cloud.points, cloud.color, tracks)):
        places = " ".join(f"{image} {place}" for image, place in track)
        lines.append(f"{k + 1} {_numbers(point)} {color[0]} {color[1]} {color[2]} 0.0 {places}".rstrip())
    return "\n".join(lines) + "\n"
