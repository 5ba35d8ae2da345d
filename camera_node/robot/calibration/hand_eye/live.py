"""``camera-node calibrate hand-eye --live``: a guided session with a scenario's camera."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable

from camera_node.config import ArmConfig, source_config
from camera_node.pose.pairing import sort_samples
from camera_node.pose.providers import PoseProvider, Trajectory, read_samples
from camera_node.robot.arm.camera_poses import base_matrix
from camera_node.robot.calibration import CalibrationError, live_camera
from camera_node.robot.calibration.files import pairs_json, read_pairs
from camera_node.robot.calibration.hand_eye.calibrate import Calibration, calibrate, calibrate_tracks
from camera_node.robot.calibration.hand_eye.samples import Array, Samples
from camera_node.robot.calibration.hand_eye.session import HandEyeSession, HandEyeStep, preview
from camera_node.robot.calibration.hand_eye.tracks import StreamRecorder, follow_arm
from camera_node.robot.calibration.targets import Target
from camera_node.sources.base import Source
from freshfield import files, scenario
from freshfield.geometry import Pinhole, se3_inverse


def calibrate_live(args: argparse.Namespace, board: Target, lens: Pinhole | None, setup: str) -> Calibration:
    """Run a session with a scenario's camera and calibrate from its samples. Ctrl-C ends the session early.

    board, lens: the target, and a lens that replaces the camera's own.
    setup: eye-in-hand or eye-to-hand.
    Raises CalibrationError, and the errors of what it opens: scenario, files, camera, arm.
    """
    if not args.want_mm > 0 or (args.seconds is not None and not args.seconds > 0):
        raise CalibrationError("--want-mm, --seconds: expected positive numbers")
    loaded = live_camera.load_scenario(args)
    config = source_config(loaded)
    arm: ArmConfig | None = getattr(config, "arm", None)
    to_base = None if arm is None or args.hand is not None else _to_base(loaded, arm, args.camera)
    source = live_camera.open_source(loaded, config, args)
    before = None
    if args.samples is not None and args.samples.exists():
        before = read_pairs(args.samples, setup)
        print(f"{args.samples}: going on with its {len(before)} samples", file=sys.stderr)

    def keep(samples: Samples) -> None:
        if args.samples is not None:
            files.write_json(args.samples, pairs_json(samples))

    def show(image: live_camera.Image, step: HandEyeStep, session: HandEyeSession) -> None:
        live_camera.report_step(step.outcome, step.line)
        if args.preview is not None:
            live_camera.write_image(args.preview, preview(image, session.corners, step))

    hands = None
    if args.hand is not None:
        times, poses, _ = sort_samples(*read_samples(args.hand))
        hands = Trajectory(times, poses, max_gap_ns=round(args.max_gap_ms * 1e6))
    session = HandEyeSession(board, setup, args.want_mm, args.moving, before, keep)
    pace = live_camera.Pace(float(source.fps), args.seconds)
    tracks = StreamRecorder() if args.moving and to_base is not None else None
    try:
        with contextlib.ExitStack() as stack:
            stack.callback(source.release)
            if tracks is not None and arm is not None:
                stack.callback(follow_arm(loaded, arm, tracks).stop)
            guide(
                source,
                config.codec,
                lens,
                session,
                pace,
                show,
                hands,
                to_base=to_base,
                tracks=tracks,
                first=live_camera.first_tick(source),
            )
    except KeyboardInterrupt:
        print("\nstopped; what there is:", file=sys.stderr)
    except OSError as error:
        raise CalibrationError(f"--samples or --preview cannot be written: {error}") from None
    if tracks is None:
        return calibrate(session.samples(), args.method)
    return calibrate_tracks(tracks.hand(), tracks.target(), setup, args.method, args.max_gap_ms / 1e3)


def _to_base(loaded: scenario.Scenario, arm: ArmConfig, camera: str) -> Array:
    """Base-from-world (4, 4), because the arm's poses are in the world and the calibration needs them in its
    base. Raises CalibrationError."""
    if camera not in arm.cameras or arm.cameras[camera] is not None:
        raise CalibrationError(
            f"{loaded.path}: source.arm.cameras: set {camera}: null for the calibration (also for a camera "
            "that stands): its poses are then the hand's"
        )
    return se3_inverse(base_matrix(arm))


def guide(
    source: Source,
    codec: str,
    lens: Pinhole | None,
    session: HandEyeSession,
    pace: Callable[[int], bool],
    show: Callable[[live_camera.Image, HandEyeStep, HandEyeSession], None],
    hands: PoseProvider | None = None,
    to_base: Array | None = None,
    tracks: StreamRecorder | None = None,
    first: int = 0,
) -> HandEyeStep | None:
    """Offer the source's shots to the session until it has enough, ``pace`` ends it, or a recording ends.

    lens: replaces the source's own.
    show: called with every image, its step and the session.
    hands: hand poses by time since the first shot; None: the shots' poses are the hand's.
    to_base: base-from-world (4, 4), if the hand's poses are in the world.
    tracks: records the target poses and decides when there is enough.
    first: first tick of the source.
    Returns the last step.
    """
    step, begin_ns = None, None
    for tick, shot, image in live_camera.read_shots(source, codec, pace, first):
        t_ns = shot.captured_ns
        if begin_ns is None:
            begin_ns = round(first * 10**9 / source.fps) if t_ns is None else t_ns
        if t_ns is None:
            t_ns = round(tick * 10**9 / source.fps)
        try:
            hand = shot.pose if hands is None else hands.at(t_ns - begin_ns)[0]
        except ValueError as error:
            live_camera.report_skipped(error)
            continue
        matrix = hand.matrix() if to_base is None else to_base @ hand.matrix()
        step = session.offer(image, lens or shot.intrinsics, matrix)
        if tracks is not None:
            if session.seen is not None:
                tracks.add_target(t_ns, session.seen.pose)
            step = tracks.with_stream_advice(step)
        show(image, step, session)
        if step.enough:
            return step
    return step
