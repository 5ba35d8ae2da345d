"""Pictures of a ChArUco board through a camera on a simulated hand: rendered once for all tests."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from camera_node.robot.calibration.hand_eye import simulated
from camera_node.robot.calibration.targets import parse_target
from freshfield.geometry import OPENGL_TO_OPENCV, Pinhole

BOARD = "charuco:7x5:24mm:18mm"
LENS = Pinhole.from_fov(320, 240, 65.0)


@lru_cache(maxsize=1)
def taken(count: int = 12) -> tuple[list[np.ndarray], np.ndarray]:
    """Gray pictures, and the hand's true poses (N, 4, 4)."""
    hands = simulated.random_hands(count, np.random.default_rng(3))
    board = parse_target(BOARD)
    return [simulated.render(board, LENS, simulated.camera_in_target(h), 2) for h in hands], hands


def write_scenario(
    folder: Path, lens: Pinhole, pictures: Sequence[NDArray[np.uint8]], poses: Sequence[NDArray[np.float64]]
) -> Path:
    """A scenario in ``folder`` whose one camera, eye, plays pictures with their poses (4, 4)."""
    frames = []
    for k, (picture, pose) in enumerate(zip(pictures, poses)):
        cv2.imwrite(str(folder / f"{k}.png"), picture)
        frames.append({"file_path": f"{k}.png", "transform_matrix": (pose @ OPENGL_TO_OPENCV).tolist()})
    about = {
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.fx,
        "fl_y": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
    }
    (folder / "transforms.json").write_text(json.dumps({**about, "frames": frames}))
    file = folder / "bench.yaml"
    source = {"kind": "transforms", "data": str(folder / "transforms.json"), "fps": 500, "codec": "png"}
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    return file
