"""A toy deployment for the page.

A ball circles over a floor. Cameras on an arc capture it, a toy network delays the images, and the "field" is
the analytic scene at the mean capture time of the views that the policy selects: what a perfect field would
show. Ages, policies and scores are computed, so their relations are real; only the learning is left out.
"""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.psnr import psnr
from edge_server.fields import Rendering
from edge_server.live.state import CameraView, Comparison, Controls, EdgeState, Publication
from edge_server.scheduler import POLICIES, Epoch, Policy, make_policy
from freshfield import payload
from freshfield.clock import WallClock
from freshfield.frame import Frame
from freshfield.geometry import Pinhole, Pose, look_at, world_rays

CAMERAS = 9
LENS = Pinhole.from_fov(128, 96, 55.0)
BALL_RADIUS_M = 0.55
ORBIT_RADIUS_M = 0.6
PERIOD_S = 6.0
CAPTURE_S = 0.25
UPDATE_S = 0.8
FLOOR_RADIUS_M = 2.2
EMPTY = np.array([0.10, 0.115, 0.135])
_SUN = np.array([0.4, -0.5, 0.77])


class BallScene:
    """The scene at one instant, as a Snapshot. Empty space is dark blue."""

    def __init__(self, t_s: float) -> None:
        angle = 2 * np.pi * t_s / PERIOD_S
        self.center = np.array([ORBIT_RADIUS_M * np.cos(angle), ORBIT_RADIUS_M * np.sin(angle), BALL_RADIUS_M])
        self.spin = 3.0 * angle

    def at(self, present_ns: int) -> BallScene:
        return self

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        origin, rays = world_rays(intrinsics, camera_to_world)
        toward = origin - self.center
        b = rays @ toward
        root = b * b - (toward @ toward - BALL_RADIUS_M**2)
        ball = np.where(root > 0, -b - np.sqrt(np.maximum(root, 0)), np.inf)
        ball = np.where(ball > 0, ball, np.inf)
        down = np.where(rays[..., 2] < -1e-6, rays[..., 2], -1e-6)
        floor = np.where(rays[..., 2] < -1e-6, -origin[2] / down, np.inf)
        spot = origin + rays * np.where(np.isfinite(floor), floor, 0.0)[..., None]
        floor = np.where((floor > 0) & (np.hypot(spot[..., 0], spot[..., 1]) < FLOOR_RADIUS_M), floor, np.inf)
        depth = np.minimum(ball, floor)
        seen = np.isfinite(depth)
        hit = origin + rays * np.where(seen, depth, 0.0)[..., None]
        color = np.where((ball <= floor)[..., None], self._ball_color(hit), self._floor_color(hit))
        color = np.where(seen[..., None], color, EMPTY)
        return Rendering(
            color.astype(np.float32), np.where(seen, depth, 0.0).astype(np.float32), seen.astype(np.float32)
        )

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        half = count // 2
        rng = np.random.default_rng(0)
        directions = rng.normal(size=(half, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        ball = self.center + BALL_RADIUS_M * directions
        radius, angle = FLOOR_RADIUS_M * np.sqrt(rng.random(half)), 2 * np.pi * rng.random(half)
        floor = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(half)], axis=1)
        colors = np.concatenate([self._ball_color(ball), self._floor_color(floor)])
        return np.concatenate([ball, floor]).astype(np.float32), colors.astype(np.float32)

    def _ball_color(self, at: NDArray) -> NDArray:
        normal = (at - self.center) / BALL_RADIUS_M
        turned = np.arctan2(normal[..., 1], normal[..., 0]) - self.spin
        stripe = 0.5 + 0.5 * np.sign(np.sin(6 * turned) * np.sin(9 * normal[..., 2]))
        base = np.where(stripe[..., None] > 0.5, (0.93, 0.42, 0.20), (0.98, 0.86, 0.66))
        return base * (0.35 + 0.65 * np.clip(normal @ _SUN, 0, 1))[..., None]

    def _floor_color(self, at: NDArray) -> NDArray:
        checks = (np.floor(at[..., 0] * 2) + np.floor(at[..., 1] * 2)) % 2
        base = np.where(checks[..., None] > 0.5, (0.55, 0.62, 0.66), (0.30, 0.37, 0.43))
        gap = np.hypot(at[..., 0] - self.center[0], at[..., 1] - self.center[1]) / BALL_RADIUS_M
        return base * (1 - 0.55 * np.exp(-(gap**2)))[..., None]


class Preview:
    """The cameras, network and updates of the toy deployment."""

    def __init__(self, folder: Path, cameras: int = CAMERAS, silent: int = 0, seed: int = 0) -> None:
        """folder: for snapshots. cameras: 3 or more. silent: how many of them never report."""
        if cameras < 3:
            raise ValueError(f"3 cameras or more are needed, not {cameras}: the middle one is held out")
        self._folder = folder
        self._clock = WallClock()
        self._start_ns = self._clock.now_ns()
        self._rng = np.random.default_rng(seed)
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self.names = tuple(f"cam{i:02d}" for i in range(cameras))
        self._silent = set(self.names[cameras - silent :])
        self._held_out = self.names[cameras // 2]
        self._poses = {name: _arc(i, cameras) for i, name in enumerate(self.names)}
        self._newest: dict[str, Frame] = {}
        self._in_flight: list[tuple[int, Frame]] = []
        self._delivered = dict.fromkeys(self.names, 0)
        self._congested = False
        self._policy: Policy = make_policy("threshold", 600.0, self._rng)
        self.state = EdgeState(
            scenario="preview",
            policies=tuple(POLICIES),
            controls=Controls(self._policy.name, self._policy.value),
            cameras=self.cameras,
            start_ns=self._start_ns,
            now_ns=self._clock.now_ns,
            set_policy=self._set_policy,
            save_snapshot=self._save_snapshot,
            channel=self._channel,
            field_name="analytic",
            bounds=np.array([[-2.5, -2.5, -0.1], [2.5, 2.5, 2.0]]),
        )
        self._threads = [
            threading.Thread(target=run, name=name, daemon=True)
            for name, run in (("preview-cameras", self._capture), ("preview-updates", self._update))
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def cameras(self) -> list[CameraView]:
        now_ns = self._clock.now_ns()
        with self._lock:
            newest = dict(self._newest)
        views = []
        for name in self.names:
            frame = newest.get(name)
            age = (now_ns - frame.generated_ns) / 1e6 if frame else None
            views.append(CameraView(name, name == self._held_out, frame, age, self._delivered[name], 0))
        return views

    def _channel(self) -> dict[str, Any]:
        """The channel's status, as the emulator writes it."""
        state = "high" if self._congested else "low"
        forwarded = sum(self._delivered.values())
        return {
            "preset": "toy",
            "discipline": "parallel",
            "states": ["low", "high"],
            "state": state,
            "counts": {"forwarded": forwarded},
        }

    # --- cameras and network --------------------------------------------------------------------

    def _capture(self) -> None:
        number = 0
        while not self._stopped.wait(CAPTURE_S / len(self.names)):
            self._deliver()
            name = self.names[number % len(self.names)]
            number += 1
            if name in self._silent:
                continue
            now_ns = self._clock.now_ns()
            if self._rng.random() < 0.02:
                self._congested = not self._congested
            image = _uint8(self._scene(now_ns).render(self._poses[name], LENS))
            frame = Frame(
                name,
                "preview",
                number,
                now_ns,
                Pose.from_matrix(self._poses[name]),
                LENS,
                "jpeg",
                payload.encode(image),
                held_out=name == self._held_out,
            )
            mean_ms = 0.0 if frame.held_out else (700.0 if self._congested else 90.0)
            self._in_flight.append((now_ns + round(1e6 * self._rng.exponential(mean_ms)), frame))

    def _deliver(self) -> None:
        now_ns = self._clock.now_ns()
        arrived = [item for item in self._in_flight if item[0] <= now_ns]
        self._in_flight = [item for item in self._in_flight if item[0] > now_ns]
        with self._lock:
            for _, frame in arrived:
                known = self._newest.get(frame.camera)
                self._delivered[frame.camera] += 1
                if known is None or known.generated_ns < frame.generated_ns:
                    self._newest[frame.camera] = frame

    # --- updates --------------------------------------------------------------------------------

    def _update(self) -> None:
        number = 0
        while not self._stopped.wait(UPDATE_S):
            controls = self.state.controls
            if controls.reset_requested:
                controls.reset_requested = False
                self.state.status_line = "the field was reset"
            if controls.paused:
                continue
            decided_ns = self._clock.now_ns()
            with self._lock:
                newest = {n: f for n, f in self._newest.items() if not f.held_out}
            generated = {n: f.generated_ns for n, f in newest.items()}
            epoch = Epoch(decided_ns, number, generated, received_ns=dict.fromkeys(newest, decided_ns))
            plan = self._policy.plan(epoch)
            selected = self._policy.select(epoch, plan)
            if not selected:
                self.state.status_line = "waiting for a frame that qualifies"
                continue
            captured_ns = np.array([newest[n].generated_ns for n in selected])
            renderer = self._scene(int(captured_ns.mean()))
            truth = _uint8(self._scene(decided_ns).render(self._poses[self._held_out], LENS))
            shown = _uint8(renderer.render(self._poses[self._held_out], LENS))
            now_ns = self._clock.now_ns()
            ages = tuple(float(a) for a in (now_ns - captured_ns) / 1e6)
            publication = Publication(
                number,
                self.state.now_s(),
                now_ns,
                plan.omega_ms,
                selected,
                ages,
                float(np.mean(ages)),
                (now_ns - decided_ns) / 1e6,
                scored_on=self._held_out,
            )
            self.state.status_line = f"used {len(selected)} views of {len(newest)}"
            self.state.publish(publication, renderer)
            self.state.scored(
                replace(publication, psnr_db=psnr(shown, truth)), Comparison(self._held_out, truth, shown, number)
            )
            number += 1

    def _scene(self, at_ns: int) -> BallScene:
        return BallScene((at_ns - self._start_ns) / 1e9)

    def _set_policy(self, name: str, value: float | None) -> None:
        self._policy = make_policy(name, value, self._rng)
        self.state.controls.policy, self.state.controls.value = self._policy.name, self._policy.value

    def _save_snapshot(self) -> Path:
        if not self.state.started:
            raise RuntimeError("there is nothing to save before the first update")
        path = self._folder / "preview-snapshot.json"
        path.write_text(json.dumps({"updates": len(self.state.publications())}))
        return path


def _arc(i: int, count: int) -> NDArray[np.float64]:
    """Pose of camera i on an arc of 150 degrees around the middle of the floor."""
    angle = np.deg2rad(-75.0 + 150.0 * i / max(1, count - 1))
    eye = (3.4 * np.cos(angle), 3.4 * np.sin(angle), 1.5 + 0.35 * (i % 2))
    return look_at(eye, (0.0, 0.0, 0.35))


def _uint8(image: Rendering) -> NDArray[np.uint8]:
    return (np.clip(image.color, 0, 1) * 255 + 0.5).astype(np.uint8)
