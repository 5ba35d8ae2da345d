"""A source, a policy, an effect, a fault, a selector and a field as a user writes them; and policies that fail."""

from fractions import Fraction
from typing import Annotated, ClassVar

import numpy as np

from camera_node.settings import SourceConfig
from camera_node.sources.base import Shot, Source
from camera_node.synthetic.effects import EffectParameters
from channel_emu.model.link import Fault
from edge_server.fields import FitReport, Rendering
from edge_server.fields.common.settings import FieldSettings
from edge_server.scheduler import Policy
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.settings import Settings, within


class Turning(Source):
    """A gray that grows with each frame, before a camera that somebody turned."""

    class Config(SourceConfig, frozen=True):
        level: Annotated[int, within(0, 255, "of the first frame")] = 40

    fps, contents = Fraction(10), 50
    intrinsics = Pinhole.from_fov(32, 24, 60.0)

    def __init__(self, scenario, config, camera):
        self.camera, self.level = camera, config.level
        self.pose = Pose.from_matrix(look_at((2.0, scenario.cameras.index(camera), 1.0), (0.0, 0.0, 0.5)))

    def content(self, tick):
        return tick % self.contents

    def read(self, content):
        return Shot(np.full((24, 32, 3), (self.level + content) % 256, np.uint8), self.pose, self.intrinsics)


class RaisesOften(Turning):
    """Every other capture fails in a way that nobody foresaw."""

    def read(self, content):
        if content % 2:
            raise KeyError("no such frame")
        return super().read(content)


class Youngest(Policy):
    """The k youngest frames."""

    parameter = "k"
    value = 1

    def select(self, epoch, window):
        return tuple(sorted(epoch.generated_ns, key=epoch.age_ms)[: self.value])


class RaisesInPlan(Youngest):
    def plan(self, epoch):
        raise RuntimeError("no plan")


class RaisesInSelect(Youngest):
    def select(self, epoch, window):
        raise RuntimeError("no choice")


class NamesNobody(Youngest):
    def select(self, epoch, window):
        return ("cam99",)


class Darker(EffectParameters, frozen=True):
    """Takes so many counts from every pixel."""

    counts: Annotated[int, within(0, 255, "of 255")] = 20
    kind: ClassVar[str] = "image"

    def apply(self, image, index, t_s):
        return np.maximum(image, self.counts) - np.uint8(self.counts)


class Late(Fault):
    """Adds a constant delay."""

    class Params(Settings, frozen=True):
        ms: Annotated[float, within(0, 1e4, "added to each delay")] = 10.0

    def __init__(self, params, seed, camera):
        self.ns = round(params.ms * 1e6)

    def extra_ns(self, transit):
        return self.ns


class LastFirst:
    name = "last first"

    def values(self, state):
        return np.arange(len(state.open), dtype=float)


class Flat:
    """One gray, whatever was seen."""

    class Settings(FieldSettings, frozen=True):
        name = "flat"
        level: Annotated[float, within(0, 1, "gray")] = 0.5

    frame_s = None
    most_pixels = None
    views = ()

    def __init__(self, settings):
        self.settings = settings

    def fit(self, views, budget):
        self.views = tuple(views)
        return FitReport(steps=1, seconds=0.0, loss=0.0, rays=0, samples=0)

    def render(self, camera_to_world, intrinsics):
        shape = intrinsics.height, intrinsics.width
        gray = np.full((*shape, 3), self.settings.level, np.float32)
        return Rendering(gray, np.zeros(shape, np.float32), np.ones(shape, np.float32))

    def snapshot(self, present_ns=None):
        return self

    def at(self, present_ns):
        return self

    def warm_up(self, cameras=None):
        return 0.0

    def state(self):
        return {"level": np.array(self.settings.level)}

    def load_state(self, state):
        if set(state) != {"level"}:
            raise ValueError("not the state of a flat field")

    def reset(self):
        self.views = ()
