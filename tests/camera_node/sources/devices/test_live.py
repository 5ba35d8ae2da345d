"""Real cameras as sources: the list of those that are plugged in, and one that streams over the network."""

import threading
import time
from fractions import Fraction
from pathlib import Path
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from camera_node.capture import build_cameras
from camera_node.pose.providers import FixedPose
from camera_node.settings import CameraConfig, source_config
from camera_node.sources.devices import live
from camera_node.sources.devices import opencv as opencv_camera
from camera_node.sources.devices.connected import connected
from camera_node.sources.devices.feed import CameraError, Plugged, select_device
from camera_node.sources.devices.live import LiveSource
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole
from freshfield.scenario import ScenarioError, load, parse
from tests.camera_node.depth_source import POSE
from tests.camera_node.sources.devices.mjpeg import SIZE, NetworkCamera, camera_file, number_of
from tests.support import patiently, refused, wait_until


def scenario(folder: Path, device: str):
    return load(camera_file(folder, device, width=SIZE[0], height=SIZE[1]))


def test_frames_come_once_each_in_order_and_with_the_time_of_their_arrival(tmp_path):
    clock = WallClock()
    network = NetworkCamera(clock)
    plan = scenario(tmp_path, network.address)
    (camera,) = build_cameras(plan, source_config(plan), plan.cameras)
    seen = []
    for _ in range(8):
        shot = patiently(lambda: camera.source.read(0), CameraError)
        assert 0 <= clock.now_ns() - shot.captured_ns < 20e9
        seen.append((number_of(shot.image), shot.captured_ns))
    numbers, stamps = zip(*seen)
    assert list(numbers) == sorted(set(numbers)) and list(stamps) == sorted(set(stamps))
    # No frame is stamped before it was sent.
    assert all(stamp > network.sent_ns[number] for number, stamp in seen)
    assert shot.image[40, 10, 2] > 150 > shot.image[40, 10, 0]  # RGB
    assert shot.intrinsics.fx == 60.0 and shot.intrinsics.cx == 32.0
    assert shot.pose.translation_m == (0.0, 0.0, -1.0)
    camera.source.close()
    network.close()
    for device, says in (("77", "eye: no camera at 77: is it plugged in"), (__file__, "it is a file, not a device")):
        plan = scenario(tmp_path, device)
        refused(CameraError, says, build_cameras, plan, source_config(plan), plan.cameras)


LENS = Pinhole.from_fov(*SIZE, 60.0)
STANDING = FixedPose(POSE)


class Feed:
    """A camera that gives frames until ``breaks_after`` of them, and then ``trouble``; without one it is silent."""

    stamped_by, depth = "itself", None

    def __init__(self, intrinsics=LENS, no_intrinsics="", breaks_after=10**9, trouble=None):
        self.intrinsics, self.no_intrinsics = intrinsics, no_intrinsics
        self._left, self._trouble, self.closed = breaks_after, trouble, False

    def grab(self, timeout_s):
        time.sleep(0.01)
        if self._left == 0 and self._trouble is not None:
            raise self._trouble
        if self._left == 0:
            return None
        self._left -= 1
        return time.time_ns(), np.zeros((SIZE[1], SIZE[0], 3), np.uint8)

    def close(self):
        self.closed = True
        raise RuntimeError("it is gone")


def test_a_camera_that_is_silent_or_breaks_gives_no_old_frames_and_is_opened_again():
    """As drivers of OAK and RealSense are, without an error or with any."""
    trouble = RuntimeError("failed to set power state")
    feeds = [Feed(breaks_after=1), None, Feed(breaks_after=3, trouble=trouble), Feed()]
    opened = []

    def open_feed():
        opened.append(feeds[len(opened)])
        if opened[-1] is None:
            raise trouble
        return opened[-1]

    source = LiveSource("eye", Fraction(10), open_feed, STANDING, None, 0.05)
    stamps = [source.read(0).captured_ns]
    refused(CameraError, "eye: no new frame", lambda: [source.read(0) for _ in range(4)])
    stamps += [patiently(lambda: source.read(0), CameraError).captured_ns]
    wait_until(lambda: len(opened) == 4, "it is not opened again")
    stamps += [patiently(lambda: source.read(0), CameraError).captured_ns for _ in range(2)]
    source.close()
    assert stamps == sorted(set(stamps)) and feeds[0].closed and feeds[2].closed


def test_whatever_a_driver_raises_at_the_start_is_one_line():
    feed = Feed(breaks_after=0, trouble=RuntimeError("xioctl(VIDIOC_S_FMT) failed\nlast error: 5"))
    with pytest.raises(CameraError, match=r"^eye: RuntimeError: xioctl\(VIDIOC_S_FMT\) failed last error: 5$"):
        LiveSource("eye", Fraction(30), lambda: feed, STANDING)
    assert feed.closed


def test_the_lens_is_the_calibrations_scaled_to_the_pictures_and_missed_only_without_one():
    why = "eye: the device holds no calibration: calibrate it"
    source = LiveSource("eye", Fraction(30), lambda: Feed(None, why), STANDING, calibrated=LENS.scaled(0.5))
    source.close()
    assert source.intrinsics == LENS
    refused(CameraError, why, LiveSource, "eye", Fraction(30), lambda: Feed(None, why), STANDING)
    wide = Pinhole.from_fov(100, 48, 60.0)
    with pytest.raises(CameraError, match=r"pictures are 64 x 48, calibrated for 100 x 48"):
        LiveSource("eye", Fraction(30), Feed, STANDING, calibrated=wide)


def test_a_camera_that_fails_leaves_no_other_one_open(tmp_path, monkeypatch):
    first, arm = Feed(), MagicMock(**{"at.return_value": STANDING.at(0)})
    (tmp_path / "by-id").symlink_to("/dev/video0")

    def open_feed(camera, config, fps, clock):
        if camera == "other":
            raise CameraError("other: no camera")
        return first

    source = scenario(tmp_path, "0").source | {"devices": {"eye": "0", "other": "1"}}
    plan = parse({"cameras": {"ids": ["eye", "other"]}, "source": source}, tmp_path / "scenario.yaml")
    monkeypatch.setattr(live, "_poses", lambda *_: {"eye": arm, "other": STANDING})
    monkeypatch.setattr(live, "open_feed", open_feed)
    refused(CameraError, "other: no camera", live.open_live, plan, source_config(plan), plan.cameras)
    for other in ("0", str(tmp_path / "by-id")):  # the number, and a link to what it stands for
        source["devices"] = {"eye": 0, "other": other}
        twice = parse({"cameras": {"ids": ["eye", "other"]}, "source": source}, plan.path)
        says = "more than one camera is /dev/video0"
        refused(ScenarioError, says, live.open_live, twice, source_config(twice), twice.cameras)
    live.open_live(twice, source_config(twice), ["eye"])["eye"].close()  # the other is another machine's
    assert first.closed and arm.close.called
    assert "camera eye" not in [thread.name for thread in threading.enumerate()]


class Capture:
    """OpenCV's, of frames with these stamps (ms before now on the monotonic clock)."""

    def __init__(self, ages_ms):
        self._ages_ms = list(ages_ms)
        self.given: dict[int, float] = {}
        self.set = self.given.__setitem__
        self.get = lambda key: self._stamp_ms
        self.getBackendName = lambda: "V4L2"
        self.retrieve = lambda: (True, np.zeros((SIZE[1], SIZE[0], 3), np.uint8))

    def grab(self):
        self._stamp_ms = time.monotonic_ns() / 1e6 - self._ages_ms.pop(0)
        return True


@pytest.mark.parametrize(
    "ages_ms, stamped_by, expected_ms",
    [
        ([50, 60, 1e6, -5, 40], "the kernel", [54, 64, None, None, 44]),
        ([1e6, 50, 40], "their arrival, less latency_ms", [20, 20, 20]),
    ],
)
def test_the_first_frame_decides_whose_stamps_count(monkeypatch, ages_ms, stamped_by, expected_ms):
    """A stamp of the kernel's is moved to the middle of the exposure; none changes its clock midway."""
    monkeypatch.setattr(opencv_camera, "_open", lambda *_: capture)
    capture = Capture(ages_ms)
    config = CameraConfig(kind="camera", exposure_us=8000, latency_ms=20.0)
    feed = opencv_camera.OpenCvFeed("eye", "0", config, Fraction(30), clock := WallClock())
    for age_ms in expected_ms:
        taken = feed.grab(1.0)
        if age_ms is None:
            assert taken is None
        else:
            assert (clock.now_ns() - taken[0]) / 1e6 == pytest.approx(age_ms, abs=3.0)
    assert feed.stamped_by == stamped_by
    assert capture.given[cv2.CAP_PROP_BUFFERSIZE] > 1, "the camera fills one while the other is decoded"


def test_the_camera_that_is_meant_is_the_one_named_or_the_only_one():
    def chosen(device, *serials):
        there = [Plugged(serial, "OAK-D", serial.upper()) for serial in serials]
        return select_device("eye", "OAK", device, lambda: there, "is it plugged in?").handle

    assert chosen(None, "a") == "A" and chosen("b", "a", "b") == "B"
    for device, serials in ((None, "ab"), ("c", "ab"), (None, "")):
        refused(CameraError, "^eye: (several|no) OAK camera", chosen, device, *serials)


def test_video_devices_are_listed_with_the_name_that_lasts(tmp_path):
    for number, index, name in ((0, 0, "HD Webcam"), (1, 1, "HD Webcam"), (10, 0, "Other")):
        entry = tmp_path / f"sys/class/video4linux/video{number}"
        entry.mkdir(parents=True)
        (entry / "index").write_text(f"{index}\n")
        (entry / "name").write_text(f"{name}\n")
        (tmp_path / "dev").mkdir(exist_ok=True)
        (tmp_path / f"dev/video{number}").touch()
    links = tmp_path / "dev/v4l/by-id"
    links.mkdir(parents=True)
    (links / "usb-HD_Webcam-video-index0").symlink_to("../../video0")
    assert [camera for kind, camera in connected(tmp_path) if kind == "camera"] == [
        Plugged("0", "HD Webcam; the same at every start: /dev/v4l/by-id/usb-HD_Webcam-video-index0"),
        Plugged("10", "Other"),
    ]
