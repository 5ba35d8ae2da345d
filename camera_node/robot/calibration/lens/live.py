"""``camera-node calibrate intrinsics --live``: a guided session with a scenario's camera."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
from collections.abc import Generator

from camera_node.config import LiveConfig, SourceConfig, source_config
from camera_node.robot.calibration import CalibrationError, live_camera
from camera_node.robot.calibration.lens.session import LensSession
from camera_node.robot.calibration.lens.solve import LensCalibration
from camera_node.robot.calibration.targets import Target
from camera_node.sources.base import rate
from camera_node.sources.devices.feed import as_camera_error
from camera_node.sources.devices.live import DEFAULT_FPS, open_feed
from freshfield.clock import WallClock
from freshfield.scenario import Scenario

_GRAB_S = 1.0


def calibrate_live(args: argparse.Namespace, board: Target) -> LensCalibration:
    """Run a session with a scenario's camera and calibrate from its images. Ctrl-C ends the session early.
    Raises CalibrationError, ScenarioError and CameraError."""
    if args.seconds is not None and not args.seconds > 0:
        raise CalibrationError("--seconds: expected a positive number")
    loaded = live_camera.load_scenario(args)
    session = LensSession(board, args.moving)
    try:
        with contextlib.closing(_images(loaded, source_config(loaded), args)) as images:
            for image in images:
                step = session.offer(image)
                live_camera.report_step(step.outcome, step.line)
                if args.preview is not None:
                    live_camera.write_image(args.preview, session.preview(image, step))
                if step.enough:
                    break
    except KeyboardInterrupt:
        print("\nstopped; what there is:", file=sys.stderr)
    except OSError as error:
        raise CalibrationError(f"--preview cannot be written: {error}") from None
    return session.lens()


def _images(
    loaded: Scenario, config: SourceConfig, args: argparse.Namespace
) -> Generator[live_camera.Image, None, None]:
    """Images (H, W, 3) uint8 RGB, until time is over or a recording ends."""
    if isinstance(config, LiveConfig):
        yield from _camera_images(config, args)
        return
    source = live_camera.open_source(loaded, config, args)
    try:
        pace = live_camera.Pace(float(source.fps), args.seconds)
        for _, _, image in live_camera.read_shots(source, config.codec, pace, live_camera.first_tick(source)):
            yield image
    finally:
        source.release()


def _camera_images(config: LiveConfig, args: argparse.Namespace) -> Generator[live_camera.Image, None, None]:
    """Images from the camera's feed, because a source would require the lens, which is not known yet."""
    fps = rate(config.fps or DEFAULT_FPS)
    feed = open_feed(args.camera, config, fps, WallClock())
    pace = live_camera.Pace(float(fps), args.seconds)
    try:
        for tick in itertools.count():
            if not pace(tick):
                return
            try:
                taken = feed.grab(config.first_frame_s if tick == 0 else _GRAB_S)
            except Exception as error:  # drivers raise what they like
                print(f"\n{as_camera_error(args.camera, error)}; what there is:", file=sys.stderr)
                return
            if taken is not None:
                yield taken[1]
    finally:
        feed.close()
