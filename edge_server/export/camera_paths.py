"""Paths of a rendering camera: about what a run's cameras saw, or as nerfstudio's viewer saved one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from edge_server.export import ExportError
from edge_server.export.export_constants import MOST_FRAMES, WIDEST_GAP_DEG
from edge_server.fields import View
from freshfield.geometry import GeometryError, Pinhole, converging_point, look_at, world_up
from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.untrusted import UntrustedError, read_json, read_text

Matrix = NDArray[np.float64]

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # nerfstudio's camera axes: y up, z backward


@dataclass(frozen=True)
class Step:
    """One image of a path. camera_to_world: (4, 4), OpenCV axes. fov_deg: vertical field of view. lens: a camera's own,
    in place of that; None: a plain one."""

    camera_to_world: Matrix
    fov_deg: float
    lens: Pinhole | None = None


def lens(width: int, height: int, fov_deg: float) -> Pinhole:
    """A pinhole of a vertical field of view."""
    focal = height / 2 / math.tan(math.radians(fov_deg) / 2)
    return Pinhole(width, height, focal, focal, width / 2, height / 2)


def vertical_fov_deg(camera: Pinhole) -> float:
    return math.degrees(2 * math.atan(camera.height / 2 / camera.fy))


def orbit(views: Sequence[View], count: int, fov_deg: float) -> list[Step]:
    """A closed path of ``count`` steps at the cameras' median height and distance, looking at what they look at.

    It goes round where cameras stand all round, else to and fro along their arc, so that it shows what was seen.
    Cameras that look outward or the same way have nothing in common: the path then turns on the spot between them, as
    far as they look.
    """
    poses = np.array([v.camera_to_world for v in views], np.float64)
    ahead, places = poses[:, :3, 2], poses[:, :3, 3]
    up = world_up(poses)
    first = _unit(np.cross(up, [1.0, 0.0, 0.0]), np.cross(up, [0.0, 1.0, 0.0]))
    axes = np.stack([first, np.cross(up, first)])
    center = converging_point(places, ahead)
    outward = center is None
    middle = np.median(places, axis=0) if center is None else center
    arms = ahead if center is None else places - center
    flat = arms @ axes.T
    angles = _sweep(np.arctan2(flat[:, 1], flat[:, 0]), count)
    radius, height = float(np.median(np.hypot(*flat.T))), float(np.median(arms @ up))
    rim = middle + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) @ axes + height * up
    # Looking outward, the rim is where it looks; else where it stands.
    pairs = ((middle, at) for at in rim) if outward else ((at, middle) for at in rim)
    return [Step(look_at(eye, target, up), fov_deg) for eye, target in pairs]


def looking(eye: Sequence[float], target: Sequence[float], fov_deg: float) -> list[Step]:
    """One step. Raises ExportError if both are one point, or a number is not finite."""
    if not np.isfinite([*eye, *target]).all():
        raise ExportError("--pose: expected finite numbers")
    try:
        return [Step(look_at(eye, target), fov_deg)]
    except GeometryError as error:
        raise ExportError(f"--pose: {error}") from None


_Side = Annotated[int, Meta(ge=2, le=MAX_IMAGE_SIDE_PX)]


class _Pose(msgspec.Struct):
    camera_to_world: Annotated[list[float], Meta(min_length=16, max_length=16)]
    fov: Annotated[float, Meta(ge=1.0, le=170.0)] = 50.0


class _CameraPath(msgspec.Struct):
    """What is read of a ``camera_path.json``."""

    render_width: _Side
    render_height: _Side
    camera_path: Annotated[list[_Pose], Meta(min_length=1, max_length=MOST_FRAMES)]
    camera_type: Literal["perspective"] = "perspective"
    fps: Annotated[float, Meta(ge=0.1, le=240.0)] | None = None
    seconds: float = 1.0


def read_nerfstudio(file: Path) -> tuple[list[Step], float, tuple[int, int]]:
    """A ``camera_path.json`` of nerfstudio's viewer: its steps, frames a second, width and height.

    Its poses are read as being in the run's own world. ExportError names the key that is wrong.
    """
    try:
        path = msgspec.convert(read_json(read_text(file)), _CameraPath)
        fps = path.fps or len(path.camera_path) / max(path.seconds, 1e-3)
        if not 0.1 <= fps <= 240.0:
            raise ValueError(f"seconds: expected enough for 0.1 to 240 poses a second, got {path.seconds:g}")
        steps = [_step(pose, f"camera_path[{k}]") for k, pose in enumerate(path.camera_path)]
        return steps, fps, (path.render_width, path.render_height)
    except (OSError, UntrustedError, ValueError) as error:
        raise ExportError(f"--path {file}: {error}") from None


def _step(pose: _Pose, where: str) -> Step:
    matrix = np.array(pose.camera_to_world, np.float64).reshape(4, 4)
    turn = matrix[:3, :3]
    if not np.isfinite(matrix).all() or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise ValueError(f"{where}.camera_to_world: expected a rotation and a translation")
    return Step(matrix @ _OPENGL, pose.fov)


def _sweep(azimuths: Matrix, count: int) -> Matrix:
    """Angles (count,): a full turn, or to and fro over all ``azimuths`` where no camera stands in a wide gap."""
    ordered = np.sort(azimuths % (2 * np.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    phase = np.arange(count) / count * 2 * np.pi
    start = ordered[(widest + 1) % len(ordered)]
    if gaps[widest] < np.radians(WIDEST_GAP_DEG):
        return start + phase
    return start + (2 * np.pi - gaps[widest]) * (1 - np.cos(phase)) / 2


def _unit(vector: Matrix, otherwise: Matrix) -> Matrix:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else otherwise / np.linalg.norm(otherwise)
