"""Real cameras as sources: a thread takes the frames as they come, and ``read`` returns the newest one.

Frames are stamped by the camera's driver, not when they are read, and each frame is read once. A camera that
fails, or falls silent, is reopened after growing pauses; meanwhile its captures are counted as failed.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path

from camera_node.pose.providers import Closable, FixedPose, PoseProvider
from camera_node.settings import FIRST_FRAME_S, LIVE_FPS, LiveConfig, beside
from camera_node.sources import source_constants as tuned
from camera_node.sources.base import Shot, Source, rate
from camera_node.sources.calibration_file import CalibratedCamera, load_calibration
from camera_node.sources.devices.feed import CameraError, Feed, Image, as_camera_error
from freshfield.clock import Clock, WallClock
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose
from freshfield.scenario import Scenario, ScenarioError

log = logging.getLogger("camera-node")

# kind -> its driver's module here and class
_DRIVERS = {"camera": ("opencv", "OpenCvFeed"), "oak": ("oak", "OakFeed"), "realsense": ("realsense", "RealsenseFeed")}


def open_feed(camera: str, config: LiveConfig, fps: Fraction, clock: Clock) -> Feed:
    """Open a camera of the scenario. clock: of its time stamps. Raises CameraError for any driver error."""
    try:
        module, name = _DRIVERS[config.kind]
        driver = getattr(importlib.import_module(f"camera_node.sources.devices.{module}"), name)
        device = config.devices.get(camera)
        opened: Feed = driver(camera, None if device is None else str(device), config, fps, clock)
        return opened
    except Exception as error:
        raise as_camera_error(camera, error) from None


def _close_quietly(feed: Feed | None) -> None:
    """Close a feed, if there is one, and ignore errors: a camera that is gone may raise once more."""
    with contextlib.suppress(Exception):
        if feed is not None:
            feed.close()


class LiveSource(Source):
    """One real camera. The constructor waits for the first frame, and raises CameraError without one.

    opener: opens the camera, or raises; called again after a failure.
    poses: of the camera.
    calibrated: intrinsics that replace the device's own, scaled to the images' size; None: the device's own. A number:
        no lens is known yet, one of this horizontal angle of view is taken, degrees.
    first_frame_s: how long the first frame may take, and how long an open camera may be silent before it is reopened.
    """

    def __init__(
        self,
        camera: str,
        fps: Fraction,
        opener: Callable[[], Feed],
        poses: PoseProvider,
        calibrated: Pinhole | float | None = None,
        first_frame_s: float = FIRST_FRAME_S,
    ) -> None:
        self.camera, self.fps = camera, fps
        self._open, self._poses = opener, poses
        self._patience_s = first_frame_s
        self._wait_s = min(tuned.NEXT_FRAME_S, tuned.NEXT_FRAME_PERIODS / float(fps))
        self._condition = threading.Condition()
        self._newest: tuple[int, Image, DepthImage | None] | None = None
        self._trouble = "none since the last one"
        self._stop = threading.Event()
        feed: Feed | None = None
        try:
            feed = opener()
            first = feed.grab(first_frame_s)
            if first is None:
                raise CameraError(f"{camera}: the camera opened, but sent no frame for {first_frame_s:g} s")
            if isinstance(calibrated, float):
                calibrated = Pinhole.from_fov(first[1].shape[1], first[1].shape[0], calibrated)
            lens = calibrated or feed.intrinsics
            if lens is None:
                raise CameraError(feed.no_intrinsics)
            self.intrinsics = self._scaled(lens, first[1])
            self._newest = (*first, feed.depth)
        except BaseException as error:
            _close_quietly(feed)
            if isinstance(error, Exception):
                raise as_camera_error(camera, error) from None
            raise
        atexit.register(self.close)
        self._thread = threading.Thread(target=self._main, args=(feed,), name=f"camera {camera}", daemon=True)
        self._thread.start()

    def read(self, content: int) -> Shot:
        """The newest frame if it was not read yet; waits for one up to half a period (at most 0.5 s).
        ``content`` is ignored. Raises CameraError without a new frame, PoseGapError if its instant has no
        pose."""
        with self._condition:
            if not self._condition.wait_for(lambda: self._newest is not None, self._wait_s):
                raise CameraError(f"{self.camera}: no new frame: {self._trouble}")
            assert self._newest is not None
            captured_ns, image, depth = self._newest
            self._newest = None
        pose, gap_ns = self._poses.at(captured_ns)
        return Shot(image, pose, self.intrinsics, gap_ns, captured_ns, depth)

    @property
    def poses_refused(self) -> int:
        """See ``Source``."""
        return getattr(self._poses, "refused", 0)

    def close(self) -> None:
        """Stop the thread, which closes the camera."""
        atexit.unregister(self.close)
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(tuned.CAMERA_JOIN_S)

    def _scaled(self, lens: Pinhole, image: Image) -> Pinhole:
        height, width = image.shape[:2]
        scaled = lens.scaled(width / lens.width)
        if (scaled.width, scaled.height) != (width, height):
            raise CameraError(
                f"{self.camera}: pictures are {width} x {height}, calibrated for {lens.width} x "
                f"{lens.height}: another shape; ask for the size that was calibrated"
            )
        return scaled

    def _main(self, feed: Feed) -> None:
        current: Feed | None = feed
        failures, heard_s = 0, time.monotonic()
        while not self._stop.is_set():
            try:
                if current is None:
                    current, heard_s = self._open(), time.monotonic()
                if self._take(current):
                    failures, heard_s = 0, time.monotonic()
                elif time.monotonic() - heard_s >= self._patience_s:
                    raise CameraError(f"{self.camera}: no frame for {self._patience_s:g} s: opening the camera again")
            except Exception as error:  # drivers raise anything, and this thread is the camera's only one
                trouble = as_camera_error(self.camera, error)
                if not failures:
                    log.warning("%s (trying again)", trouble)
                self._trouble = str(trouble)
                _close_quietly(current)
                current = None
                self._stop.wait(tuned.REOPEN_AFTER_S[min(failures, len(tuned.REOPEN_AFTER_S) - 1)])
                failures += 1
        _close_quietly(current)

    def _take(self, feed: Feed) -> bool:
        """Wait up to ``GRAB_S`` for a frame and keep it. Returns whether one came."""
        taken = feed.grab(tuned.GRAB_S)
        if taken is None:
            self._trouble = f"none for {tuned.GRAB_S:g} s"
            return False
        if taken[1].shape[:2] != (self.intrinsics.height, self.intrinsics.width):
            raise CameraError(f"{self.camera}: its pictures have changed their size")
        self._trouble = "none since the last one"
        with self._condition:
            self._newest = (*taken, feed.depth)
            self._condition.notify_all()
        return True


def open_live(
    scenario: Scenario, config: LiveConfig, cameras: Sequence[str], any_fov_deg: float | None = None
) -> dict[str, LiveSource]:
    """See ``camera_node.sources.registry.open_sources``. Raises ScenarioError, CameraError or ArmError.

    any_fov_deg: horizontal angle of view of cameras that have no calibration yet; None: lenses and poses are known.
    """
    if len(cameras) > 1:
        for camera in cameras:
            if camera not in config.devices:
                raise ScenarioError(f"{scenario.path}: source.devices.{camera}: missing: which camera is it?")
    # Of the cameras of this node: another machine's may have the same number.
    devices = [_spelt_out(config, str(config.devices[camera])) for camera in cameras if camera in config.devices]
    if doubles := [device for device in devices if devices.count(device) > 1]:
        raise ScenarioError(f"{scenario.path}: source.devices: more than one camera is {doubles[0]}")
    fps, clock = rate(config.fps or LIVE_FPS), WallClock()
    known = calibrations(scenario, config) if any_fov_deg is None else {}
    standing = FixedPose(Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    poses = _poses(scenario, config, cameras, known) if any_fov_deg is None else dict.fromkeys(cameras, standing)
    sources: dict[str, LiveSource] = {}
    try:
        for camera in cameras:
            sources[camera] = LiveSource(
                camera,
                fps,
                partial(open_feed, camera, config, fps, clock),
                poses[camera],
                known[camera].intrinsics if camera in known else any_fov_deg,
                config.first_frame_s,
            )
    except BaseException:
        for opened in (*sources.values(), *poses.values()):
            if isinstance(opened, Closable):
                opened.close()
        raise
    return sources


def _spelt_out(config: LiveConfig, device: str) -> str:
    """A device as no other is called: 0, /dev/video0 and a link to that are one."""
    if config.kind != "camera" or "://" in device:
        return device
    return str(Path(f"/dev/video{device}" if device.isdecimal() else device).resolve())


def calibrations(scenario: Scenario, config: LiveConfig) -> dict[str, CalibratedCamera]:
    """Calibrated cameras by name, from the scenario's calibration file; empty if it names none. Raises
    DatasetError."""
    if config.calibration is None:
        return {}
    return load_calibration(beside(scenario, config.calibration))


def _poses(
    scenario: Scenario, config: LiveConfig, cameras: Sequence[str], known: Mapping[str, CalibratedCamera]
) -> dict[str, PoseProvider]:
    """Poses from the arm, else of a tracker, else from the calibration. Raises ScenarioError if a camera has none."""
    poses: dict[str, PoseProvider] = {}
    if config.arm is not None:
        from camera_node.robot.arm.camera_poses import camera_poses

        poses.update(camera_poses(scenario, config.arm, cameras))
    if config.trajectory is not None:
        from camera_node.pose.trajectories import trajectory_poses

        tracked = [camera for camera in cameras if camera not in poses]
        poses.update(trajectory_poses(scenario, config.trajectory, tracked, scenario.path.parent, live=True))
    for camera in cameras:
        pose = known[camera].pose if camera in known else None
        if camera in poses:
            continue
        if pose is None:
            raise ScenarioError(
                f"{scenario.path}: source: camera {camera} has no pose: name it in arm.cameras or trajectory.files, or "
                "give R_world_to_cam and t_world_to_cam in the calibration"
            )
        poses[camera] = FixedPose(pose)
    return poses
