"""``camera-node calibrate``: hand-eye, intrinsics, a rig of fixed cameras, and a target to print."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from camera_node.robot.calibration import DEFAULT_METHOD, CalibrationError, require_one_input
from camera_node.robot.calibration.rig import rig_command

EXAMPLES = """examples:
  camera-node calibrate target charuco:7x5:30mm:22mm --out board.png        print it, measure it, fix it flat
  camera-node calibrate intrinsics pictures/ --board charuco:7x5:30mm:22mm --out lens.json
  camera-node calibrate rig pictures/ --board charuco:7x5:30mm:22mm --out rig.json
  camera-node calibrate hand-eye handeye/ --board chessboard:9x6:23.6mm     ViSP's layout: pictures and poses
  camera-node calibrate hand-eye --pairs samples.yaml --json                saved by MoveIt's panel
  camera-node calibrate hand-eye --live cell.yaml --camera cam00 --board charuco:7x5:30mm:22mm --out hand.yaml
"""

HAND_EYE = """Estimates the pose of a camera on the arm's flange ("hand"), T_EE^C of the thesis (4.2), or with
--eye-to-hand in the arm's base frame: by Tsai-Lenz, four other closed-form methods, and a joint refinement
that also estimates the arm's noise. Degenerate motions are refused with the reason.

input, one of:
  FOLDER         pictures NAME-3.png with NAME_3.yaml, the flange's pose (rows: 6, cols: 1, data: [tx ty tz and
                 theta u], meters and radians)
  --pairs FILE   pairs of flange in base and target in camera: a JSON list of two 4 x 4 each, or what MoveIt's panel or
                 easy_handeye saved
  --live SCENARIO --camera ID   guided session: move the arm, hold still; it says which poses are missing and
                 when there are enough. Flange poses come from the camera's source (without hand_eye)
"""

INTRINSICS = """Estimates a camera's intrinsics and their uncertainty from 10 to 20 pictures of a target, tilted and in
every corner: ten are enough if the target has been everywhere and tilted by 30 degrees between them.
"""

BOARD = "target: charuco:7x5:30mm:22mm[:4X4_50], chessboard:9x6:23.6mm (inner corners)"

# Of hand-eye: each input as its help names it, and option -> inputs that use it. With another input it is an error.
_INPUTS = {"folder": "FOLDER", "pairs": "--pairs FILE", "live": "--live SCENARIO"}
_GOES_WITH = {
    "board": ("folder", "live"),
    "lens": ("folder", "live"),
    "camera": ("live",),
    "data": ("live",),
    "seconds": ("live",),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fill in ``camera-node calibrate``."""
    parser.set_defaults(run=run)
    commands = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    _add_hand_eye(_command(commands, "hand-eye", "pose of a camera on the arm's flange", HAND_EYE))
    _add_intrinsics(_command(commands, "intrinsics", "a camera's intrinsics from pictures of a target", INTRINSICS))
    rig = _command(commands, "rig", "lenses and poses of several cameras that stand still", rig_command.DESCRIPTION)
    rig_command.add_arguments(rig, BOARD)
    add = _command(commands, "target", "write an image of a target, to print", "").add_argument
    add("board", metavar="SPEC", help="target, as in hand-eye --board")
    add("--out", type=Path, required=True, metavar="FILE.png", help="image to write")
    add("--dpi", type=float, default=300.0, help="dots per inch [%(default)g]")


def _command(commands: Any, name: str, summary: str, description: str) -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    made = commands.add_parser(name, help=summary, description=description, epilog=EXAMPLES, formatter_class=raw)
    assert isinstance(made, argparse.ArgumentParser)
    return made


def _add_hand_eye(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, nargs="?", metavar="FOLDER", help="pictures and flange poses, see above")
    add("--pairs", type=Path, metavar="FILE", help="pairs of poses, JSON or YAML")
    add("--board", metavar="SPEC", help=BOARD)
    lens = "intrinsics: calibration JSON or ViSP's XML [the folder's XML, the live camera's own]"
    add("--lens", type=Path, metavar="FILE", help=lens)
    add("--eye-to-hand", action="store_true", help="the camera stands still, the flange holds the target")
    add("--fit-size", action="store_true", help="take the target's size from the arm's motion, if it shows another")
    methods = "tsai, park, horaud, andreff, daniilidis or refined [%(default)s]"
    add("--method", default=DEFAULT_METHOD, metavar="NAME", help=methods)
    add("--json", action="store_true", help="print {transform, residual_mm, residual_deg, method, std_mm, std_deg}")
    out = "file to write, for source.arm.cameras or source.trajectory.hand_eye"
    add("--out", type=Path, metavar="FILE.yaml", help=out)
    add = parser.add_argument_group("guided session").add_argument
    add("--live", metavar="SCENARIO", help="take pictures with a camera of this scenario")
    add("--camera", metavar="ID", help="which of its cameras")
    add("--data", type=Path, metavar="DIR", help="folder of recorded data sets [$FRESHFIELD_DATA]")
    add("--seconds", type=float, metavar="S", help="end the session after S seconds")


def _add_intrinsics(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="pictures of the target")
    add("--board", required=True, metavar="SPEC", help=BOARD)
    add("--camera", default="cam00", metavar="ID", help="its name in the file [%(default)s]")
    out = "calibration JSON to write, as source kinds camera and video read it"
    add("--out", type=Path, metavar="FILE", help=out)
    add("--json", action="store_true", help="print the calibration as JSON, as --out writes it")


def run(args: argparse.Namespace) -> int:
    """Run a calibrate command and return its exit status. Raises CalibrationError."""
    try:
        import scipy  # noqa: F401
    except ImportError:
        raise CalibrationError("calibration needs scipy (pip install 'freshfield[calibrate]')") from None
    try:
        commands = {"hand-eye": _hand_eye, "intrinsics": _intrinsics, "rig": rig_command.run, "target": _target}
        return commands[args.what](args)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # nobody reads the output
        raise
    except (ValueError, OSError) as error:  # of a scenario, a file, a camera or an arm, in one line
        raise CalibrationError(str(error)) from None


def _hand_eye(args: argparse.Namespace) -> int:
    require_one_input(args, _INPUTS, _GOES_WITH)
    from camera_node.robot.calibration.hand_eye.calibrate import ALL_METHODS, calibrate
    from camera_node.robot.calibration.targets import parse_target

    if args.method not in ALL_METHODS:
        raise CalibrationError(f"--method: expected one of {', '.join(ALL_METHODS)}")
    board = None if args.board is None else parse_target(args.board)
    square_m = None if board is None else board.square_m
    found = calibrate(_samples(args, board), args.method, square_m, args.fit_size)
    if args.json:
        for warning in found.warnings:
            print(f"note: {warning}", file=sys.stderr)
    # Print first: the result is not lost if a file cannot be written.
    print(json.dumps(found.to_dict()) if args.json else found.show(), flush=True)
    if args.out is not None:
        found.write(args.out)
    return 0


def _samples(args: argparse.Namespace, board: Any) -> Any:
    from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
    from camera_node.robot.calibration import inputs
    from camera_node.robot.calibration.pose_pairs import read_pairs

    setup = EYE_TO_HAND if args.eye_to_hand else EYE_IN_HAND
    if args.pairs is not None:
        return read_pairs(args.pairs, setup)
    if board is None:
        raise CalibrationError("--board SPEC: say what the target is")
    lens = None if args.lens is None else inputs.read_lens(args.lens)
    if args.live is not None:
        from camera_node.robot.calibration.hand_eye.guided_session import live_samples

        if args.camera is None:
            raise CalibrationError("--camera ID: say which of the scenario's cameras")
        return live_samples(args, board, lens, setup)
    samples, unused = inputs.read_visp_folder(args.folder, board, lens, setup)
    for name, why in unused.items():
        print(f"{name}: {why}", file=sys.stderr)
    return samples


def _intrinsics(args: argparse.Namespace) -> int:
    from camera_node.robot.calibration import inputs
    from camera_node.robot.calibration.lens_calibration import calibrate_lens
    from camera_node.robot.calibration.targets import parse_target

    board = parse_target(args.board)
    found, unused, size = inputs.find_corners(inputs.list_images(args.folder), board)
    lens = calibrate_lens(found, size, unused)
    rig_command.show(args, lens.show(), lens.to_json(args.camera))
    return 0


def _target(args: argparse.Namespace) -> int:
    import cv2

    from camera_node.robot.calibration.targets import draw_for_print, parse_target

    board = parse_target(args.board)
    image = draw_for_print(board, args.dpi)
    out = str(args.out)
    if not (cv2.haveImageWriter(out) and cv2.imwrite(out, image)):
        raise CalibrationError(f"--out: {args.out} cannot be written (does its folder exist? .png?)")
    print(
        f"{args.out}: print it at {args.dpi:g} dpi without scaling; without its white border it must measure "
        f"{board.pattern_m[0] * 1e3:.1f} x {board.pattern_m[1] * 1e3:.1f} mm"
    )
    return 0
