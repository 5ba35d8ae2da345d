"""A toy deployment for the page.

A ball circles over a plate, and cameras on an arc see it. The "field" is the analytic scene at the instant of an
update: what a perfect field would show. Only learning and network are left out.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering
from edge_server.live.state import CameraView, Comparison, Controls, EdgeState, Publication
from freshfield import payload
from freshfield.clock import WallClock
from freshfield.frame import Frame
from freshfield.geometry import Pinhole, Pose, look_at
from tests.edge_server.fields.scenes import seen

CAMERAS = 9
LENS = Pinhole.from_fov(128, 96, 55.0)
BALL_RADIUS_M = 0.55
ORBIT_RADIUS_M = 0.6
PERIOD_S = 6.0
UPDATE_S = 0.8


def bare_state(cameras: list[CameraView] | None = None) -> EdgeState:
    return EdgeState(
        scenario="bare",
        policies=(),
        controls=Controls("all", None),
        cameras=lambda: cameras or [],
        start_ns=0,
        now_ns=time.monotonic_ns,
        set_policy=MagicMock(side_effect=ValueError("no policies here")),
        save_snapshot=MagicMock(side_effect=OSError("full")),
    )


def publication(number: int) -> Publication:
    return Publication(number, float(number), 0, None, (), (), float("nan"), 1.0)


class BallScene:
    """The scene at one instant, as a Snapshot."""

    def __init__(self, t_s: float) -> None:
        angle = 2 * np.pi * t_s / PERIOD_S
        self.center = np.array([ORBIT_RADIUS_M * np.cos(angle), ORBIT_RADIUS_M * np.sin(angle), BALL_RADIUS_M])

    def at(self, present_ns: int) -> BallScene:
        return self

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        image, away_m = seen(intrinsics, camera_to_world, self.center, BALL_RADIUS_M)
        solid = np.isfinite(away_m)
        depth = np.where(solid, away_m, 0.0).astype(np.float32)
        return Rendering((image / 255.0).astype(np.float32), depth, solid.astype(np.float32))


class Preview(threading.Thread):
    """The cameras and updates of the toy deployment, on a thread of its own."""

    def __init__(self, silent: int = 0) -> None:
        """silent: how many cameras never report. The middle one is held out."""
        super().__init__(name="preview", daemon=True)
        self._clock = WallClock()
        self._over = threading.Event()
        self.names = tuple(f"cam{i:02d}" for i in range(CAMERAS))
        self._reporting = self.names[: CAMERAS - silent]
        self._held_out = self.names[CAMERAS // 2]
        self._poses = {name: _arc(i) for i, name in enumerate(self.names)}
        self._newest: dict[str, Frame] = {}
        self.state = replace(bare_state(), controls=Controls("threshold", 600.0), cameras=self.cameras)
        self.state.policies, self.state.field_name = ("all", "threshold"), "analytic"
        self.state.start_ns, self.state.now_ns = self._clock.now_ns(), self._clock.now_ns

    def stop(self) -> None:
        self._over.set()
        self.join(timeout=5.0)

    def cameras(self) -> list[CameraView]:
        now_ns, newest = self._clock.now_ns(), dict(self._newest)
        ages = {name: (now_ns - frame.generated_ns) / 1e6 for name, frame in newest.items()}
        return [CameraView(n, n == self._held_out, newest.get(n), ages.get(n), 1, 0) for n in self.names]

    def run(self) -> None:
        number = 0
        while not self._over.wait(UPDATE_S):
            now_ns = self._clock.now_ns()
            scene = BallScene((now_ns - self.state.start_ns) / 1e9)
            for name in self._reporting:
                image, pose = _uint8(scene.render(self._poses[name], LENS)), Pose.from_matrix(self._poses[name])
                held_out = name == self._held_out
                taken = Frame(name, "preview", number, now_ns, pose, LENS, "jpeg", payload.encode(image))
                self._newest[name] = replace(taken, held_out=held_out)
            truth = _uint8(scene.render(self._poses[self._held_out], LENS))
            used = tuple(name for name in self._reporting if name != self._held_out)
            found = {"psnr_db": 30.0, "scored_on": self._held_out}
            ages = (50.0,) * len(used)
            publication = Publication(number, self.state.now_s(), now_ns, 600.0, used, ages, 50.0, 20.0, **found)
            self.state.publish(publication, scene)
            self.state.scored(publication, Comparison(self._held_out, truth, truth, number))
            number += 1


def _arc(i: int) -> NDArray[np.float64]:
    """Pose of camera i on an arc of 150 degrees around the middle of the floor."""
    angle = np.deg2rad(-75.0 + 150.0 * i / (CAMERAS - 1))
    eye = (3.4 * np.cos(angle), 3.4 * np.sin(angle), 1.5 + 0.35 * (i % 2))
    return look_at(eye, (0.0, 0.0, 0.35))


def _uint8(image: Rendering) -> NDArray[np.uint8]:
    return (np.clip(image.color, 0, 1) * 255 + 0.5).astype(np.uint8)
