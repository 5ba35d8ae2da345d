"""Pictures of a ChArUco board through a camera on a simulated hand: rendered once for all tests."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from camera_node.calibrate import simulate
from camera_node.calibrate.targets import parse
from freshfield.geometry import Pinhole

BOARD = "charuco:7x5:24mm:18mm"
LENS = Pinhole.from_fov(320, 240, 65.0)


@lru_cache(maxsize=1)
def taken(count: int = 12) -> tuple[list[np.ndarray], np.ndarray]:
    """Grey pictures, and the hand's true poses (N, 4, 4)."""
    hands = simulate.random_hands(count, np.random.default_rng(3))
    board = parse(BOARD)
    return [simulate.render(board, LENS, simulate.camera_in_target(h), 2) for h in hands], hands
