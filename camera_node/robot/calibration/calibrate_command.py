"""``camera-node calibrate``: hand-eye, intrinsics, and a target to print."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from camera_node.robot.calibration import DEFAULT_METHOD, MAX_GAP_S, WANT_MM, CalibrationError

if TYPE_CHECKING:
    from camera_node.robot.calibration.hand_eye.calibrate import Calibration

EXAMPLES = """examples:
  camera-node calibrate target charuco:7x5:30mm:22mm --out board.png        print it, measure it, fix it flat
  camera-node calibrate intrinsics pictures/ --board charuco:7x5:30mm:22mm --out lens.json
  camera-node calibrate intrinsics --live bench.yaml --camera hand --board charuco:7x5:30mm:22mm
  camera-node calibrate hand-eye handeye/ --board chessboard:9x6:23.6mm     ViSP's layout: pictures and poses
  camera-node calibrate hand-eye --pairs samples.json --json                MoveIt's: [hand, target] pairs
  camera-node calibrate hand-eye --hand arm.csv --target seen.csv           streams, time offset unknown
  camera-node calibrate hand-eye --live cell.yaml --camera cam00 --board charuco:7x5:30mm:22mm --out hand.yaml
"""

HAND_EYE = """Estimates the pose of a camera on the end effector ("hand"), T_EE^C of the thesis (4.2), or with
--eye-to-hand in the arm's base frame: by Tsai-Lenz, four other closed-form methods, and a joint refinement
that also estimates the arm's noise. Degenerate motions are refused with the reason.

input, one of:
  FOLDER         pictures NAME-3.png with NAME_3.yaml, the hand's pose (rows: 6, cols: 1, data: [tx ty tz and
                 theta u], meters and radians)
  --pairs FILE   JSON list of [end-effector in base, target in camera], 4 x 4 each
  --hand CSV --target CSV   lines t,x,y,z,qx,qy,qz,qw (seconds, meters); the time offset is estimated too
  --live SCENARIO --camera ID   guided session: move the hand, hold still; it says which poses are missing and
                 when there are enough. Hand poses come from the camera's source (without hand_eye), or from
                 --hand CSV, by seconds since the first frame
"""


# Option -> the inputs that use it. With any other input it is an error.
_GOES_WITH = {
    "board": ("folder", "live"),
    "lens": ("folder", "live"),
    "max_gap_ms": ("hand", "live"),
    **dict.fromkeys(("camera", "data", "want_mm", "moving", "samples", "preview", "seconds"), ("live",)),
}
_INPUT_NAMES = {"folder": "FOLDER", "hand": "--hand CSV", "live": "--live SCENARIO"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fill in ``camera-node calibrate``."""
    parser.set_defaults(run=run)
    what = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    raw = argparse.RawDescriptionHelpFormatter
    _add_hand_eye(
        what.add_parser(
            "hand-eye",
            help="pose of a camera on the end effector",
            description=HAND_EYE,
            epilog=EXAMPLES,
            formatter_class=raw,
        )
    )
    lens = what.add_parser(
        "intrinsics", help="a camera's intrinsics from pictures of a target", epilog=EXAMPLES, formatter_class=raw
    )
    lens.add_argument(
        "folder",
        type=Path,
        nargs="?",
        metavar="FOLDER",
        help="folder of 10 to 20 pictures, the target tilted and in every corner",
    )
    lens.add_argument(
        "--live",
        metavar="SCENARIO",
        help="instead of FOLDER: a guided session that says where to show the target and when to stop",
    )
    _add_board(lens, required=True)
    lens.add_argument(
        "--camera", default="cam00", metavar="ID", help="camera of --live, and its name in the file [%(default)s]"
    )
    lens.add_argument(
        "--out", type=Path, metavar="FILE", help="calibration JSON to write, as source kinds camera and video read it"
    )
    lens.add_argument("--json", action="store_true", help="print the calibration as JSON, as --out writes it")
    live = _add_live_group(lens)
    live("--moving", action="store_true", help="also take pictures while the target moves; needs short exposures")
    target = what.add_parser(
        "target", help="write an image of a target, to print", epilog=EXAMPLES, formatter_class=raw
    )
    target.add_argument("board", metavar="SPEC", help="target, as in hand-eye --board")
    target.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="image to write")
    target.add_argument("--dpi", type=float, default=300.0, help="dots per inch [%(default)g]")


def _add_live_group(parser: argparse.ArgumentParser) -> Callable[..., Any]:
    """Add the options of every guided session. Returns what adds further ones to their group."""
    live = parser.add_argument_group("with --live").add_argument
    live("--data", type=Path, metavar="DIR", help="folder of recorded data sets [$FRESHFIELD_DATA]")
    live(
        "--preview", type=Path, metavar="FILE.png", help="keep the newest picture, with the corners found, in this file"
    )
    live("--seconds", type=float, metavar="S", help="end the session after S seconds")
    return live


def _add_board(parser: argparse.ArgumentParser, required: bool) -> None:
    parser.add_argument(
        "--board",
        required=required,
        metavar="SPEC",
        help="target: charuco:7x5:30mm:22mm[:4X4_50], chessboard:9x6:23.6mm (inner corners), "
        "apriltag:36h11:0:80mm, qr:60mm[:TEXT]",
    )


def _add_hand_eye(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, nargs="?", metavar="FOLDER", help="pictures and hand poses, see above")
    add("--pairs", type=Path, metavar="FILE", help="pairs of poses, JSON")
    add("--hand", type=Path, metavar="CSV", help="stream of hand poses")
    add("--target", type=Path, metavar="CSV", help="stream of target poses in the camera")
    add("--live", metavar="SCENARIO", help="guided session with a camera of this scenario")
    _add_board(parser, required=False)
    add(
        "--lens",
        type=Path,
        metavar="FILE",
        help="intrinsics: calibration JSON or ViSP's XML [the folder's XML, the live camera's own]",
    )
    add("--eye-to-hand", action="store_true", help="the camera stands still, the hand holds the target")
    add(
        "--method",
        default=DEFAULT_METHOD,
        metavar="NAME",
        help="tsai, park, horaud, andreff, daniilidis or refined [%(default)s]",
    )
    add(
        "--max-gap-ms",
        type=float,
        metavar="MS",
        help=f"largest time from a target pose to a hand pose of a stream [{MAX_GAP_S * 1e3:g}]",
    )
    add(
        "--json",
        action="store_true",
        help="print {transform, time_offset_s, residual_mm, residual_deg, method, std_mm, std_deg, warnings}",
    )
    add(
        "--out",
        type=Path,
        metavar="FILE.yaml",
        help="file to write, for source.arm.cameras or source.trajectory.hand_eye",
    )
    add(
        "--plot", type=Path, metavar="FILE.png", help="figure to write: residuals, rotation axes, scatter of the target"
    )
    live = _add_live_group(parser)
    live("--camera", metavar="ID", help="camera of the scenario")
    live(
        "--want-mm",
        type=float,
        metavar="MM",
        help=f"end when the standard deviation of the position is below this [{WANT_MM:g}]",
    )
    live(
        "--moving",
        action="store_true",
        help="also take pictures while the hand moves; with an arm, the "
        "time offset between its stamps and the camera's is estimated from the motion",
    )
    live(
        "--samples",
        type=Path,
        metavar="FILE",
        help="write each sample, as --pairs reads it; continues from those of an earlier session",
    )


def run(args: argparse.Namespace) -> int:
    """Run a calibrate command and return its exit status. Raises CalibrationError."""
    if args.what == "target":
        return _target(args)
    try:
        import scipy  # noqa: F401
    except ImportError:
        raise CalibrationError("calibration needs scipy (pip install 'freshfield[calibrate]')") from None
    try:
        return {"hand-eye": _hand_eye, "intrinsics": _intrinsics}[args.what](args)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:  # of a scenario, a file, a camera or an arm, in one line
        raise CalibrationError(str(error)) from None


def _hand_eye(args: argparse.Namespace) -> int:
    given = {name for name in ("folder", "pairs", "hand", "target", "live") if getattr(args, name) is not None}
    if given not in ({"folder"}, {"pairs"}, {"hand", "target"}, {"live"}, {"live", "hand"}):
        raise CalibrationError("expected one of FOLDER, --pairs FILE, --hand CSV --target CSV, --live SCENARIO")
    for option, goes_with in _GOES_WITH.items():
        if getattr(args, option) not in (None, False) and not given & set(goes_with):
            places = " or ".join(_INPUT_NAMES[each] for each in goes_with)
            raise CalibrationError(f"--{option.replace('_', '-')}: goes with {places}")
    args.max_gap_ms = MAX_GAP_S * 1e3 if args.max_gap_ms is None else args.max_gap_ms
    args.want_mm = WANT_MM if args.want_mm is None else args.want_mm
    from camera_node.robot.calibration.hand_eye import calibrate as hand_eye
    from camera_node.robot.calibration.hand_eye import report

    if args.method not in hand_eye.ALL_METHODS:
        raise CalibrationError(f"--method: expected one of {', '.join(hand_eye.ALL_METHODS)}")
    found = _calibrate(args)
    if args.json:
        for warning in found.warnings:
            _note(f"note: {warning}")
    # Print first: the result is not lost if a file cannot be written.
    print(json.dumps(found.to_dict()) if args.json else report.show(found), flush=True)
    if args.out is not None:
        report.write_yaml(found, args.out)
    if args.plot is not None:
        report.plot(found, args.plot)
    return 0


def _calibrate(args: argparse.Namespace) -> Calibration:
    from camera_node.config import MAX_GAP_MS
    from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
    from camera_node.robot.calibration import files
    from camera_node.robot.calibration.hand_eye import calibrate as hand_eye
    from camera_node.robot.calibration.targets import parse_target

    setup = EYE_TO_HAND if args.eye_to_hand else EYE_IN_HAND
    if args.pairs is not None:
        return hand_eye.calibrate(files.read_pairs(args.pairs, setup), args.method)
    if not 0 < args.max_gap_ms <= MAX_GAP_MS:
        raise CalibrationError(f"--max-gap-ms: expected a positive number up to {MAX_GAP_MS:.0f}")
    if args.live is None and args.hand is not None:
        hand, target = files.read_track(args.hand), files.read_track(args.target)
        for name, track in (("hand", hand), ("target", target)):
            if track.counts.duplicates or track.counts.reordered:
                _note(
                    f"{name}: {track.counts.duplicates} stamps came twice (the first is used), "
                    f"{track.counts.reordered} out of order (sorted)"
                )
        return hand_eye.calibrate_tracks(hand, target, setup, args.method, args.max_gap_ms / 1e3)
    if args.board is None:
        raise CalibrationError("--board SPEC: say what the target is")
    if args.live is not None and args.camera is None:
        raise CalibrationError("--camera ID: say which of the scenario's cameras")
    board = parse_target(args.board)
    lens = None if args.lens is None else files.read_lens(args.lens)
    if args.live is not None:
        from camera_node.robot.calibration.hand_eye.live import calibrate_live

        return calibrate_live(args, board, lens, setup)
    samples, unused = files.read_visp_folder(args.folder, board, lens, setup, _print_progress)
    for name, why in unused.items():
        _note(f"{name}: {why}")
    return hand_eye.calibrate(samples, args.method)


def _intrinsics(args: argparse.Namespace) -> int:
    from camera_node.robot.calibration.files import list_images
    from camera_node.robot.calibration.lens.solve import calibrate_folder
    from camera_node.robot.calibration.targets import parse_target
    from freshfield import files

    if (args.folder is None) == (args.live is None):
        raise CalibrationError("expected one of FOLDER, --live SCENARIO")
    if args.folder is not None:
        for option in ("data", "moving", "preview", "seconds"):
            if getattr(args, option) not in (None, False):
                raise CalibrationError(f"--{option}: goes with {_INPUT_NAMES['live']}")
        lens = calibrate_folder(list_images(args.folder), parse_target(args.board), _print_progress)
    else:
        from camera_node.robot.calibration.lens.live import calibrate_live

        lens = calibrate_live(args, parse_target(args.board))
    data = lens.calibration(args.camera)
    if args.out is not None:
        try:
            files.write_json(args.out, data, indent=1)
        except OSError as error:
            raise CalibrationError(f"--out: {args.out}: {error.strerror}") from None
    print(json.dumps(data) if args.json else lens.show())
    return 0


def _target(args: argparse.Namespace) -> int:
    import cv2
    import numpy as np

    from camera_node.robot.calibration.targets import parse_target

    board = parse_target(args.board)
    sides = [side_m / 0.0254 * args.dpi for side_m in board.size_m]
    if not 64 <= sides[0] <= 32_000:
        raise CalibrationError(f"--dpi: makes a picture {sides[0]:.0f} pixels wide, expected 64 to 32000")
    width, height = map(round, sides)
    # Draw finer, with whole pixels per module, then scale. Otherwise the modules' rounding errors add up.
    fine = board.draw(board.modules * math.ceil(2 * width / board.modules))
    picture = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    # Detectors need a white border.
    border = max(8, width // 10)
    if not cv2.imwrite(str(args.out), np.pad(picture, border, constant_values=255)):
        raise CalibrationError(f"--out: {args.out} cannot be written (does its folder exist? .png?)")
    print(
        f"{args.out}: print it at {args.dpi:g} dpi without scaling; without its white border it must measure "
        f"{board.pattern_m[0] * 1e3:.1f} x {board.pattern_m[1] * 1e3:.1f} mm"
    )
    return 0


def _print_progress(done: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{done} pictures ", end="", file=sys.stderr, flush=True)


def _note(line: str) -> None:
    print(line, file=sys.stderr)
