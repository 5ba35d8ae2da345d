"""Small data sets written on the spot: real files for real sources, without a download."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from camera_node.settings import source_config
from camera_node.sources.base import Source
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.registry import open_sources
from freshfield.geometry import OPENGL_TO_OPENCV, look_at
from freshfield.scenario import Scenario, parse
from tests.support import refused

BOMB = b"P6\n60000 60000\n255\n"
"""A picture file that states 10 GB of pixels."""


def picture(seed: int, width: int = 32, height: int = 24, channels: int = 3) -> np.ndarray:
    """A smooth random image, uint8 (height, width, channels)."""
    coarse = np.random.default_rng(seed).integers(0, 256, (4, 5, channels), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


def pose_of(index: int) -> np.ndarray:
    """Camera-to-world (4, 4) of image ``index``: on a circle, looking at the middle."""
    return look_at([3 * np.cos(index / 5), 3 * np.sin(index / 5), 1.0], [0, 0, 0])


def write_photos(folder: Path, count: int, cameras: int = 0, suffix: str = ".png", **top: Any) -> Path:
    """``count`` images (of each camera) and a transforms JSON; with ``cameras`` a recording at 10 frames a
    second. Returns the JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index in range(count * max(1, cameras)):
        name = f"images/{index:03d}{suffix}"
        (folder / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), picture(index))
        frame: dict[str, Any] = {"file_path": name, "transform_matrix": (pose_of(index) @ OPENGL_TO_OPENCV).tolist()}
        if cameras:
            frame |= {"camera": f"cam{index // count:02d}", "time": (index % count) / 10}
        frames.append(frame)
    data = {"fl_x": 40.0, "fl_y": 41.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24, **top, "frames": frames}
    file = folder / "transforms.json"
    file.write_text(json.dumps(data))
    return file


def edited(file: Path, change: Callable[[Any], Any] | None = None, **top: Any) -> Path:
    """The transforms JSON after a change of its contents. top: keys at its top; None takes one away."""
    data = {key: value for key, value in (json.loads(file.read_text()) | top).items() if value is not None}
    if change is not None:
        change(data)
    file.write_text(json.dumps(data))
    return file


fails = partial(refused, DatasetError)


def opened(scenario: Scenario, cameras: Sequence[str] = (), data: Path | None = None) -> dict[str, Source]:
    """The sources of a scenario's cameras, or of those named."""
    return open_sources(scenario, source_config(scenario), cameras or scenario.cameras, data)


def photo_scenario(data: Path, cameras: int = 3, file: Path = Path("test.yaml"), **source: Any) -> Scenario:
    """cam00 is held out; 20 captures a second unless told otherwise."""
    section = {"kind": "transforms", "data": str(data), "fps": 20, "codec": "png", **source}
    top = {"name": "photos", "seed": 3, "cameras": {"count": cameras, "held_out": ["cam00"]}}
    return parse({**top, "source": section}, file)
