"""A camera that measures depth with each frame."""

from fractions import Fraction

import numpy as np

from camera_node.capture import Camera, ShotCache
from camera_node.settings import WorldConfig
from camera_node.sources.base import Shot, Source
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose

POSE = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
LENS = Pinhole.from_fov(32, 24, 60.0)


class DepthSource(Source):
    """contents: see ``Source``. unit: meters a count. error: raised instead of giving depth. depth: further keys of
    each shot's ``DepthImage``, whose counts are the shot's number + 1."""

    fps, intrinsics = Fraction(10), LENS

    def __init__(self, camera: str, contents: int | None = None, unit=0.001, error: Exception | None = None, **depth):
        self.camera, self.contents = camera, contents
        self._unit, self._error, self._depth = unit, error, depth

    def content(self, tick: int) -> int:
        return tick if self.contents is None else tick % self.contents

    def read(self, content: int) -> Shot:
        image = np.full((24, 32, 3), content % 200, np.uint8)
        counts = np.full((24, 32), content + 1, np.uint16)
        return Shot(image, POSE, LENS, depth=DepthImage(counts, self._unit, **self._depth))

    def depth(self, content: int, shot: Shot) -> DepthImage | None:
        if self._error is not None:
            raise self._error
        return super().depth(content, shot)


def depth_camera(every: int, contents: int | None = None, cache: ShotCache | None = None, **depth) -> Camera:
    """One in ``every`` of its shots is to bring depth."""
    source = DepthSource("cam01", contents, **depth)
    return Camera(source, WorldConfig(kind="world"), cache or ShotCache(10**6), depth_every=every)
