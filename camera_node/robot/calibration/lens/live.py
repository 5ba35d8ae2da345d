"""``camera-node calibrate intrinsics --live``: a scenario's camera and a session, at the camera's pace."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from camera_node.config import LiveConfig, SourceConfig, source_config
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.live import Pace, say, write_picture
from camera_node.robot.calibration.lens.session import LensSession
from camera_node.robot.calibration.lens.solve import Lens
from camera_node.robot.calibration.targets import Target
from camera_node.sources.devices.feed import as_camera_error
from camera_node.sources.devices.live import DEFAULT_FPS, open_feed
from camera_node.sources.playback import rate
from camera_node.sources.registry import open_sources
from freshfield import payload, scenario
from freshfield.clock import WallClock

Image = NDArray[np.uint8]

_GRAB_S = 1.0


def calibrate_live(args: argparse.Namespace, board: Target) -> Lens:
    """Run a session with a scenario's camera. Ctrl-C ends it with what there is. Raises CalibrationError,
    ScenarioError."""
    if args.seconds is not None and not args.seconds > 0:
        raise CalibrationError("--seconds: expected a positive number")
    plan = scenario.load(args.live)
    if args.camera not in plan.cameras:
        raise CalibrationError(f"--camera: {plan.path} has {', '.join(plan.cameras)}, got {args.camera}")
    session = LensSession(board, args.moving)
    try:
        with contextlib.closing(_pictures(plan, source_config(plan), args)) as pictures:
            for image in pictures:
                step = session.offer(image)
                say(step.outcome, step.line)
                if args.preview is not None:
                    write_picture(args.preview, session.preview(image, step))
                if step.enough:
                    break
    except KeyboardInterrupt:
        print("\nstopped; what there is:", file=sys.stderr)
    except OSError as error:
        raise CalibrationError(f"--preview cannot be written: {error}") from None
    return session.lens()


def _pictures(
    plan: scenario.Scenario, config: SourceConfig, args: argparse.Namespace
) -> Generator[Image, None, None]:
    """uint8 RGB, until time is over or a recording has been seen once."""
    if isinstance(config, LiveConfig):
        return _taken(plan, config, args)
    return _recorded(plan, config, args)


def _taken(
    plan: scenario.Scenario, config: LiveConfig, args: argparse.Namespace
) -> Generator[Image, None, None]:
    """Of the camera itself: a source would ask for the lens that is to be found."""
    fps = rate(config.fps or DEFAULT_FPS)
    try:
        feed = open_feed(args.camera, config, fps, WallClock())
    except ValueError as error:
        raise CalibrationError(str(error)) from None
    pace = Pace(float(fps), args.seconds)
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


def _recorded(
    plan: scenario.Scenario, config: SourceConfig, args: argparse.Namespace
) -> Generator[Image, None, None]:
    try:
        source = open_sources(plan, config, [args.camera], args.data)[args.camera]
    except (ValueError, OSError) as error:
        raise CalibrationError(str(error)) from None
    pace = Pace(float(source.fps), args.seconds)
    first = 0 if source.contents is not None else round(WallClock().now_ns() * source.fps / 10**9)
    try:
        for tick in itertools.count():
            if (source.contents is not None and tick >= source.contents) or not pace(tick):
                return
            try:
                shot = source.read(source.content(first + tick))
            except ValueError as error:  # one shot that cannot be had; later ones may
                print(f"\n{error}", file=sys.stderr)
                continue
            image = shot.image
            if isinstance(image, bytes):
                image = payload.decode(image, config.codec, shot.intrinsics.width, shot.intrinsics.height)
            yield image
    finally:
        source.release()
