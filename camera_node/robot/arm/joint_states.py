"""Time-stamped joint states of an arm, through the manufacturer's Real-Time Data Exchange (4.3.3).

The library keeps returning the last values after a connection is lost, so only advancing stamps count: a
stream without a new stamp for ``STALE_S`` is closed and reconnected, with growing pauses. Meanwhile no frame
gets a pose.
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

import numpy as np
from numpy.typing import NDArray

from camera_node.clocks import ArrivalClock
from camera_node.pose.pairing import SampleBuffer, interpolate_joints
from camera_node.pose.providers import PoseGapError
from camera_node.robot.arm import ArmError
from camera_node.robot.arm import arm_constants as tuned
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.rtde_process import SAMPLE
from freshfield.clock import Clock
from freshfield.geometry import Array, Pose

log = logging.getLogger("camera-node.arm")

RTDE_PORT = 30004
READER = (sys.executable, "-m", "camera_node.robot.arm.rtde_process")
"""The process that reads joint states; host and frequency follow."""
_ROBOT_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "confirm safety",
    2: "booting",
    3: "powered off",
    4: "powered on, brakes engaged",
    5: "idle: brakes engaged",
    6: "backdrive",
    7: "running",
}
_SAFETY_MODES = {
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "system emergency stop",
    7: "robot emergency stop",
    8: "safety violation",
    9: "safety fault",
}


def probe(host: str) -> None:
    """Check that a controller answers at ``host``, without the library, which would wait forever. Raises
    ArmError within ``PROBE_S``."""
    where = f"arm at {host}"
    deadline = time.monotonic() + tuned.PROBE_S
    try:
        with socket.create_connection((host, RTDE_PORT), tuned.PROBE_S) as link:
            link.sendall(b"\x00\x05V\x00\x02")  # request protocol version 2
            answer = b""
            while len(answer) < 4:
                link.settimeout(max(0.01, deadline - time.monotonic()))
                part = link.recv(4 - len(answer))
                if not part:
                    raise ArmError(f"{where}: port {RTDE_PORT} closed at once: is another program's?")
                answer += part
    except OSError as error:
        raise ArmError(
            f"{where}: no answer on port {RTDE_PORT} ({error.strerror or error}): check address, cable and subnet, "
            "switch the controller on and enable RTDE in its settings (Security, Services), or start one with: "
            "camera-node simulate-arm"
        ) from None
    if answer != b"\x00\x04V\x01":
        raise ArmError(f"{where}: port {RTDE_PORT} does not speak RTDE version 2: too old, or no controller")


class ArmStream:
    """Joint states of one arm, read by a process and a thread of their own.

    After ``start`` the stream reconnects by itself. ``trouble`` says what is wrong; it is "" if nothing is.

    host: the controller's address.
    clock: gives the samples their stamps.
    frequency_hz: samples requested per second, at most 500.
    interpolate: interpolate between two samples; otherwise take the nearest one.
    max_gap_ms: largest distance of an instant from a sample.
    stale_s: reconnect after so many seconds without a new state.
    """

    def __init__(
        self,
        host: str,
        clock: Clock,
        frequency_hz: float = 125.0,
        interpolate: bool = True,
        max_gap_ms: float = 20.0,
        stale_s: float = tuned.STALE_S,
    ) -> None:
        self.host, self.stale_s = host, stale_s
        self.trouble = "not connected yet"
        self.connections = 0
        self._clock = clock
        self._frequency_hz, self._interpolate = frequency_hz, interpolate
        self._samples = SampleBuffer[Array](interpolate_joints if interpolate else None, round(max_gap_ms * 1e6))
        self._first_sample = threading.Event()
        self._stop = threading.Event()
        self._child: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, name=f"arm {host}", daemon=True)

    def start(self) -> None:
        """Connect and wait for the first sample. Raises ArmError, within three seconds if there is no
        controller."""
        if importlib.util.find_spec("rtde_receive") is None:
            raise ArmError("arms need the package ur-rtde: pip install 'freshfield[ur]'")
        probe(self.host)
        atexit.register(self.stop)
        self._thread.start()
        if not self._first_sample.wait(tuned.CONNECT_S):
            trouble = self.trouble
            self.stop()
            raise ArmError(f"arm at {self.host}: connected, but no joint states come: {trouble}")

    def stop(self) -> None:
        """End thread and process."""
        self._stop.set()
        atexit.unregister(self.stop)
        self._end_child()
        if self._thread.is_alive():
            self._thread.join(tuned.JOIN_S)

    def at(self, t_ns: int, wait_s: float = 0.0) -> tuple[Array, int]:
        """Joint angles (6,) at an instant, and its distance (ns) from the nearest sample. Raises
        PoseGapError.

        wait_s: longest wait for a sample as new as the instant.
        """
        until = time.monotonic() + wait_s
        while self._interpolate and not self._samples.ready(t_ns) and time.monotonic() < until:
            if self._stop.wait(tuned.NEXT_STATE_POLL_S):
                break
        try:
            return self._samples.at(t_ns)
        except PoseGapError as error:
            raise PoseGapError(self.trouble or f"arm at {self.host}: {error}") from None

    def now(self) -> Array:
        """Current joint angles (6,). Raises ArmError if there is no state that is new enough."""
        try:
            return self.at(self._clock.now_ns())[0]
        except PoseGapError as error:
            raise ArmError(str(error)) from None

    @property
    def received(self) -> int:
        """Number of samples received since ``start``."""
        return self._samples.received

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
            pause_s = tuned.BACKOFF_S[min(failures, len(tuned.BACKOFF_S) - 1)]
            failures += 1
            self._stop.wait(pause_s)

    def _read(self) -> bool:
        """Read one connection until it ends. Returns whether it received anything."""
        child = subprocess.Popen(
            [*READER, self.host, str(self._frequency_hz)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._child = child
        assert child.stdout is not None and child.stderr is not None
        received, patience_s = False, tuned.CONNECT_S
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
                        clock = ArrivalClock()  # the controller was restarted
                    last_s = stamp_s
                    self._samples.add(clock.host_ns(round(stamp_s * 1e9), arrived_ns), np.array(joints))
                    self._check_modes(mode, safety)
                if whole and not received:
                    received, patience_s = True, self.stale_s
                    self.connections += 1
                    self._first_sample.set()
                pending = pending[whole:]
            return received
        finally:
            self._end_child()
            child.stdout.close()
            child.stderr.close()

    def _check_modes(self, mode: int, safety: int) -> None:
        """Report modes in which the arm cannot move; joint angles are valid in every mode."""
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
                log.info("arm at %s: recovered", self.host)
            self.trouble = trouble

    def _end_child(self) -> None:
        child = self._child
        if child is not None and child.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                child.kill()
            child.wait()


class FlangePoses:
    """Poses of the flange in the world, by forward kinematics of the arm's joints.

    base: world-from-base (4, 4).
    wait_s: longest wait for the sample after the instant, which interpolation needs.
    """

    def __init__(
        self, stream: ArmStream, model: ArmModel, base: NDArray[np.float64], wait_s: float = tuned.NEXT_STATE_S
    ) -> None:
        self._stream, self._model, self._base, self._wait_s = stream, model, base, wait_s

    def at(self, t_ns: int) -> tuple[Pose, int]:
        """Flange-to-world pose for an instant, and the time (ns) to the nearest sample. Raises PoseGapError
        if none is near enough."""
        joints, gap_ns = self._stream.at(t_ns, self._wait_s)
        return Pose.from_matrix(self._base @ self._model.forward(joints)), gap_ns

    def close(self) -> None:
        """Disconnect from the arm."""
        self._stream.stop()
