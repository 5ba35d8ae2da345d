"""``camera-node doctor``: examines what a scenario needs on this machine, part by part, and moves nothing.

Every part is examined whatever the ones before it said, so that one call names all that is wrong.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import importlib
import importlib.util
import json
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from camera_node.config import ArmConfig, LiveConfig, RecordedConfig, SourceConfig, find_data, source_config
from camera_node.sources import source_module
from camera_node.sources.playback import rate
from freshfield import transport
from freshfield.clock import OffsetEstimator, WallClock
from freshfield.scenario import Scenario, load

LEAST_FREE_GB = 2.0
_EXCHANGES = 8
_ANSWER_S = 2.0
_LISTEN_S = 0.5
_LISTEN_AT_MOST_S = 3.0  # to a slow camera
_JUDGED_FRAMES = 5  # of the rate that was asked for; with fewer, chance decides
_LEAST_RATE = 0.6
_LEAST_REACHED = 0.6  # of a tour's viewpoints; with fewer, a side of the target stays unseen
# extra -> (module, distribution)
_PACKAGES = {
    "oak": (("depthai", "depthai"),),
    "realsense": (("pyrealsense2", "pyrealsense2"),),
    "ur": (("rtde_receive", "ur-rtde"), ("rtde_control", "ur-rtde")),
}
_UNSYNCHRONISED = 0x40  # STA_UNSYNC of adjtimex(2)
_TIMEX_BYTES = 512


class Wrong(ValueError):
    """A part that is not as it must be; what, and what to do."""


@dataclass(frozen=True)
class Finding:
    """What one part's examination gave. ok: None where there was nothing to examine."""

    part: str
    ok: bool | None
    said: str


def run(args: argparse.Namespace) -> int:
    """Examine and print; 1 if something is wrong."""
    findings = []
    for finding in examine(args.scenario, args.to, args.data, args.out):
        findings.append(finding)
        if not args.json:
            mark = {True: "ok", False: "WRONG", None: "-"}[finding.ok]
            print(f"{mark:6} {finding.part:18} {finding.said}", flush=True)
    wrong = sum(finding.ok is False for finding in findings)
    if args.json:
        print(json.dumps({"ok": not wrong, "parts": [asdict(finding) for finding in findings]}, indent=1))
    else:
        print(f"\n{wrong} of {len(findings)} parts need attention" if wrong else "\nnothing is wrong")
    return 1 if wrong else 0


def examine(name: str | None, to: str | None, data: Path | None, out: Path) -> Iterator[Finding]:
    """The findings, as they come."""
    yield _look("python", _python)
    yield _look("clock", _clock)
    yield _look("disk", lambda: _disk(out))
    if to is None:
        yield Finding("network", None, "not examined: give --to HOST:PORT of the emulator or the edge")
    else:
        yield _look("network", lambda: _network(to))
    if name is None:
        yield Finding("scenario", None, "none given: cameras, arm and files are not examined")
        return
    opened: list[tuple[Scenario, SourceConfig]] = []
    yield _look("scenario", lambda: _scenario(name, opened))
    for scenario, config in opened:
        yield from _source(scenario, config, data)


def _source(scenario: Scenario, config: SourceConfig, data: Path | None) -> Iterator[Finding]:
    extras = [config.kind] if config.kind in _PACKAGES else []
    arm: ArmConfig | None = getattr(config, "arm", None)
    for extra in [*extras, *(["ur"] if arm is not None else [])]:
        yield _look(f"package {extra}", lambda extra=extra: _package(extra))  # type: ignore[misc]
    if isinstance(config, RecordedConfig):
        yield _look("data", lambda: f"{find_data(config.data, scenario, data)} is there")
    if isinstance(config, LiveConfig):
        if config.calibration is not None:
            yield _look("calibration", lambda: _calibration(scenario, config))
        for camera in scenario.cameras:
            yield _look(f"camera {camera}", lambda camera=camera: _camera(scenario, camera, config))  # type: ignore[misc]
    if arm is not None:
        yield _look("hand-eye", lambda: _hand_eye(scenario, arm))
        yield _look("arm", lambda: _arm(scenario, arm))
        if arm.path is not None:
            yield _look("arm's path", lambda: _path(scenario, arm))


def _look(part: str, examination: Callable[[], str]) -> Finding:
    try:
        return Finding(part, True, examination())
    except (ValueError, OSError) as error:
        return Finding(part, False, " ".join(str(error).split()).removeprefix(f"{part.split()[-1]}: "))
    except Exception as error:  # libraries of devices raise what they like: the other parts count too
        return Finding(part, False, f"{type(error).__name__}: {' '.join(str(error).split())}")


def _python() -> str:
    try:
        installed = version("freshfield")
    except PackageNotFoundError:
        installed = "from its source tree"
    return f"Python {sys.version.split()[0]}, freshfield {installed}"


def _package(extra: str) -> str:
    for module, distribution in _PACKAGES[extra]:
        if importlib.util.find_spec(module) is None:
            raise Wrong(f"{distribution} is not installed: pip install 'freshfield[{extra}]'")
    _, distribution = _PACKAGES[extra][0]
    return f"{distribution} {version(distribution)}"


def _clock() -> str:
    """What the kernel says of the clock's discipline (adjtimex)."""
    if sys.platform != "linux":
        raise Wrong("whether the clock is synchronised can only be asked on Linux")
    buffer = ctypes.create_string_buffer(_TIMEX_BYTES)
    if ctypes.CDLL(None, use_errno=True).adjtimex(buffer) < 0:
        raise Wrong("the kernel does not say whether the clock is synchronised (adjtimex)")
    # struct timex: unsigned modes; long offset, freq, maxerror, esterror; int status.
    word = ctypes.sizeof(ctypes.c_long)
    longs = [ctypes.c_long.from_buffer(buffer, word * k).value for k in range(1, 5)]
    status = ctypes.c_int.from_buffer(buffer, word * 5).value
    if status & _UNSYNCHRONISED:
        raise Wrong("the clock is not synchronised: install chrony, or timedatectl set-ntp true")
    return f"synchronised, off by {longs[2] / 1e3:.1f} ms at most"


def _disk(out: Path) -> str:
    place = next(p for p in (out.resolve(), *out.resolve().parents) if p.is_dir())
    with tempfile.NamedTemporaryFile(dir=place) as file:
        file.write(b"\0")
    free_gb = shutil.disk_usage(place).free / 1e9
    if free_gb < LEAST_FREE_GB:
        raise Wrong(f"{place}: {free_gb:.1f} GB free: make room for {LEAST_FREE_GB:g} GB, or choose --out")
    return f"{place}: {free_gb:.0f} GB free, can be written to"


def _network(to: str) -> str:
    host, port = transport.host_port(to)
    try:
        begin = time.perf_counter()
        socket.create_connection((host, port), _ANSWER_S).close()
        connect_ms = 1e3 * (time.perf_counter() - begin)
    except OSError as error:
        raise Wrong(
            f"nobody takes connections at {host}:{port} ({error.strerror or error}): is the process "
            "started, does it listen on this network's address (--listen 0.0.0.0:PORT), does a firewall "
            "stand between?"
        ) from None
    offset_ms, bound_ms = asyncio.run(_exchange(f"{host}:{port}"))
    return (
        f"{host}:{port} answers: connecting takes {connect_ms:.1f} ms, its clock is {offset_ms:+.2f} "
        f"ms off ours (within {bound_ms:.2f} ms)"
    )


async def _exchange(target: str) -> tuple[float, float]:
    """The other clock minus ours and its bound, both in ms."""
    import grpc
    import grpc.aio

    from freshfield.v1 import clock_pb2, clock_pb2_grpc

    estimator, clock = OffsetEstimator(), WallClock()
    options = (("grpc.enable_http_proxy", 0),)
    async with grpc.aio.insecure_channel(target, options=options) as channel:
        stub = clock_pb2_grpc.ClockServiceStub(channel)
        try:
            for _ in range(_EXCHANGES):
                sent = clock.now_ns()
                answer = await stub.Exchange(
                    clock_pb2.ExchangeRequest(client_sent_ns=sent), timeout=_ANSWER_S
                )
                estimator.add(sent, answer.server_received_ns, answer.server_sent_ns, clock.now_ns())
        except grpc.RpcError as error:
            raise Wrong(
                f"{target} takes connections but does not speak with us ({error.code().name.lower()}): "  # type: ignore[attr-defined]
                "is it an emulator or an edge server, and without TLS?"
            ) from None
    found = estimator.estimate(clock.now_ns())
    assert found is not None
    return found.offset_ns / 1e6, found.uncertainty_ns / 1e6


def _scenario(name: str, opened: list[tuple[Scenario, SourceConfig]]) -> str:
    scenario = load(name)
    config = source_config(scenario)
    opened.append((scenario, config))
    return f"{scenario.path}: {len(scenario.cameras)} cameras of kind {config.kind}"


def _calibration(scenario: Scenario, config: LiveConfig) -> str:
    from camera_node.sources.devices.device import calibrations

    known = calibrations(scenario, config)
    missing = [camera for camera in scenario.cameras if camera not in known]
    if missing:
        raise Wrong(f"{config.calibration}: it lacks {', '.join(missing)}")
    return f"{config.calibration}: {len(known)} cameras"


def _camera(scenario: Scenario, camera: str, config: LiveConfig) -> str:
    """Open it, take frames until at least five should have come, close it."""
    from camera_node.sources.devices.device import DEFAULT_FPS, calibrations

    module: Any = importlib.import_module(source_module(config.kind))
    clock = WallClock()
    asked_hz = config.fps or DEFAULT_FPS
    listen_s = min(max(_LISTEN_S, _JUDGED_FRAMES / asked_hz), _LISTEN_AT_MOST_S)
    feed = module.opener(camera, config.devices.get(camera), config, rate(asked_hz), clock)()
    try:
        first = feed.grab(config.first_frame_s)
        if first is None:
            raise Wrong(f"it opened, but sent no frame for {config.first_frame_s:g} s")
        ages_ms, begin_s = [], time.monotonic()
        while (spent_s := time.monotonic() - begin_s) < listen_s:
            taken = feed.grab(_LISTEN_S)
            if taken is not None:
                ages_ms.append((clock.now_ns() - taken[0]) / 1e6)
        lens, no_lens, stamped_by = feed.intrinsics, feed.no_lens, feed.stamped_by
    finally:
        feed.close()
    height, width = first[1].shape[:2]
    if camera in calibrations(scenario, config):
        known = "its lens as calibrated"
    elif lens is None:
        raise Wrong(no_lens.removeprefix(f"{camera}: "))
    else:
        known = f"f = {lens.fx:.0f} px"
    rate_hz = len(ages_ms) / spent_s
    if rate_hz < _LEAST_RATE * asked_hz and asked_hz * spent_s >= _JUDGED_FRAMES:
        raise Wrong(
            f"{width} x {height}, but {rate_hz:.3g} frames a second of the {asked_hz:g} asked: is it too "
            "dark (more light, or a shorter exposure_us), is it on USB 2 (another port or cable), can it do "
            "this size so fast (smaller width and height, or fps)?"
        )
    age = f", {sum(ages_ms) / len(ages_ms):.0f} ms old when they come" if ages_ms else ""
    return f"{width} x {height}, {rate_hz:.3g} frames a second{age}, stamped by {stamped_by}; {known}"


def _hand_eye(scenario: Scenario, arm: ArmConfig) -> str:
    import numpy as np

    from camera_node.robot.arm.camera_poses import arm_model, hand_eyes

    model = arm_model(scenario, arm)
    mounts = hand_eyes(scenario, arm, arm.cameras)
    for camera, mount in mounts.items():
        if mount.details.get("example") and not arm.simulated:
            raise Wrong(
                f"{arm.cameras[camera]}: still the example's, not this bench's: camera-node calibrate "
                f"hand-eye --live {scenario.path} --camera {camera} --board SPEC --out FILE (with {camera}: "
                "null)"
            )
    where = [
        f"{camera} {mount.setup}, {1e3 * float(np.linalg.norm(mount.transform[:3, 3])):.0f} mm away"
        for camera, mount in mounts.items()
    ]
    own = "" if arm.calibration else "; the robot's own calibration.conf is not given: expect millimetres"
    return f"{model.name}: {', '.join(where)}{own if not arm.simulated else ''}"


def _arm(scenario: Scenario, arm: ArmConfig) -> str:
    from camera_node.robot.arm.joint_states import ArmStream

    stream = ArmStream(arm.host, WallClock(), arm.frequency_hz)
    stream.start()
    try:
        before = stream.status()["samples"]
        time.sleep(_LISTEN_S)
        status = stream.status()
    finally:
        stream.stop()
    if status["trouble"]:
        raise Wrong(f"{status['trouble']}: see the teach pendant; poses are right all the same")
    samples = (status["samples"] - before) / _LISTEN_S
    if samples < 0.8 * arm.frequency_hz:
        raise Wrong(
            f"{samples:.0f} joint states a second of {arm.frequency_hz:g}: is the network or this "
            "machine busy?"
        )
    return f"{arm.host}: running, {samples:.0f} joint states a second"


def _path(scenario: Scenario, arm: ArmConfig) -> str:
    from camera_node.robot.arm.camera_poses import arm_model, base_matrix, hand_eyes
    from camera_node.robot.arm.hand_eye_mount import EYE_TO_HAND
    from camera_node.robot.arm.viewpoint_tour import tour, viewpoints

    assert arm.path is not None
    carried = [m for m in hand_eyes(scenario, arm, arm.cameras).values() if m.setup != EYE_TO_HAND]
    if not carried:
        raise Wrong("no camera is on the hand: there is nothing to drive")
    model, base, mount = arm_model(scenario, arm), base_matrix(arm), carried[0].transform
    found = tour(model, base, mount, arm.path)
    count = len(viewpoints(arm.path))
    said = f"the arm reaches {found.reached} of {count} viewpoints"
    if found.reached >= _LEAST_REACHED * count:
        return said
    rings = ", ".join(
        f"{elevation_deg:g} degrees {reached} of {count // len(arm.path.elevations_deg)}"
        for elevation_deg, reached in zip(arm.path.elevations_deg, found.reached_by_ring(arm.path))
    )
    raise Wrong(f"{said} ({rings}): change radius_m, elevations_deg, azimuths_deg or where the base stands")
