"""The camera node as a library: numpy images with poses go to an edge server, or an emulator before it.

python examples/numpy_camera.py mine.yaml 127.0.0.1:7000 30      # mine.yaml, which the edge runs, names cam01
"""

import asyncio
import sys
from fractions import Fraction

import numpy as np

from camera_node.capture import Camera, ShotCache
from camera_node.node import Node, NodeOptions
from camera_node.settings import SourceConfig
from camera_node.sources.base import Shot, Source
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.scenario import load
from freshfield.transport import Transport


class Mine(Source):
    camera, fps, intrinsics = "cam01", Fraction(10), Pinhole.from_fov(64, 48, 60.0)

    def read(self, content):
        image = np.full((48, 64, 3), content % 256, np.uint8)  # (H, W, 3) RGB: yours
        return Shot(image, Pose.from_matrix(look_at((2.0, 0.0, 1.0), (0.0, 0.0, 0.5))), self.intrinsics)


options = NodeOptions(sys.argv[2], Transport(), seconds=float(sys.argv[3]))
node = Node(load(sys.argv[1]), [Camera(Mine(), SourceConfig(kind="mine"), ShotCache(0))], options)
asyncio.run(node.run())
print(node.failure() or f"{node.outboxes['cam01'].counts['accepted']} frames taken")
