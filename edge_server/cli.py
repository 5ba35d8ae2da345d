"""The ``edge-server`` command."""

from __future__ import annotations

import argparse
import importlib
import logging
import signal
import sys
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from freshfield import transport
from freshfield.files import out_file, out_folder
from freshfield.scenario import ScenarioError, load
from freshfield.session import SessionError
from freshfield.transport import TransportError

if TYPE_CHECKING:
    from edge_server.live.server import OpenPage
    from edge_server.live.state import EdgeState

DESCRIPTION = """\
The edge server of freshfield: takes posed frames, keeps a radiance field up to date, shows and measures it.
In the help of a command, [x] after an option is its default.

  edge-server run room --listen 127.0.0.1:7000 --page-port 8080 --out runs/room
  edge-server run room --out runs/room --record runs/room/session.mcap
  edge-server fit ~/data/lego --field ngp --seconds 60 --holdout 8 --scale 2 --out runs/lego
  edge-server frontier --quick --out runs/frontier
  edge-server simulate room --seconds 10
  edge-server compare card all threshold:120 --seeds 8
  edge-server viewpoints tile --budget 8
  edge-server study mat --quick --out runs/study
  edge-server report runs/room
  edge-server report runs/a --beside runs/b
  edge-server explain runs/room --decision 12
  edge-server export runs/room --mesh room.ply
  edge-server render runs/room --orbit room.mp4
"""


def main(argv: Sequence[str] | None = None, prog: str = "edge-server") -> int:
    """Run the command line; returns the exit status: 0, 1 (it failed while running) or 2 (bad input). KeyboardInterrupt
    and BrokenPipeError are for ``freshfield_up.console``. prog: name of the command in usage and errors."""
    parser = argparse.ArgumentParser(
        prog=prog, description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(commands)
    _add_report(commands)
    for name, (_, line) in _COMMANDS.items():
        commands.add_parser(name, help=line, add_help=False)
    words = list(sys.argv[1:] if argv is None else argv)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
    try:
        if words and words[0] in _COMMANDS:
            command = importlib.import_module(f"edge_server.{_COMMANDS[words[0]][0]}").main
            more = (f"{prog} render",) if words[0] == "render" else ()
            return int(command(words[1:], *more))
        args = parser.parse_args(words)
        return args.run(args)
    except BrokenPipeError:  # nobody reads the output
        raise
    except (ScenarioError, TransportError, OSError) as error:  # OSError: of a file or folder
        print(f"{prog}: {error}", file=sys.stderr)
        return 2


# Commands with options and a main of their own, imported only when called: command -> (module, help).
_COMMANDS = {
    "fit": (
        "experiments.fitting.fit_command",
        "fit a recorded data set without a network and report fidelity over time",
    ),
    "frontier": (
        "experiments.frontier.frontier_command",
        "sweep the time of fits and updates, plot fidelity against seconds",
    ),
    "train-scheduler": (
        "experiments.training.train_command",
        "learn when to update the field and from which views, rewarded by real field fits",
    ),
    "compare": ("experiments.compare", "compare what policies show in a scenario, over seeds, with intervals"),
    "simulate": (
        "experiments.virtual.simulate",
        "run a scenario's whole deployment in virtual time, reproducible bit for bit",
    ),
    "warm-up": ("fields.warm_up_command", "compile a field's kernels, so that the first run starts at once"),
    "costs": (
        "experiments.virtual.costs",
        "measure the time that a scenario's updates take on this machine, for virtual time",
    ),
    "viewpoints": (
        "experiments.viewpoints.viewpoints_command",
        "choose where a camera goes next around an object, within a budget of views or meters",
    ),
    "study": ("experiments.studies.study_command", "reproduce the thesis's figures, each with a verdict"),
    "explain": ("report.explain_command", "explain a policy's decision: shares of state parts, cameras, image regions"),
    "export": ("export.export_command", "write a run's mesh, splats, points and cameras as files for other programs"),
    "render": ("export.render_command", "render images and videos of a run from new viewpoints"),
    "keys": ("live.keys_command", "make a development CA, certificates and tokens for a scenario's processes"),
    "fetch-lpips": ("fidelity.fetch_lpips", "fetch LPIPS weights with the public package and convert them for --lpips"),
}


def _add_run(commands: argparse._SubParsersAction) -> None:
    run = commands.add_parser(
        "run",
        help="serve a scenario: receive its frames, update the field, show it",
        description="Receive frames on --listen, keep the field up to date, show it on a web page.",
    )
    run.add_argument("scenario", help="scenario file, or the name of a shipped one")
    run.add_argument(
        "--listen", default="127.0.0.1:7000", metavar="HOST:PORT", help="address to receive frames on [%(default)s]"
    )
    run.add_argument("--page-port", type=int, metavar="PORT", help="serve the live page on this port [no page]")
    run.add_argument(
        "--page-host", default="127.0.0.1", metavar="HOST", help="address of the page and the metrics [%(default)s]"
    )
    run.add_argument("--metrics-port", type=int, metavar="PORT", help="serve Prometheus metrics on this port [none]")
    run.add_argument(
        "--foxglove-port",
        type=int,
        metavar="PORT",
        help="serve Foxglove on this port of 127.0.0.1, without a login [none]",
    )
    run.add_argument("--out", type=out_folder, default="runs/edge", metavar="DIR", help="folder to write [%(default)s]")
    run.add_argument(
        "--emulator-out",
        type=Path,
        metavar="DIR",
        help="--out of channel-emu run: the page shows its channel state [this --out]",
    )
    run.add_argument(
        "--emulator",
        metavar="HOST:PORT",
        help="--listen of channel-emu run: visitors of the page may change the network [they may not]",
    )
    run.add_argument("--seed", type=int, metavar="N", help="random seed, in place of the scenario's")
    run.add_argument(
        "--policy",
        metavar="NAME[:VALUE]",
        help="in place of the scenario's: all, threshold:120, bandit:FILE, FILE.py:CLASS (docs/scheduling.md)",
    )
    run.add_argument(
        "--lpips",
        type=Path,
        metavar="DIR",
        help="folder of LPIPS weights [$FRESHFIELD_LPIPS, else lpips/ in the data folder]",
    )
    run.add_argument(
        "--data", type=Path, metavar="DIR", help="folder of data sets; only its lpips/ is read [$FRESHFIELD_DATA]"
    )
    run.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="start from a checkpoint of an earlier run; OUT/field.npz, which this run writes, may not be there yet",
    )
    run.add_argument(
        "--checkpoint-every", type=float, metavar="S", help="write OUT/field.npz every S seconds [only at the end]"
    )
    run.add_argument(
        "--record",
        type=lambda text: out_file(text) if text.lower().endswith(".mcap") else out_folder(text),
        metavar="FILE",
        help="write the session: FILE.mcap to view or replay (source kind mcap); else a ROS 2 bag, a folder",
    )
    run.add_argument("--seconds", type=float, metavar="S", help="end after S seconds [on Ctrl-C]")
    transport.add_arguments(run)
    run.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    from edge_server.fidelity.lpips_weights import weights_folder
    from edge_server.live.server import EdgeServer, ServerOptions
    from edge_server.scheduler import parse_policy
    from edge_server.settings import PolicyConfig, read_config

    for option, seconds in (("seconds", args.seconds), ("checkpoint-every", args.checkpoint_every)):
        if seconds is not None and not 0.0 <= seconds <= 1e9:  # a timer's most is 9.2e9
            raise ScenarioError(f"--{option} {seconds:g}: expected 0 to 1e+09")
    scenario = load(args.scenario, args.seed)
    config = read_config(scenario)
    if args.policy:
        try:
            config = replace(config, policy=PolicyConfig(*parse_policy(args.policy)))
        except ValueError as error:
            raise ScenarioError(f"--policy {error}") from None
    secure = transport.from_arguments(args)
    emulator = args.emulator and transport.peer("--emulator", args.emulator)
    if args.foxglove_port is not None and (secure.tokens or secure.ca is not None):
        raise ScenarioError("--foxglove-port knows no login: leave it out, or run without credentials")
    own = args.out / "field.npz"
    if args.resume == own and not own.exists():
        logging.getLogger("edge-server").info("%s: not there yet: the field begins anew", own)
        args.resume = None
    open_page = partial(_open_page, args.page_host, args.page_port, secure, emulator)
    options = ServerOptions(
        listen=args.listen,
        out=args.out,
        emulator_out=args.emulator_out,
        transport=secure,
        page_host=args.page_host,
        open_page=None if args.page_port is None else open_page,
        open_foxglove=None if args.foxglove_port is None else partial(_open_foxglove, args.foxglove_port),
        metrics_port=args.metrics_port,
        lpips_folder=weights_folder(args.lpips, args.data),
        resume=args.resume,
        checkpoint_s=args.checkpoint_every,
        record=args.record,
    )
    try:
        server = EdgeServer(scenario, config, options)
    except SessionError as error:
        raise ScenarioError(f"--record: {error}") from None
    except ScenarioError:
        raise
    except ValueError as error:  # field options, a checkpoint that does not fit: the message says what
        raise ScenarioError(f"{scenario.path}: {error}") from None
    # A shell starts what a script puts in its background with SIGINT ignored; nohup means SIGHUP alone.
    hangs_up = signal.getsignal(signal.SIGHUP) != signal.SIG_IGN
    for number in (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hangs_up else [])):
        signal.signal(number, lambda *_: server.stop())
    if args.seconds is not None:
        timer = threading.Timer(args.seconds, server.stop)
        timer.daemon = True
        timer.start()
    server.run()
    return 0


def _open_page(host: str, port: int, secure: transport.Transport, emulator: str | None, state: EdgeState) -> OpenPage:
    from edge_server.page import PageError, start_page  # the viewer is imported only where there is a page

    try:
        return start_page(state, host, port, secure, emulator)
    except PageError as error:
        raise TransportError(str(error)) from None


def _open_foxglove(port: int, state: EdgeState) -> OpenPage:
    from edge_server.page.foxglove_live import FoxgloveServer

    return FoxgloveServer(state, port)


def _add_report(commands: argparse._SubParsersAction) -> None:
    report = commands.add_parser(
        "report",
        help="join the ledgers of all processes and write report.json, report.html and figures",
        description="Write DIR/report.json, DIR/report.html and figures from what a run left in DIR.",
    )
    report.add_argument("directory", type=Path, metavar="DIR", help="folder of a run or fit (its --out)")
    report.add_argument("--beside", type=Path, metavar="DIR", help="print its figures beside those of this other run")
    report.set_defaults(run=_report)


def _report(args: argparse.Namespace) -> int:
    from edge_server.report.build_report import build_report

    runs = [args.directory] if args.beside is None else [args.directory, args.beside]
    left = ("ledger-*.tsv", "series.jsonl", "edge.json", "run.json")
    for run in runs:
        if not run.is_dir():
            raise ScenarioError(f"{run}: no such folder")
        if not any(path for pattern in left for path in run.glob(pattern)):
            raise ScenarioError(f"{run}: holds none of {', '.join(left)}: name the folder of a run or fit (its --out)")
    reports = [build_report(run) for run in runs]
    if args.beside is not None:
        from edge_server.report.side_by_side import side_by_side

        print(side_by_side({str(run): report for run, report in zip(runs, reports)}))
    print(args.directory / "report.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
