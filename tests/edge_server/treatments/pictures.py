"""Pictures whose future is known: a textured patch that crosses a textured wall at a steady pace."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from freshfield.geometry import Pinhole, look_at

MS = 1_000_000
WIDTH, HEIGHT = 128, 96
LENS = Pinhole.from_fov(WIDTH, HEIGHT, 60.0)
POSE = look_at([2.0, 0.0, 1.0], [0.0, 0.0, 0.0])


def texture(height: int, width: int, seed: int) -> NDArray[np.float32]:
    """float32 (H, W, 3) in 0..255, smooth enough to be followed."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(20.0, 235.0, (height // 5 + 2, width // 5 + 2, 3)).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


def picture(t_ms: float, px_per_ms: float = 0.08, noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
    """The wall with a patch of 30 x 26 pixels that begins at column 30; noise: standard deviation, of 255."""
    image = texture(HEIGHT, WIDTH, 1)
    shift = np.array([[1, 0, 30 + px_per_ms * t_ms], [0, 1, 35]], np.float32)
    size = (WIDTH, HEIGHT)
    patch = cv2.warpAffine(texture(26, 30, 2), shift, size, flags=cv2.INTER_LINEAR)
    alpha = cv2.warpAffine(np.ones((26, 30), np.float32), shift, size, flags=cv2.INTER_LINEAR)[..., None]
    image = image * (1.0 - alpha) + patch * alpha
    rng = np.random.default_rng([seed, round(t_ms)])
    return np.clip(image + noise * rng.standard_normal(image.shape) + 0.5, 0, 255).astype(np.uint8)


def view(image: NDArray[np.uint8], t_ms: float, camera: str = "cam01", **other) -> View:
    values = {"camera_to_world": POSE, "intrinsics": LENS, "generated_ns": round(t_ms * MS), **other}
    return View(camera, image, **values)


def seen(t_ms: float, camera: str = "cam01", **other) -> View:
    """What a camera that stands still sees at an instant."""
    return view(picture(t_ms, **other), t_ms, camera)
