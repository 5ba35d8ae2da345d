"""What every real camera shares: a thread that takes its frames as they come, and the newest one on demand.

A frame is stamped by the camera's driver, never by whoever fetches it, and is handed out once. A camera that
fails is opened again with growing pauses, while its frames are counted as failed.
"""

from __future__ import annotations

import atexit
import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from camera_node.config import LiveConfig
from camera_node.pose.providers import Closing, FixedPose, PoseProvider
from camera_node.sources import Shot, Source
from camera_node.sources.playback import rate
from camera_node.sources.rig_calibration import Calibrated, load_calibration
from freshfield.clock import Clock, WallClock
from freshfield.geometry import Pinhole
from freshfield.scenario import Scenario, ScenarioError

log = logging.getLogger("camera-node")

Image = NDArray[np.uint8]

DEFAULT_FPS = 15.0
BACKOFF_S = (0.25, 0.5, 1.0, 2.0, 5.0)
_LOOK_S = 0.5
_GONE_S = 2.0
C = TypeVar("C", bound=LiveConfig)


class CameraError(ValueError):
    """A camera that cannot be used, or gave no frame; one line: what, where, what to do."""


class Feed(Protocol):
    """An open camera."""

    intrinsics: Pinhole | None
    """The device's own, for images as ``grab`` returns them; None where it knows none."""
    no_lens: str
    """Why ``intrinsics`` is None, and what to do, in one line; "" else."""
    stamped_by: str
    """Where a frame's instant comes from, for people; known when the first frame is here."""

    def grab(self, timeout_s: float) -> tuple[int, Image] | None:
        """The next frame: when the middle of it was exposed (ns, our clock) and uint8 RGB (H, W, 3); None
        after ``timeout_s`` without one. Raises CameraError if the camera is gone."""
        ...

    def close(self) -> None: ...


def as_camera_error(camera: str, error: Exception) -> CameraError:
    """What a camera's driver raised, in one line that names the camera."""
    if isinstance(error, CameraError):
        return error
    return CameraError(f"{camera}: {type(error).__name__}: {' '.join(str(error).split())}")


def meant(camera: str, make: str, device: str | None, there: Sequence[str]) -> int:
    """Which of the devices of a make (their serial numbers, one at least) is meant: the one named, or the
    only one. Raises CameraError naming those that are there."""
    names = ", ".join(there)
    if device is None:
        if len(there) > 1:
            raise CameraError(f"{camera}: several {make} cameras, name one in source.devices: {names}")
        return 0
    if device not in there:
        raise CameraError(f"{camera}: no {make} camera {device}; there are {names}")
    return there.index(device)


def opened(camera: str, open_feed: Callable[[], Feed]) -> Feed:
    """Raises CameraError, whatever the driver raises."""
    try:
        return open_feed()
    except Exception as error:
        raise as_camera_error(camera, error) from None


def close_quietly(feed: Feed) -> None:
    """A camera that is gone may say so once more."""
    try:
        feed.close()
    except Exception as error:
        log.debug("closing a camera: %s", error)


def lens_or_why(find: Callable[[], Pinhole]) -> tuple[Pinhole | None, str]:
    """``intrinsics`` and ``no_lens`` of a feed: a camera that was calibrated here needs none of its own."""
    try:
        return find(), ""
    except CameraError as error:
        return None, str(error)


class LiveSource:
    """One camera behind ``Source``. open_feed: opens the camera, or raises CameraError.

    calibrated: intrinsics that replace the device's own, scaled to the pictures' size. The constructor
    returns when the first frame is here; raises CameraError after ``first_frame_s``.
    """

    contents: int | None = None

    def __init__(
        self,
        camera: str,
        fps: Fraction,
        open_feed: Callable[[], Feed],
        poses: PoseProvider,
        calibrated: Pinhole | None = None,
        first_frame_s: float = 3.0,
    ) -> None:
        self.camera, self.fps = camera, fps
        self._open, self._poses = open_feed, poses
        self._wait_s = min(0.5, 0.5 / float(fps))
        self._condition = threading.Condition()
        self._newest: tuple[int, Image] | None = None
        self._trouble = "none since the last one"
        self._stop = threading.Event()
        feed = opened(camera, open_feed)
        try:
            first = feed.grab(first_frame_s)
            if first is None:
                raise CameraError(f"{camera}: the camera opened, but sent no frame for {first_frame_s:g} s")
            lens = calibrated or feed.intrinsics
            if lens is None:
                raise CameraError(feed.no_lens)
            self.intrinsics = self._lens(lens, first[1])
        except BaseException as error:
            close_quietly(feed)
            if isinstance(error, Exception):
                raise as_camera_error(camera, error) from None
            raise
        self._newest = first
        atexit.register(self.close)
        self._thread = threading.Thread(target=self._main, args=(feed,), name=f"camera {camera}", daemon=True)
        self._thread.start()

    def content(self, tick: int) -> int:
        return tick

    def read(self, content: int) -> Shot:
        """The newest frame that was not read yet; waits half a period for it. Raises CameraError, and
        PoseGapError where its instant has no pose."""
        with self._condition:
            if not self._condition.wait_for(lambda: self._newest is not None, self._wait_s):
                raise CameraError(f"{self.camera}: no new frame: {self._trouble}")
            assert self._newest is not None
            captured_ns, image = self._newest
            self._newest = None
        paired = self._poses.at(captured_ns)
        return Shot(image, paired.pose, self.intrinsics, paired.gap_ns, captured_ns)

    def prepare(self, stopped: Callable[[], bool]) -> None:
        """A camera has nothing to make ahead."""

    def release(self) -> None:
        """It goes on running: opening it takes seconds."""

    def close(self) -> None:
        """Let go of the camera."""
        atexit.unregister(self.close)
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(_GONE_S)

    def _lens(self, lens: Pinhole, image: Image) -> Pinhole:
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
        failures = 0
        while not self._stop.is_set():
            try:
                if current is None:
                    current = self._open()
                if self._take(current):
                    failures = 0
            except (
                Exception
            ) as error:  # drivers raise what they like, and this thread is the camera's only one
                trouble = as_camera_error(self.camera, error)
                if not failures:
                    log.warning("%s (trying again)", trouble)
                self._trouble = str(trouble)
                if current is not None:
                    close_quietly(current)
                    current = None
                self._stop.wait(BACKOFF_S[min(failures, len(BACKOFF_S) - 1)])
                failures += 1
        if current is not None:
            close_quietly(current)

    def _take(self, feed: Feed) -> bool:
        """Wait a little for a frame and keep it; whether one came."""
        taken = feed.grab(_LOOK_S)
        if taken is None:
            self._trouble = f"none for {_LOOK_S:g} s"
            return False
        if taken[1].shape[:2] != (self.intrinsics.height, self.intrinsics.width):
            raise CameraError(f"{self.camera}: its pictures have changed their size")
        self._trouble = "none since the last one"
        with self._condition:
            self._newest = taken
            self._condition.notify_all()
        return True


def open_live(
    scenario: Scenario,
    config: C,
    cameras: Sequence[str],
    opener: Callable[[str, str | None, C, Fraction, Clock], Callable[[], Feed]],
) -> dict[str, Source]:
    """The sources of ``cameras``. opener(camera, device, config, fps, clock) gives what opens one.

    Raises ScenarioError, CameraError or ArmError.
    """
    if len(cameras) > 1:
        for camera in cameras:
            if camera not in config.devices:
                raise ScenarioError(f"{scenario.path}: source.devices.{camera}: missing: which camera is it?")
    fps, clock = rate(config.fps or DEFAULT_FPS), WallClock()
    known = calibrations(scenario, config)
    poses = _poses(scenario, config, cameras, known)
    sources: dict[str, LiveSource] = {}
    try:
        for camera in cameras:
            sources[camera] = LiveSource(
                camera,
                fps,
                opener(camera, config.devices.get(camera), config, fps, clock),
                poses[camera],
                known[camera].intrinsics if camera in known else None,
                config.first_frame_s,
            )
    except BaseException:
        for source in sources.values():
            source.close()
        for pose in poses.values():
            if isinstance(pose, Closing):
                pose.close()
        raise
    return dict(sources)


def calibrations(scenario: Scenario, config: LiveConfig) -> dict[str, Calibrated]:
    if config.calibration is None:
        return {}
    path = Path(config.calibration).expanduser()
    return load_calibration(path if path.is_absolute() else scenario.path.parent / path)


def _poses(
    scenario: Scenario, config: LiveConfig, cameras: Sequence[str], known: Mapping[str, Calibrated]
) -> dict[str, PoseProvider]:
    """Poses from the arm, else from the calibration. Raises ScenarioError where neither has one."""
    poses: dict[str, PoseProvider] = {}
    if config.arm is not None:
        from camera_node.robot.arm.camera_poses import camera_poses

        poses.update(camera_poses(scenario, config.arm, cameras))
    for camera in cameras:
        pose = known[camera].pose if camera in known else None
        if camera in poses:
            continue
        if pose is None:
            raise ScenarioError(
                f"{scenario.path}: source: camera {camera} has no pose: name it in arm.cameras, or give "
                "R_world_to_cam and t_world_to_cam in the calibration"
            )
        poses[camera] = FixedPose(pose)
    return poses
