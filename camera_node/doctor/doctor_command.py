"""``camera-node doctor``: checks what a scenario needs on this machine, part by part. It moves no arm.

All parts are checked, whatever the earlier results, so one call reports everything that is wrong. A check that fails
raises ValueError, which says what is wrong and what to do.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import importlib.util
import json
import logging
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from camera_node.doctor import doctor_constants as tuned
from camera_node.pose.providers import Closable, PoseGapError
from camera_node.robot.arm.settings import ArmConfig
from camera_node.settings import (
    LIVE_FPS,
    LiveConfig,
    McapConfig,
    RecordedConfig,
    SourceConfig,
    TrajectoryConfig,
    find_data,
    source_config,
)
from camera_node.sources.base import rate
from camera_node.sources.devices.feed import Image
from freshfield import transport
from freshfield.clock import WallClock
from freshfield.depth import DepthImage
from freshfield.geometry import Pose
from freshfield.scenario import Scenario, load

# extra -> (module, distribution)
_PACKAGES = {
    "oak": (("depthai", "depthai"),),
    "realsense": (("pyrealsense2", "pyrealsense2"),),
    "ur": (("rtde_receive", "ur-rtde"), ("rtde_control", "ur-rtde")),
}
_UNSYNCHRONISED = 0x40  # STA_UNSYNC of adjtimex(2)
_TIMEX_BYTES = 512


@dataclass(frozen=True)
class CheckResult:
    """The result for one part. ok: None if nothing was checked. said: the finding, for people."""

    part: str
    ok: bool | None
    said: str


def run(args: argparse.Namespace) -> int:
    """Run all checks and print the results. Returns the exit code: 1 if something is wrong, else 0.

    Raises TransportError for unusable security options, which are read without --to, too.
    """
    security = transport.from_arguments(args)
    results = []
    for result in _checks(args, security):
        results.append(result)
        if not args.json:
            mark = {True: "ok", False: "WRONG", None: "-"}[result.ok]
            print(f"{mark:6} {result.part:18} {result.said}", flush=True)
    wrong = sum(result.ok is False for result in results)
    if args.json:
        print(json.dumps({"ok": not wrong, "parts": [asdict(result) for result in results]}, indent=1))
    else:
        print(f"\n{wrong} of {len(results)} parts need attention" if wrong else "\nnothing is wrong")
    return 1 if wrong else 0


def _checks(args: argparse.Namespace, security: transport.Transport) -> Iterator[CheckResult]:
    yield _check("python", _python)
    yield _check("clock", _clock)
    yield _check("disk", _disk, args.out)
    if args.to is None:
        yield CheckResult("network", None, "not examined: give --to HOST:PORT of the emulator or the edge")
    else:
        yield _check("network", _network, args.to, security)
    if args.scenario is None:
        yield CheckResult("scenario", None, "none given: cameras, arm and files are not examined")
        return
    opened: list[tuple[Scenario, SourceConfig]] = []
    yield _check("scenario", _scenario, args.scenario, opened)
    for scenario, config in opened:
        with _notes_said_once(config):
            yield from _source(scenario, config, args.data, args.plan)


@contextmanager
def _notes_said_once(config: SourceConfig) -> Iterator[None]:
    """Without the log's warnings where data are recorded: they are the notes of the data set, written by each check
    that opens it, and the part ``data`` says them."""
    if not isinstance(config, RecordedConfig):
        yield
        return
    log = logging.getLogger("camera-node")

    def is_error(record: logging.LogRecord) -> bool:
        return record.levelno > logging.WARNING

    log.addFilter(is_error)
    try:
        yield
    finally:
        log.removeFilter(is_error)


def _source(scenario: Scenario, config: SourceConfig, data: Path | None, plan: Path | None) -> Iterator[CheckResult]:
    extras = [config.kind] if config.kind in _PACKAGES else []
    arm: ArmConfig | None = getattr(config, "arm", None)
    for extra in [*extras, *(["ur"] if arm is not None else [])]:
        yield _check(f"package {extra}", _package, extra)
    if isinstance(config, RecordedConfig):
        opened = _check("data", _data, scenario, config, data)
        yield opened
        if not opened.ok:
            yield CheckResult("poses and coverage", None, "not examined: they need the data")
            return
        yield _check("poses", _poses, scenario, config, data)
    if isinstance(config, LiveConfig):
        if config.calibration is not None:
            yield _check("calibration", _calibration, scenario, config)
        for camera in scenario.cameras:
            yield _check(f"camera {camera}", _camera, scenario, camera, config)
        if (tracker := config.trajectory) is not None:
            yield _check("tracker", _tracker, scenario, tracker)
    if arm is not None:
        from camera_node.doctor import arm_check

        yield _check("hand-eye", arm_check.hand_eye, scenario, arm)
        yield _check("arm", arm_check.joint_states, arm)
        if (path := arm.path) is not None:
            yield _check("arm's path", arm_check.path, scenario, arm, path)
    if config.depth_every and arm is None and not isinstance(config, LiveConfig | McapConfig):
        yield from _depth(scenario, config, data)
    if config.kind == "mcap":
        told = "not reckoned: a recording is read once, from its beginning; the page tells it during a run"
        yield CheckResult("coverage", None, told)
    else:
        from camera_node.doctor import coverage_check

        yield _check("coverage", coverage_check.check, scenario, config, data, plan)


def _depth(scenario: Scenario, config: SourceConfig, data: Path | None) -> Iterator[CheckResult]:
    """The depth of each camera that measures it; nothing if none does."""
    from camera_node.doctor import depth_check

    try:
        views = depth_check.first_views(scenario, config, data)
    except (ValueError, OSError) as error:
        yield CheckResult("depth", False, " ".join(str(error).split()))
        return
    for view in views:
        others = [other for other in views if other is not view]
        yield _check(f"depth {view.camera}", depth_check.check, view, others)


def _check(part: str, check: Callable[..., str], *arguments: Any) -> CheckResult:
    try:
        return CheckResult(part, True, check(*arguments))
    except (ValueError, OSError) as error:
        return CheckResult(part, False, " ".join(str(error).split()).removeprefix(f"{part.split()[-1]}: "))
    except Exception as error:  # device libraries raise anything; the other parts must still be checked
        return CheckResult(part, False, f"{type(error).__name__}: {' '.join(str(error).split())}")


def _data(scenario: Scenario, config: RecordedConfig, data: Path | None) -> str:
    """Open the data set as a node does, and read every image that is a file."""
    from camera_node.sources.datasets.formats import open_configured
    from camera_node.sources.registry import open_sources

    path = find_data(config.data, scenario, data)
    open_sources(scenario, config, scenario.cameras, data)
    found = open_configured(path, config)
    if config.kind not in ("video", "dynerf"):
        for image in found:
            image.read()
    return "; ".join((f"{path}: {len(found)} images of {len(found.cameras)} cameras", *found.notes))


def _poses(scenario: Scenario, config: RecordedConfig, data: Path | None) -> str:
    from camera_node.doctor import pose_check

    return pose_check.check(scenario, config, data) or "not compared: no camera moves for 20 captures"


def _python() -> str:
    try:
        installed = version("freshfield")
    except PackageNotFoundError:
        installed = "from its source tree"
    return f"Python {sys.version.split()[0]}, freshfield {installed}"


def _package(extra: str) -> str:
    for module, distribution in _PACKAGES[extra]:
        if importlib.util.find_spec(module) is None:
            raise ValueError(f"{distribution} is not installed: pip install 'freshfield[{extra}]'")
    _, distribution = _PACKAGES[extra][0]
    return f"{distribution} {version(distribution)}"


def _clock() -> str:
    """Whether the kernel reports the clock as synchronized (adjtimex)."""
    if sys.platform != "linux":
        raise ValueError("whether the clock is synchronized can only be asked on Linux")
    buffer = ctypes.create_string_buffer(_TIMEX_BYTES)
    if ctypes.CDLL(None, use_errno=True).adjtimex(buffer) < 0:
        raise ValueError("the kernel does not say whether the clock is synchronized (adjtimex)")
    # struct timex: unsigned modes; long offset, freq, maxerror, esterror; int status.
    word = ctypes.sizeof(ctypes.c_long)
    longs = [ctypes.c_long.from_buffer(buffer, word * k).value for k in range(1, 5)]
    status = ctypes.c_int.from_buffer(buffer, word * 5).value
    if status & _UNSYNCHRONISED:
        raise ValueError(
            "the clock is not synchronized: install chrony, or timedatectl set-ntp true (not needed where one machine "
            "runs everything)"
        )
    return f"synchronized, off by {longs[2] / 1e3:.1f} ms at most"


def _disk(out: Path) -> str:
    place = next(p for p in (out.resolve(), *out.resolve().parents) if p.is_dir())
    with tempfile.NamedTemporaryFile(dir=place) as file:
        file.write(b"\0")
    free_gb = shutil.disk_usage(place).free / 1e9
    if free_gb < tuned.LEAST_FREE_GB:
        raise ValueError(f"{place}: {free_gb:.1f} GB free: make room for {tuned.LEAST_FREE_GB:g} GB, or choose --out")
    return f"{place}: {free_gb:.0f} GB free, can be written to"


def _network(to: str, security: transport.Transport) -> str:
    host, port = transport.host_port(to)
    try:
        begin = time.perf_counter()
        socket.create_connection(transport.socket_address(to), tuned.ANSWER_S).close()
        connect_ms = 1e3 * (time.perf_counter() - begin)
    except OSError as error:
        raise ValueError(
            f"nobody takes connections at {host}:{port} ({error.strerror or error}): is the process "
            "started, does it listen on this network's address (--listen 0.0.0.0:PORT), does a firewall "
            "stand between?"
        ) from None
    offset_ms, bound_ms = asyncio.run(_exchange(f"{host}:{port}", security))
    return (
        f"{host}:{port} answers: connecting takes {connect_ms:.1f} ms, its clock is {offset_ms:+.2f} "
        f"ms off ours (within {bound_ms:.2f} ms)"
    )


async def _exchange(target: str, security: transport.Transport) -> tuple[float, float]:
    """The peer's clock minus ours and the error bound, both in ms."""
    import grpc
    import grpc.aio

    from camera_node.clock_offset import OffsetEstimator, exchange

    estimator, clock = OffsetEstimator(), WallClock()
    async with security.aio_channel(target) as channel:
        try:
            for _ in range(tuned.EXCHANGES):
                await exchange(channel, security.metadata(), clock, estimator, tuned.ANSWER_S)
        except grpc.RpcError as error:
            raise ValueError(
                f"{target} takes connections but does not speak with us ({error.code().name.lower()}): "  # type: ignore[attr-defined]
                "is it an emulator or an edge server, and does it ask for --tls-* or --token-file?"
            ) from None
    found = estimator.estimate(clock.now_ns())
    if found is None:
        raise ValueError(f"{target} does not tell its time: is it an emulator or an edge server?")
    return found.offset_ns / 1e6, found.uncertainty_ns / 1e6


def _scenario(name: str, opened: list[tuple[Scenario, SourceConfig]]) -> str:
    scenario = load(name)
    config = source_config(scenario)
    opened.append((scenario, config))
    return f"{scenario.path}: {len(scenario.cameras)} cameras of kind {config.kind}"


def _calibration(scenario: Scenario, config: LiveConfig) -> str:
    from camera_node.sources.devices.live import calibrations

    known = calibrations(scenario, config)
    missing = [camera for camera in scenario.cameras if camera not in known]
    if missing:
        raise ValueError(f"{config.calibration}: it lacks {', '.join(missing)}")
    return f"{config.calibration}: {len(known)} cameras"


def _tracker(scenario: Scenario, config: TrajectoryConfig) -> str:
    """Ask for the poses of now, as a camera does."""
    from camera_node.pose.trajectories import trajectory_poses

    poses = trajectory_poses(scenario, config, scenario.cameras, scenario.path.parent, live=True)
    clock, said = WallClock(), []
    try:
        time.sleep(tuned.LISTEN_S)
        for camera, tracked in poses.items():
            _, gap_ns = tracked.at(clock.now_ns())
            said.append(f"{camera}: a pose {gap_ns / 1e6:.0f} ms from now")
    except PoseGapError as error:
        raise ValueError(f"{error}: is the tracker running, and does it write each pose at once?") from None
    finally:
        for tracked in poses.values():
            if isinstance(tracked, Closable):
                tracked.close()
    return "; ".join(said) or "none of the cameras has a file"


def _camera(scenario: Scenario, camera: str, config: LiveConfig) -> str:
    """Open the camera, take frames for as long as five should take (1 to 3 s), and close it."""
    from camera_node.sources.devices.live import calibrations, open_feed

    clock = WallClock()
    asked_hz = config.fps or LIVE_FPS
    listen_s = min(max(tuned.LISTEN_S, tuned.JUDGED_FRAMES / asked_hz), tuned.LISTEN_AT_MOST_S)
    measured: tuple[Image, DepthImage] | None = None
    feed = open_feed(camera, config, rate(asked_hz), clock)
    try:
        first = feed.grab(config.first_frame_s)
        if first is None:
            raise ValueError(f"it opened, but sent no frame for {config.first_frame_s:g} s")
        ages_ms, begin_s = [], time.monotonic()
        while (spent_s := time.monotonic() - begin_s) < listen_s:
            taken = feed.grab(tuned.LISTEN_S)
            if taken is not None:
                ages_ms.append((clock.now_ns() - taken[0]) / 1e6)
                if feed.depth is not None:
                    measured = (taken[1], feed.depth)
        lens, no_intrinsics, stamped_by = feed.intrinsics, feed.no_intrinsics, feed.stamped_by
    finally:
        feed.close()
    height, width = first[1].shape[:2]
    if camera in calibrations(scenario, config):
        known = "its lens as calibrated"
    elif lens is None:
        raise ValueError(no_intrinsics.removeprefix(f"{camera}: "))
    else:
        known = f"f = {lens.fx:.0f} px"
    rate_hz = len(ages_ms) / spent_s
    if rate_hz < tuned.LEAST_RATE * asked_hz and asked_hz * spent_s >= tuned.JUDGED_FRAMES:
        raise ValueError(
            f"{width} x {height}, but {rate_hz:.3g} frames a second of the {asked_hz:g} asked: is it too "
            "dark (more light, or a shorter exposure_us), is it on USB 2 (another port or cable), can it do "
            "this size so fast (smaller width and height, or fps)?"
        )
    age = f", {sum(ages_ms) / len(ages_ms):.0f} ms old when they come" if ages_ms else ""
    if measured is not None and lens is not None:
        from camera_node.doctor.depth_check import DepthView, check

        anywhere = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        known += f"; depth {check(DepthView(camera, measured[0], lens, anywhere, measured[1]), [])}"
    return f"{width} x {height}, {rate_hz:.3g} frames a second{age}, stamped by {stamped_by}; {known}"
