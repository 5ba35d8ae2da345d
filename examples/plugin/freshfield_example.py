"""A source, a policy and an effect for freshfield, to copy and change."""

from typing import Annotated, ClassVar

import numpy as np

from camera_node.settings import SourceConfig
from camera_node.sources.base import Shot, Source, rate
from camera_node.synthetic.effects import EffectParameters
from edge_server.scheduler import Policy
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.settings import within


class Bar(Source):
    """A bright bar that moves across a dark image, before cameras side by side. Replace ``read`` by your camera."""

    class Config(SourceConfig, frozen=True):
        bar_px: Annotated[int, within(1, 32, "width of the bar")] = 8

    intrinsics = Pinhole.from_fov(64, 48, 60.0)
    contents = 64  # frames until they repeat; leave it out if they never do

    def __init__(self, scenario, config, camera):
        self.camera, self.fps, self.width = camera, rate(config.fps or 10), config.bar_px
        place = (2.0, 0.2 * scenario.cameras.index(camera), 1.0)
        self.pose = Pose.from_matrix(look_at(place, (0.0, 0.0, 0.5)))  # camera-to-world, meters

    def content(self, tick):
        return tick % self.contents

    def read(self, content):
        image = np.full((48, 64, 3), 40, np.uint8)  # (H, W, 3) RGB
        image[:, content : content + self.width] = 220
        return Shot(image, self.pose, self.intrinsics)


class LeastUsed(Policy):
    """The k cameras that were used least often so far; among equals, those with the youngest frames."""

    parameter = "k"
    value = 2

    def __init__(self, value, rng):
        super().__init__(value, rng)
        self._used = {}

    def select(self, epoch, window):
        order = sorted(epoch.generated_ns, key=lambda camera: (self._used.get(camera, 0), epoch.age_ms(camera)))
        chosen = tuple(order[: self.value])
        for camera in chosen:
            self._used[camera] = self._used.get(camera, 0) + 1
        return chosen


class Vignette(EffectParameters, frozen=True):
    """Darkens an image towards its corners, by the square of the distance from its center."""

    loss: Annotated[float, within(0.0, 1.0, "share of the light that the corners lose")] = 0.4
    kind: ClassVar[str] = "image"

    def apply(self, image, index, t_s):
        y, x = (np.linspace(-1.0, 1.0, n) if n > 1 else np.zeros(1) for n in image.shape[:2])
        kept = 1.0 - self.loss * (x[None, :, None] ** 2 + y[:, None, None] ** 2) / 2.0
        return np.rint(image * kept).astype(np.uint8)
