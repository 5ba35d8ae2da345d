"""An arm as a source of poses: joint states with their times, through the manufacturer's data exchange
(4.3.3).

The library's getters go on returning the last values after a connection is lost, so nothing is believed but
stamps that advance: a stream that stands still for ``STALE_S`` is given up and connected anew, with growing
pauses. Meanwhile no frame gets a pose.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import logging
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.clocks import ArrivalClock
from camera_node.pose.pairing import SampleBuffer, interpolate_joints
from camera_node.pose.providers import PairedPose, PoseGapError
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.rtde_process import CONNECT_S, SAMPLE
from freshfield.clock import Clock
from freshfield.geometry import Pose

log = logging.getLogger("camera-node.arm")

Joints = NDArray[np.float64]

RTDE_PORT = 30004
PROBE_S = 2.0
STALE_S = 0.5
BACKOFF_S = (0.25, 0.5, 1.0, 2.0, 5.0)
_ROBOT_MODES = {
    -1: "no controller", 0: "disconnected", 1: "confirm safety", 2: "booting", 3: "powered off",
    4: "powered on, brakes engaged", 5: "idle: brakes engaged", 6: "backdrive", 7: "running",
}  # fmt: skip
_SAFETY_MODES = {
    1: "normal", 2: "reduced", 3: "protective stop", 4: "recovery", 5: "safeguard stop",
    6: "system emergency stop", 7: "robot emergency stop", 8: "safety violation", 9: "safety fault",
}  # fmt: skip


class ArmError(ValueError):
    """An arm that cannot be used; one line: what, where, what to do."""


def probe(host: str, timeout_s: float = PROBE_S) -> None:
    """Whether a controller answers at ``host``, asked without the library, which would wait for ever.

    Raises ArmError within ``timeout_s``, with what to do about it.
    """
    where = f"arm at {host}"
    deadline = time.monotonic() + timeout_s
    try:
        with socket.create_connection((host, RTDE_PORT), timeout_s) as link:
            link.sendall(b"\x00\x05V\x00\x02")  # which protocol version do you speak: 2?
            answer = b""
            while len(answer) < 4:
                link.settimeout(max(0.01, deadline - time.monotonic()))
                part = link.recv(4 - len(answer))
                if not part:
                    raise ArmError(f"{where}: port {RTDE_PORT} closed at once: is another program's?")
                answer += part
    except ConnectionRefusedError:
        raise ArmError(
            f"{where}: nothing listens on port {RTDE_PORT}: switch the controller on and enable RTDE in its "
            "settings (Security, Services), or start one with: camera-node simulate-arm"
        ) from None
    except socket.gaierror:
        raise ArmError(f"{where}: no such host: give the IP address from the teach pendant") from None
    except TimeoutError:
        raise ArmError(
            f"{where}: no answer on port {RTDE_PORT} within {timeout_s:g} s: check address, cable and subnet"
        ) from None
    except OSError as error:
        raise ArmError(f"{where}: {error.strerror or error}: check address, cable and subnet") from None
    if answer != b"\x00\x04V\x01":
        raise ArmError(f"{where}: port {RTDE_PORT} does not speak RTDE version 2: too old, or no controller")


class ArmStream:
    """Joint states of the arm at ``host``, read by a process and a thread of their own.

    frequency_hz: samples asked for, at most 500. interpolate: joints between two samples, else the nearest
    one. max_gap_ms: no pose farther from a sample than this. stale_s: how long its state may stand still.
    each: called with the stamp (ns, our clock) and joints (6,) of every sample, from the stream's thread.
    ``start`` raises ArmError; after that the stream mends itself, and ``trouble`` says what is wrong (""
    where nothing is).
    """

    def __init__(
        self,
        host: str,
        clock: Clock,
        frequency_hz: float = 125.0,
        interpolate: bool = True,
        max_gap_ms: float = 20.0,
        stale_s: float = STALE_S,
        on_sample: Callable[[int, Joints], None] | None = None,
    ) -> None:
        self.host = host
        self._stale_s, self._on_sample = stale_s, on_sample
        self.trouble = "not connected yet"
        self.connections = 0
        self._clock = clock
        self._frequency_hz = frequency_hz
        self._interpolate = interpolate
        self._samples = SampleBuffer[Joints](
            interpolate_joints if interpolate else None, round(max_gap_ms * 1e6)
        )
        self._first_sample = threading.Event()
        self._stop = threading.Event()
        self._child: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, name=f"arm {host}", daemon=True)

    def start(self) -> None:
        """Connect, and return when the first sample is here. Raises ArmError, within three seconds where
        nothing is there, or where the library is missing."""
        if importlib.util.find_spec("rtde_receive") is None:
            raise ArmError("arms need the package ur-rtde: pip install 'freshfield[ur]'")
        probe(self.host)
        atexit.register(self.stop)
        self._thread.start()
        if not self._first_sample.wait(CONNECT_S):
            trouble = self.trouble
            self.stop()
            raise ArmError(f"arm at {self.host}: connected, but no joint states come: {trouble}")

    def stop(self) -> None:
        """End thread and process."""
        self._stop.set()
        atexit.unregister(self.stop)
        self._end_child()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def at(self, t_ns: int, wait_s: float = 0.0) -> tuple[Joints, int]:
        """Joint angles (6,) at an instant, and how far (ns) the nearest sample is from it. wait_s: how long a
        sample as new as the instant may be waited for. Raises PoseGapError."""
        until = time.monotonic() + wait_s
        while self._interpolate and not self._samples.ready(t_ns) and time.monotonic() < until:
            if self._stop.wait(0.001):
                break
        try:
            match = self._samples.at(t_ns)
        except PoseGapError as error:
            raise PoseGapError(self.trouble or f"arm at {self.host}: {error}") from None
        return match.sample, match.gap_ns

    def status(self) -> dict[str, Any]:
        """For people and logs."""
        counts = self._samples.counts
        return {
            "host": self.host,
            "trouble": self.trouble,
            "connections": self.connections,
            "samples": counts.samples,
            "refused": counts.refused,
        }

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                if failures:
                    probe(self.host)
                if self._read():
                    failures = 0
            except ArmError as error:
                self._set_trouble(str(error))
            pause_s = BACKOFF_S[min(failures, len(BACKOFF_S) - 1)]
            failures += 1
            self._stop.wait(pause_s)

    def _read(self) -> bool:
        """One connection, from start to end; whether it received anything."""
        command = [
            sys.executable,
            "-m",
            "camera_node.robot.arm.rtde_process",
            self.host,
            str(self._frequency_hz),
        ]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        self._child = child
        assert child.stdout is not None and child.stderr is not None
        received, patience_s = False, CONNECT_S
        clock, last_s, pending = ArrivalClock(), -1.0, b""
        try:
            while not self._stop.is_set():
                if not select.select([child.stdout], [], [], patience_s)[0]:
                    self._set_trouble(f"arm at {self.host}: its state has stood still for {patience_s:g} s")
                    return received
                data = os.read(child.stdout.fileno(), 65536)
                arrived_ns = self._clock.now_ns()
                if not data:
                    said = child.stderr.read().decode(errors="replace").strip().split("\n")[-1]
                    self._set_trouble(said or f"arm at {self.host}: the connection was lost")
                    return received
                pending += data
                whole = len(pending) - len(pending) % SAMPLE.size
                for stamp_s, *joints, mode, safety in SAMPLE.iter_unpack(pending[:whole]):
                    if stamp_s < last_s:
                        clock = ArrivalClock()  # the controller was started anew
                    last_s = stamp_s
                    t_ns, angles = clock.host_ns(round(stamp_s * 1e9), arrived_ns), np.array(joints)
                    self._samples.add(t_ns, angles)
                    if self._on_sample is not None:
                        self._on_sample(t_ns, angles)
                    self._check_modes(mode, safety)
                if whole and not received:
                    received, patience_s = True, self._stale_s
                    self.connections += 1
                    self._first_sample.set()
                pending = pending[whole:]
            return received
        finally:
            self._end_child()
            child.stdout.close()
            child.stderr.close()

    def _check_modes(self, mode: int, safety: int) -> None:
        """Joint angles stay true in every mode; that nothing will move is worth a word."""
        wrong = []
        if mode != 7:
            wrong.append(f"robot mode: {_ROBOT_MODES.get(mode, mode)}")
        if safety not in (1, 2):
            wrong.append(f"safety: {_SAFETY_MODES.get(safety, safety)}")
        self._set_trouble(f"arm at {self.host}: {', '.join(wrong)}" if wrong else "")

    def _set_trouble(self, trouble: str) -> None:
        if trouble != self.trouble and not self._stop.is_set():
            if trouble:
                log.warning("%s", trouble)
            elif self.connections:
                log.info("arm at %s: well again", self.host)
            self.trouble = trouble

    def _end_child(self) -> None:
        child = self._child
        if child is not None and child.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                child.kill()
            child.wait()


class HandPoses:
    """Poses of the flange in the world: forward kinematics of an arm's joints, from where its base stands.

    wait_s: how long to wait for the sample after the instant, so that there is one on either side.
    """

    def __init__(
        self, stream: ArmStream, model: ArmModel, base: NDArray[np.float64], wait_s: float = 0.03
    ) -> None:
        self._stream, self._model, self._base, self._wait_s = stream, model, base, wait_s

    def at(self, t_ns: int) -> PairedPose:
        """Raises PoseGapError where no sample is near enough."""
        joints, gap_ns = self._stream.at(t_ns, self._wait_s)
        return PairedPose(Pose.from_matrix(self._base @ self._model.forward(joints)), gap_ns)

    def close(self) -> None:
        """Let go of the arm."""
        self._stream.stop()
