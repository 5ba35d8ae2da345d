"""Reference images for scoring in virtual time: the exact scene, or the nearest capture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.capture import Camera
from camera_node.sources.base import Shot
from edge_server.experiments.experiment_constants import NOISE_FRAMES
from edge_server.fidelity.fidelity_constants import MOVING_BOUND, MOVING_LAGS_MS
from edge_server.fidelity.moving_pixels import NoiseEstimate, frames_at_lags
from edge_server.fidelity.refined import render_refined, with_refined
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fields import View
from freshfield import payload
from freshfield.geometry import Pinhole

# Image uint8 (H, W, 3), intrinsics, camera-to-world (4, 4).
Seen = tuple[NDArray[np.uint8], Pinhole, NDArray[np.float64]]


@dataclass(frozen=True)
class ExactTruth:
    """A synthetic scene rendered at the exact instant of scoring.

    cameras: held-out camera -> (intrinsics, camera-to-world).
    image: (camera, seconds) -> uint8 (H, W, 3).
    """

    scorer: Scorer
    cameras: dict[str, tuple[Pinhole, NDArray[np.float64]]]
    image: Callable[[str, float], NDArray[np.uint8]]

    def of(self, cameras: Sequence[str]) -> ExactTruth:
        """The truth of some of the cameras."""
        return replace(self, cameras={camera: self.cameras[camera] for camera in cameras})

    def nearest_ns(self, present_ns: int) -> int:
        """The instant itself: the truth is known at any."""
        return present_ns

    def view(self, camera: str, present_ns: int) -> Seen:
        """Image of a held-out camera at an instant, intrinsics and camera-to-world pose."""
        return self.image(camera, present_ns / 1e9), *self.cameras[camera]

    def score(self, field: Any, present_ns: int) -> Score:
        """Mean score over the held-out cameras. Earlier renders define the moving pixels; an
        analytic scene has them before the first frame, too."""
        lags_ns = [round(lag * 1e6) for lag in MOVING_LAGS_MS]
        scores = []
        for camera, (intrinsics, pose) in self.cameras.items():
            truth = self.image(camera, present_ns / 1e9)
            earlier = [self.image(camera, (present_ns - lag) / 1e9) for lag in lags_ns]
            view = View(camera, truth, pose, intrinsics, present_ns)
            scores.append(_score(self.scorer, field, view, present_ns, earlier))
        return mean_score(scores)


class CapturedTruth:
    """The captures of held-out cameras: the one nearest to the present, at most half a period away.

    noisy: real video; its noise sets the moving-pixel bound.
    """

    def __init__(self, scorer: Scorer, cameras: Sequence[Camera], noisy: bool = False) -> None:
        self._scorer = scorer
        self._cameras = tuple(cameras)
        self._bounds = {
            c.name: noise_bound(_image(c, c.capture(k)) for k in range(NOISE_FRAMES)) if noisy else MOVING_BOUND
            for c in cameras
        }

    def of(self, cameras: Sequence[str]) -> CapturedTruth:
        """The truth of some of the cameras."""
        some = copy(self)
        some._cameras = tuple(c for c in self._cameras if c.name in cameras)
        return some

    def nearest_ns(self, present_ns: int) -> int:
        """The instant of the first held-out camera's capture nearest to ``present_ns``."""
        return _instant_ns(self._cameras[0], _nearest(self._cameras[0], present_ns))

    def view(self, camera: str, present_ns: int) -> Seen:
        """Held-out capture nearest to an instant: image, intrinsics and camera-to-world pose."""
        source = next(c for c in self._cameras if c.name == camera)
        shot = source.capture(_nearest(source, present_ns))
        return _image(source, shot), shot.intrinsics, shot.pose.matrix()

    def score(self, field: Any, present_ns: int) -> Score:
        """Mean score over the held-out cameras."""
        scores = []
        for camera in self._cameras:
            tick = _nearest(camera, present_ns)
            shot = camera.capture(tick)
            ticks = range(max(0, tick - round(1.5 * MOVING_LAGS_MS[-1] * float(camera.fps) / 1e3)), tick + 1)
            times = [_instant_ns(camera, k) for k in ticks]
            lags = [ticks[i] for i in frames_at_lags(times, times[-1])]
            before = [camera.capture(k) for k in lags]
            earlier = [_image(camera, b) for b in before if b.pose == shot.pose]
            view = View(camera.name, _image(camera, shot), shot.pose.matrix(), shot.intrinsics, times[-1])
            scores.append(_score(self._scorer, field, view, present_ns, earlier, self._bounds[camera.name]))
        return mean_score(scores)


Truth = ExactTruth | CapturedTruth
"""Scores renders of the field at the present."""


def _score(
    scorer: Scorer,
    field: Any,
    view: View,
    present_ns: int,
    earlier: list[NDArray[np.uint8]],
    bound: float = MOVING_BOUND,
) -> Score:
    shown = field.render(view.camera_to_world, view.intrinsics).color
    score = scorer.score(view.camera, shown, present_ns, view.image, view.generated_ns, earlier, bound)
    return with_refined(score, render_refined(field, view), view, scorer)


def _nearest(camera: Camera, at_ns: int) -> int:
    return round(at_ns * camera.fps.numerator / (camera.fps.denominator * 1e9))


def _instant_ns(camera: Camera, tick: int) -> int:
    return tick * 10**9 * camera.fps.denominator // camera.fps.numerator


def _image(camera: Camera, shot: Shot) -> NDArray[np.uint8]:
    return payload.decode(shot.payload, camera.codec, shot.intrinsics.width, shot.intrinsics.height)


def noise_bound(images: Iterable[NDArray[np.uint8]]) -> float:
    """Minimum difference of a moving pixel in real video, from the noise of consecutive camera images."""
    estimate = NoiseEstimate()
    for a, b in pairwise(images):
        estimate.add(a, b)
    return estimate.bound
