"""The commands of ``camera-node``: run the cameras of a scenario, calibrate them, check a setup, and more."""

from __future__ import annotations

import argparse
import asyncio
import logging
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from camera_node.robot import arm_cli
from camera_node.robot.calibration import CalibrationError, calibrate_command
from freshfield import transport
from freshfield.files import out_folder
from freshfield.scenario import Scenario, ScenarioError, load, parse

if TYPE_CHECKING:
    from camera_node.capture import Camera

EXAMPLES = """examples:
  camera-node run room --all --to 127.0.0.1:7001             every camera of the shipped scenario "room"
  camera-node run room.yaml --camera cam03 --to emu:7001     one camera, e.g. on its own machine
  camera-node run fox --all --to :7001 --data ~/data         recorded data, from the folder --data
  camera-node run bag/ --as hand --to :7001                  a ROS bag or other recording, as camera "hand"
  camera-node calibrate hand-eye --help                      pose of a camera on an arm
  camera-node simulate-arm cell                              a simulated arm for the scenario "cell"
  camera-node drive-arm cell                                 move its camera around the target
  camera-node teleop cell --stylus keyboard                  an operator moves it; or network:PORT
  camera-node devices                                        cameras that are plugged in
  camera-node doctor cell                                    what is missing on this machine

In the help of a command, [x] after an option is its default.

exit codes: 0 stopped as asked, 1 failed while running or no frame was taken, 2 wrong scenario, option or data
"""


class UsageError(Exception):
    """A mistake in how the command was called; shown as one line."""


def main(arguments: list[str] | None = None, prog: str = "camera-node") -> int:
    """Run a command and return its exit status. prog: name of the program in usage and errors."""
    parser = argparse.ArgumentParser(
        prog=prog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EXAMPLES,
        description="Streams timestamped, posed frames of one or several cameras to the next hop.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(commands)
    calibrate_command.add_arguments(commands.add_parser("calibrate", help="hand-eye and intrinsic calibration"))
    devices = commands.add_parser(
        "devices",
        help="list the cameras that are plugged in",
        description="Lists the cameras that are plugged in: the kind of source, and what to write as source.devices. "
        "To use videos of fixed cameras instead: freshfield scenario init FILE.yaml --like videos",
    )
    devices.set_defaults(run=_devices)
    arm_cli.add_commands(commands)
    _add_doctor(commands)
    args = parser.parse_args(arguments)
    try:
        return int(args.run(args))
    except (UsageError, CalibrationError, ScenarioError, transport.TransportError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2


def _add_run(commands: Any) -> None:
    raw = argparse.RawDescriptionHelpFormatter
    run = commands.add_parser("run", help="stream cameras of a scenario", epilog=EXAMPLES, formatter_class=raw)
    run.set_defaults(run=_run)
    run.add_argument("scenario", help="scenario file, or the name of a shipped one")
    add = run.add_mutually_exclusive_group(required=True).add_argument
    add("--camera", metavar="ID[,ID]", help="cameras of the scenario to stream")
    add("--camera-index", type=int, metavar="N", help="the camera of this number in the scenario, from 0 (of a pod)")
    add("--all", action="store_true", help="all cameras of the scenario")
    names = (
        "play a recording or data set instead of a scenario: its camera NAME [the only one] as camera ID; "
        "no camera is held out: use a scenario with cameras.held_out for that (docs/data.md)"
    )
    add("--as", dest="names", metavar="ID[=NAME][,...]", help=names)
    add = run.add_argument
    add("--data", type=Path, metavar="DIR", help="folder of recorded data sets [$FRESHFIELD_DATA]")
    add("--seed", type=int, metavar="N", help="random seed, instead of the scenario's")
    add("--to", required=True, metavar="HOST:PORT", help="address of the channel emulator or edge server")
    add("--out", type=out_folder, metavar="DIR", help="folder to write the ledger and status file to [not written]")
    add("--seconds", type=float, metavar="S", help="end after S seconds of capture [on Ctrl-C]")
    add("-q", "--quiet", action="store_true", help="print only warnings")
    transport.add_arguments(run, listens=False)


def _add_doctor(commands: Any) -> None:
    doctor = commands.add_parser(
        "doctor",
        help="check this machine's part of a setup: what is wrong, and how to fix it",
        description="Checks one by one the packages, cameras, arm, clock, network, disk and files "
        "that a scenario needs on this machine. Moves nothing. Exit code 1 if something is wrong.",
    )
    doctor.set_defaults(run=_doctor)
    add = doctor.add_argument
    scenario = "scenario file, or the name of a shipped one [check what every scenario needs]"
    add("scenario", nargs="?", help=scenario)
    add("--to", metavar="HOST:PORT", help="address of the channel emulator or edge server")
    add("--data", type=Path, metavar="DIR", help="folder of recorded data sets [$FRESHFIELD_DATA]")
    runs = "folder that runs will be written to [%(default)s]"
    add("--out", type=Path, default=Path("runs"), metavar="DIR", help=runs)
    plan = "draw the coverage of fixed cameras, and where one more helps most"
    add("--plan", type=Path, metavar="FILE.svg", help=plan)
    add("--json", action="store_true", help="print the result as one JSON object")
    transport.add_arguments(doctor, listens=False)


def _open(args: argparse.Namespace) -> tuple[Scenario, list[Camera]]:
    """The scenario and the chosen cameras, opened. Raises UsageError or ScenarioError."""
    from camera_node.capture import build_cameras
    from camera_node.settings import source_config

    arm_cli.log_to_stderr(logging.WARNING if args.quiet else logging.INFO)
    names, file = args.names, args.scenario
    try:
        scenario = load(file, args.seed) if names is None else _recording(Path(file), names, args.seed)
        chosen = scenario.cameras if names is not None else _chosen(scenario, args)
        cameras = build_cameras(scenario, source_config(scenario), chosen, args.data)
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from None
    return scenario, cameras


def _recording(path: Path, names: str, seed: int | None) -> Scenario:
    """The scenario that plays a recording or data set. names: as for --as. Raises UsageError or DatasetError."""
    from camera_node.sources.datasets.formats import find_format

    pairs = [pair.strip().partition("=") for pair in names.split(",")]
    assignment = {camera: name for camera, _, name in pairs if name}
    source = {"kind": find_format(path), "data": str(path.resolve()), "assignment": assignment}
    try:
        return parse({"cameras": {"ids": [camera for camera, *_ in pairs]}, "source": source}, path, seed)
    except ScenarioError as error:
        raise UsageError(f"--as {names}: {error}") from None


def _devices(_: argparse.Namespace) -> int:
    from camera_node.sources.devices.connected import connected

    for kind, device in connected():
        print(f"{kind:10} {device.serial or '-':24} {device.about}")
    return 0


def _doctor(args: argparse.Namespace) -> int:
    from camera_node.doctor import doctor_command

    return doctor_command.run(args)


def _run(args: argparse.Namespace) -> int:
    from camera_node.node import Node, NodeOptions

    # Written so that it refuses NaN, too.
    if args.seconds is not None and not args.seconds > 0:
        raise UsageError("--seconds: expected a positive number")
    options = NodeOptions(
        to=transport.peer("--to", args.to), transport=transport.from_arguments(args), out=args.out, seconds=args.seconds
    )
    scenario, cameras = _open(args)

    async def live() -> str | None:
        node = Node(scenario, cameras, options)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, node.stop)
        await node.run()
        return node.failure()

    try:
        failure = asyncio.run(live())
    except (OSError, RuntimeError) as error:
        failure = str(error)
    if failure is not None:
        print(f"camera-node: {failure}", file=sys.stderr)
    return 0 if failure is None else 1


def _chosen(scenario: Scenario, args: argparse.Namespace) -> tuple[str, ...]:
    if args.camera_index is not None:
        if not 0 <= args.camera_index < len(scenario.cameras):
            raise UsageError(f"--camera-index {args.camera_index}: expected 0 to {len(scenario.cameras) - 1}")
        return (scenario.cameras[args.camera_index],)
    if args.all:
        return scenario.cameras
    chosen = tuple(dict.fromkeys(c.strip() for c in args.camera.split(",") if c.strip()))
    unknown = [c for c in chosen if c not in scenario.cameras]
    if unknown or not chosen:
        raise UsageError(
            f"--camera: {scenario.path} has no camera {', '.join(unknown) or 'of no name'}; "
            f"it has {', '.join(scenario.cameras)}"
        )
    return chosen


if __name__ == "__main__":
    sys.exit(main())
