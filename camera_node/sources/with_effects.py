"""A recorded camera with effects on each of its frames: on images, as sensor noise, or on their poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

from camera_node.sources import Shot, Source
from freshfield import payload

if TYPE_CHECKING:
    from camera_node.synthetic.effects import Effects


class AffectedSource:
    """Another source's shots, each changed by the effects of its own tick, so that none repeats; a pose that
    is wrong by the same in every frame changes them once."""

    def __init__(self, source: Source, effects: Effects, codec: str) -> None:
        self.camera = source.camera
        self.fps = source.fps
        self.intrinsics = source.intrinsics
        self._each_differs = bool(effects.image) or effects.pose_varies
        self.contents: int | None = None if self._each_differs else source.contents
        self._source = source
        self._effects = effects
        self._codec = codec

    def content(self, tick: int) -> int:
        return tick if self._each_differs else self._source.content(tick)

    def read(self, content: int) -> Shot:
        shot = self._source.read(self._source.content(content) if self._each_differs else content)
        shot = dataclasses.replace(shot, pose=self._effects.claimed_pose(shot.pose, content))
        if not self._effects.image:
            return shot
        image = shot.image
        if isinstance(image, bytes):
            image = payload.decode(image, self._codec, shot.intrinsics.width, shot.intrinsics.height)
        return dataclasses.replace(shot, image=self._effects.apply(image, content, float(content / self.fps)))

    def prepare(self, stopped: Callable[[], bool]) -> None:
        self._source.prepare(stopped)

    def release(self) -> None:
        self._source.release()
