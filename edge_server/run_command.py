"""The command ``edge-server run``: serves a scenario."""

from __future__ import annotations

import argparse
import logging
import signal
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from edge_server.command import command_parser, exit_status
from freshfield import transport
from freshfield.files import out_file, out_folder
from freshfield.scenario import ScenarioError, load
from freshfield.session import SessionError
from freshfield.transport import TransportError

if TYPE_CHECKING:
    from edge_server.live.server import OpenPage
    from edge_server.live.state import EdgeState


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    run = command_parser(
        "edge-server run", "Receive frames on --listen, keep the field up to date, show it on a web page."
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
    args = run.parse_args(argv)
    return exit_status(run.prog, lambda: _run(args), (ScenarioError, TransportError))


def _run(args: argparse.Namespace) -> None:
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


def _open_page(host: str, port: int, secure: transport.Transport, emulator: str | None, state: EdgeState) -> OpenPage:
    from edge_server.page import PageError, start_page  # the viewer is imported only where there is a page

    try:
        return start_page(state, host, port, secure, emulator)
    except PageError as error:
        raise TransportError(str(error)) from None


def _open_foxglove(port: int, state: EdgeState) -> OpenPage:
    from edge_server.page.foxglove_live import FoxgloveServer

    return FoxgloveServer(state, port)
