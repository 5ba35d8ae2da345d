"""Keyframes: earlier viewpoints of moving cameras, which continue to supervise the field.

The buffer holds only the newest frame of a camera. That suffices for a fixed camera; with a moving one, the field
would gradually forget what the camera no longer sees. So each used view becomes a keyframe if it is far enough from
all earlier ones of its camera; otherwise it replaces the image of the nearest one. Distances are measured from where
a keyframe was first taken, never from the image that replaced it: a slow camera would otherwise drag one keyframe
along for ever. The field sees keyframes as views of separate cameras, named ``hand#3``: no camera of a scenario may
have such a name. Their ages are real: a changing scene needs few keyframes, or a field that trusts old views less
(``age_tau_ms``).

A field trained on one or two viewpoints overfits to them, and later viewpoints do not undo that (measured: 3 dB in
the cell). So the field restarts each time the number of viewpoints has doubled, up to ``RESTARTS_BELOW``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from edge_server.fields import SEPARATOR, View
from edge_server.live import live_constants as tuned
from edge_server.live.camera_motion import pose_distance
from edge_server.settings import KeyframesConfig


@dataclasses.dataclass
class _Keyframe:
    """anchor: the view that created the keyframe and defines its place. view: its current image. apart: distance
    between the two; at 1, ``view`` would become another keyframe."""

    anchor: View
    view: View
    apart: float = 0.0


@dataclasses.dataclass
class _CameraKeyframes:
    """The keyframes of one camera by number, and the number of the one that it is at."""

    frames: dict[int, _Keyframe] = dataclasses.field(default_factory=dict)
    current: int | None = None


class Keyframes:
    """At most ``config.most`` keyframes of each camera; a new one replaces the oldest.

    resumed: the field was trained before, so that it never restarts.
    """

    def __init__(self, config: KeyframesConfig, resumed: bool = False) -> None:
        self.config = config
        self._cameras: dict[str, _CameraKeyframes] = {}
        self._started_with = tuned.RESTARTS_BELOW if resumed else 0

    def should_restart(self, count: int) -> bool:
        """Whether the field should restart with an update of ``count`` views. True counts as a restart."""
        if self._started_with == 0:  # first update: the field is new
            self._started_with = min(count, tuned.RESTARTS_BELOW)
            return False
        if self._started_with >= tuned.RESTARTS_BELOW or count < 2 * self._started_with:
            return False
        self._started_with = count
        return True

    def with_earlier(self, views: Sequence[View]) -> list[View]:
        """``views`` under their own names, followed by the keyframes of their cameras, except the one that
        each view lies at."""
        earlier: list[View] = []
        for view in views:
            camera = self._cameras.setdefault(view.camera, _CameraKeyframes())
            self._keep(camera, view)
            earlier.extend(kept.view for number, kept in camera.frames.items() if number != camera.current)
        return [*views, *earlier]

    def clear(self) -> None:
        """Forget all keyframes: the scene is a new one."""
        self._cameras.clear()
        self._started_with = 0

    def __len__(self) -> int:
        return sum(len(camera.frames) for camera in self._cameras.values())

    def _keep(self, camera: _CameraKeyframes, view: View) -> None:
        """Make ``view`` a keyframe, or the image of the one it lies at."""
        frames = camera.frames
        apart, number = min(
            ((self._apart(kept.anchor, view), each) for each, kept in frames.items()), default=(np.inf, 0)
        )
        if apart >= 1.0:
            number, apart = len(frames), 0.0
            if number == self.config.most:
                number = min(frames, key=lambda each: frames[each].view.generated_ns)
            frames[number] = _Keyframe(view, self._named(view, number))
        elif frames[number].view.generated_ns != view.generated_ns and (
            # Otherwise a slow camera that leaves would give every keyframe an image from its boundary.
            camera.current != number or apart <= max(tuned.NEAR_KEYFRAME, frames[number].apart)
        ):
            frames[number].view, frames[number].apart = self._named(view, number), apart
        camera.current = number

    def _apart(self, a: View, b: View) -> float:
        """Distance of two views; at 1 they become separate keyframes; infinite with different lenses."""
        if a.intrinsics != b.intrinsics:
            return np.inf
        apart_m, apart_deg = pose_distance(a.camera_to_world, b.camera_to_world)
        return max(_share(apart_m, self.config.apart_m), _share(apart_deg, self.config.apart_deg))

    @staticmethod
    def _named(view: View, number: int) -> View:
        return dataclasses.replace(view, camera=f"{view.camera}{SEPARATOR}{number}")


def _share(distance: float, limit: float) -> float:
    """``distance / limit``; with a limit of zero every view becomes a keyframe."""
    return distance / limit if limit > 0.0 else np.inf
