"""Small recorded data sets and a small field for the tests of edge_server.experiments."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from camera_node.synthetic import make_scene
from freshfield.geometry import OPENGL_TO_OPENCV, Pinhole

# Enough of a field to learn a small scene in a second; results do not depend on threads.
SMALL: dict[str, Any] = {"levels": 4, "log2_table": 12, "batch_samples": 8192, "rays": 2048, "samples": 64}
SMALL_WORDS = ["--field", "ngp"] + [word for key, value in SMALL.items() for word in ("--option", f"{key}={value}")]


def write_photos(
    folder: Path, count: int = 9, size: int = 32, alpha: bool = False, more: Callable[[int], dict] = lambda k: {}
) -> Path:
    """Photos of scene ``tile`` as a NeRF-synthetic folder: images/NNN.png and transforms_train.json, where frame k has
    ``more`` keys."""
    scene = make_scene("tile", {"count": count, "width": size, "height": size, "supersample": 1})
    frames = []
    for k, (camera, (_, pose)) in enumerate(scene.cameras.items()):
        image = scene.render(camera, 0.0)
        if alpha:
            mask = (np.indices(image.shape[:2]).sum(0) > size // 2).astype(np.uint8) * 255
            image = np.dstack([image, mask])
        _write(folder / "images" / f"{k:03d}.png", image)
        frames.append({"file_path": f"./images/{k:03d}", "transform_matrix": _opengl(pose), **more(k)})
    return _save(folder / "transforms_train.json", scene.cameras["cam00"][0], frames)


def write_recording(folder: Path, cameras: int = 5, instants: int = 3, size: int = 32) -> Path:
    """A recording of scene ``room`` by several cameras, nerfstudio with time and camera."""
    scene = make_scene("room", {"count": cameras, "width": size, "height": size, "supersample": 1})
    frames = []
    for camera, (_, pose) in scene.cameras.items():
        for k in range(instants):
            name = f"images/{camera}/{k:04d}.png"
            _write(folder / name, scene.render(camera, k / 10.0))
            about = {"camera": camera, "time": k / 10.0}
            frames.append({"file_path": name, "transform_matrix": _opengl(pose), **about})
    return _save(folder / "transforms.json", scene.cameras["cam00"][0], frames)


def _opengl(pose: Any) -> list[list[float]]:
    matrix: list[list[float]] = (np.asarray(pose) @ OPENGL_TO_OPENCV).tolist()
    return matrix


def _write(path: Path, image: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    order = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    assert cv2.imwrite(str(path), cv2.cvtColor(image, order))


def _save(path: Path, lens: Pinhole, frames: list[dict[str, Any]]) -> Path:
    facts = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height}
    path.write_text(json.dumps({**facts, "frames": frames}))
    return path
