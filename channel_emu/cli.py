"""The ``channel-emu`` command."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from channel_emu import emulator_constants as tuned
from channel_emu.live.live_emulator_constants import PIECE_BYTES, RESEND_AFTER_S
from channel_emu.model import faults, notation
from channel_emu.model.link import DISCIPLINES, FITTED_DISCIPLINES
from channel_emu.model.presets import PRESETS
from channel_emu.model.settings import ChannelConfig, channel_from_mapping, from_notation
from freshfield import scenario, transport
from freshfield.files import format_table, out_file, out_folder

if TYPE_CHECKING:
    from channel_emu.live.proxy import Proxy, Report

DESCRIPTION = """\
Emulates a bad network between cameras and the edge server, per frame and from a random seed.
In the help of a command, [x] after an option is its default.

  channel-emu run room --listen 127.0.0.1:7001 --to 127.0.0.1:7000 --out runs/room --trace trace.jsonl
  channel-emu presets
  channel-emu simulate --preset ch6 --cameras 18 --seconds 600
  channel-emu simulate --preset gilbert-elliott --csv frames.csv
  channel-emu simulate --arrivals poisson:1/60ms --service exp:30ms --discipline lcfs-preempt
  channel-emu proxy --preset ch5 --to localhost:50051 --listen 127.0.0.1:50052 --seed 1
  channel-emu fit trace.jsonl --plot fit.png --out fitted.yaml
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line. argv: arguments without the program's name; None: those of the process.

    Returns the exit status: 0; 1 if the live emulator failed; 2 for bad input. KeyboardInterrupt and BrokenPipeError
    are for ``freshfield_up.console``.
    """
    parser = argparse.ArgumentParser(
        prog="channel-emu", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (_add_run, _add_simulate, _add_presets, _add_proxy, _add_fit):
        add(commands)
    args = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
    try:
        if "to" in args:
            args.to = transport.peer("--to", args.to)
        return args.go(args)
    except BrokenPipeError:  # nobody reads the output
        raise
    # ValueError: a scenario, its notation, a transport option, a trace. OSError: a path, an address.
    except (ValueError, OSError) as error:
        print(f"channel-emu: {error}", file=sys.stderr)
        return 2


def _add_run(commands: Any) -> None:
    sub = commands.add_parser(
        "run",
        help="the live emulator: cameras connect to it, it connects to the edge server",
        description="Delays, drops and damages each camera's frames as the scenario's channel section says. "
        "Writes OUT/channel.json twice a second and a ledger of every frame; ends cleanly on Ctrl-C.",
    )
    sub.add_argument("scenario", help="scenario file, or the name of a shipped one")
    sub.add_argument(
        "--to", default="127.0.0.1:7000", metavar="HOST:PORT", help="address of the edge server [%(default)s]"
    )
    sub.add_argument(
        "--out", type=out_folder, required=True, metavar="DIR", help="folder to write: channel.json and the ledger"
    )
    sub.add_argument("--seed", type=int, metavar="N", help="random seed, in place of the scenario's")
    _add_live_options(sub, "frame")
    sub.set_defaults(go=_run)


def _run(args: argparse.Namespace) -> int:
    from channel_emu.live.frame_proxy import FrameProxy

    plan = scenario.load(args.scenario, args.seed)
    config = channel_from_mapping(plan.channel, f"{plan.path}: channel", plan.path.parent, plan.cameras)
    return _serve(args, partial(FrameProxy, cameras=plan.cameras, out=args.out), config, plan.seed)[0]


def _add_live_options(sub: argparse.ArgumentParser, what: str) -> None:
    """Add the options of both live commands, which ``_serve`` reads. what: unit that passes the link."""
    sub.add_argument(
        "--listen", default="127.0.0.1:7001", metavar="HOST:PORT", help="address to accept clients on [%(default)s]"
    )
    sub.add_argument("--trace", type=out_file, metavar="FILE", help=f"record the fate of every {what} in FILE")
    sub.add_argument("--replay", type=Path, metavar="FILE", help="repeat the decisions of a recorded --trace")
    transport.add_arguments(sub)


def _serve(
    args: argparse.Namespace, make: Callable[..., Proxy], config: ChannelConfig, seed: int, **options: Any
) -> tuple[int, Report | None]:
    """Run the proxy that ``make`` returns until SIGINT or SIGTERM. Returns the exit status, and the report if nothing
    failed."""
    from channel_emu.live.live_emulator_constants import SWITCH_INTERVAL_S
    from channel_emu.live.priority import raise_priority, return_freed_memory
    from channel_emu.live.proxy import EmulatorFailed, ProxyOptions
    from channel_emu.model import trace

    if args.trace and args.replay and args.trace.resolve() == args.replay.resolve():
        raise ValueError(f"--trace {args.trace}: would overwrite what --replay reads: name another file")
    chosen = ProxyOptions(
        args.listen,
        args.to,
        transport.from_arguments(args),
        trace=args.trace,
        replay=trace.read(args.replay) if args.replay else None,
        **options,
    )
    logging.getLogger("channel-emu").info("scheduling priority: %s", raise_priority())
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    return_freed_memory()

    async def live() -> Report:
        stop = asyncio.Event()
        for name in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(name, stop.set)
        return await make(config, seed, chosen).run(stop)

    try:
        return 0, asyncio.run(live())
    except EmulatorFailed as error:
        print(f"channel-emu: {error}", file=sys.stderr)
        return 1, None


def _add_simulate(commands: Any) -> None:
    sub = commands.add_parser(
        "simulate",
        help="the same links in virtual time: ages and losses of a channel",
        description="Simulates every camera's link and prints mean age (continuous time average), peak "
        "age, frames delivered and dropped, time shares of the states, and delays.",
    )
    _add_channel_options(sub)
    sub.add_argument("--cameras", type=int, metavar="N", help="number of cameras [the scenario's, else 1]")
    sub.add_argument("--seconds", type=float, default=600.0, metavar="S", help="seconds to simulate [%(default)g]")
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="random seed [%(default)s]")
    sub.add_argument(
        "--frame-period-ms",
        type=float,
        metavar="MS",
        help="frame period of the cameras; Poisson arrivals then sample their newest frame, as live",
    )
    sub.add_argument(
        "--frame-bytes",
        type=int,
        default=tuned.FRAME_BYTES,
        metavar="N",
        help="size of a frame, for bandwidth [%(default)s]",
    )
    sub.add_argument(
        "--csv",
        type=out_file,
        metavar="FILE",
        help="write a row per frame, when offered and delivered, as fit reads it",
    )
    sub.add_argument("--json", action="store_true", help="print the result as one JSON object")
    sub.set_defaults(go=_simulate)


def _add_channel_options(sub: argparse.ArgumentParser) -> None:
    """Add the options that describe a channel, which ``_config_of`` reads."""
    source = sub.add_mutually_exclusive_group()
    source.add_argument(
        "--preset",
        default="ideal",
        metavar="NAME",
        help="channel, one that channel-emu presets lists; the options below change it [%(default)s]",
    )
    source.add_argument("--scenario", help="the channel section of a scenario instead")
    specifications = {
        "arrivals": "when frames arrive: as-offered, periodic:30ms, poisson:1/30ms, or a rate for each state, "
        "mmpp:1/120ms,1/30ms; mmpp alone takes these rates (thesis 6.4.2)",
        "service": "delay: none, exp:60ms, det:10ms, gamma:60ms:SHAPE, lognormal:60ms:SIGMA, trace:FILE; a mean for "
        "each state: exp:30ms,exp:60ms",
        "chain": "Markov chain of two states: mu1=1/30,mu2=1/30 (rates per ms), states=low/high, scope=per-camera, "
        "initial=low; more states in a scenario",
    }
    for name, text in specifications.items():
        sub.add_argument(f"--{name}", metavar="SPEC", help=text)
    sub.add_argument(
        "--fault",
        metavar="NAME:VALUE",
        action="append",
        help=f"{', '.join(faults.NAMES)}; e.g. loss:0.1, loss:[0.01, 0.5] by state, reset:{{at_ms: [50]}}; "
        "may be repeated",
    )
    sub.add_argument(
        "--service-state",
        choices=["at-start", "modulated"],
        help="state that sets a delay: at the start of transmission, or each during it [at-start]",
    )
    sub.add_argument(
        "--discipline", choices=DISCIPLINES, help="what a busy link does with a new frame [the preset's, else drop-new]"
    )


def _simulate(args: argparse.Namespace) -> int:
    from channel_emu.virtual.simulate import OUTCOMES, simulate

    config, count = _config_of(args), args.cameras
    if count is None:
        count = list(scenario.load(args.scenario).cameras) if args.scenario else 1
    simulation = simulate(
        config, count, args.seconds, args.seed, frame_period_ms=args.frame_period_ms, frame_bytes=args.frame_bytes
    )
    result = simulation.summary()
    if args.csv:
        simulation.write_frames(args.csv)
    if args.json:
        print(json.dumps(result))
        return 0
    shown = {
        "mean age (ms)": result["mean_age_ms"],
        "peak age (ms)": result["peak_age_ms"],
        **{f"drawn delay, {name} (ms)": value for name, value in result["delay_ms"].items()},
        **{key: result[key] for key in ("offered", *OUTCOMES, "in_flight", "duplicated", "corrupted") if result[key]},
        **{f"share of state {name}": share for name, share in result["state_share"].items() if share < 1},
        **{key: result[key] for key in ("cameras", "seconds", "seed")},
    }
    print(format_table([{"what": k, "value": "-" if v is None else v} for k, v in shown.items()]))
    return 0


def _config_of(args: argparse.Namespace) -> ChannelConfig:
    """The channel that the options of ``_add_channel_options`` describe; they override the preset or the
    scenario's section."""
    section: dict[str, Any] = {"preset": args.preset}
    folder = Path()
    if args.scenario:
        plan = scenario.load(args.scenario)
        section, folder = dict(plan.channel), plan.path.parent
    for key in ("arrivals", "service", "chain", "service_state", "discipline"):
        if value := vars(args)[key]:
            section[key] = from_notation(key, value)
    if args.fault:
        section["faults"] = dict(section.get("faults") or {})
        for text in args.fault:
            section["faults"] |= notation.fault(text)
    return channel_from_mapping(section, "channel", folder)


def _add_presets(commands: Any) -> None:
    sub = commands.add_parser(
        "presets",
        help="list the named channels, with their parameters and mean delay",
        description="Lists the presets: parameters, written as simulate's options and a scenario take them; "
        "the mean delay over the stationary distribution of the states; what each is for.",
    )
    sub.set_defaults(go=_presets)


def _presets(_: argparse.Namespace) -> int:
    parts = ("arrivals", "service", "chain", "discipline", "faults")
    rows: list[dict[str, Any]] = []
    for name, (_about, channel) in PRESETS.items():
        mean_ms = channel_from_mapping({"preset": name}).mean_delay_ms
        shown = {part: "" if part not in channel else str(channel[part]).replace("'", "") for part in parts}
        rows.append({"preset": name, "mean_delay_ms": mean_ms, **shown})
    print(format_table(rows) + "\n")
    print(format_table([{"preset": name, "what it is": preset.about} for name, preset in PRESETS.items()]))
    return 0


def _add_proxy(commands: Any) -> None:
    sub = commands.add_parser(
        "proxy",
        help="put any gRPC service, or any TCP port, behind an emulated link; messages are not parsed",
        description="Clients connect to LISTEN instead of the service at TO. A dropped unary call answers "
        "UNAVAILABLE, a dropped stream message is left out. Prints what happened on Ctrl-C. In tests, use "
        "the pytest fixture of channel_emu.testing.",
    )
    sub.add_argument("--to", required=True, metavar="HOST:PORT", help="address of the service")
    _add_channel_options(sub)
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="random seed [%(default)s]")
    sub.add_argument(
        "--direction",
        choices=["up", "down", "both"],
        default="up",
        help="messages that pass the link: to the service (up), its answers (down) or both [%(default)s]",
    )
    sub.add_argument(
        "--tcp",
        action="store_true",
        help=f"any protocol over TCP, in pieces of {PIECE_BYTES >> 10} kB, in order: "
        f"a piece that is lost is sent again after {1000 * RESEND_AFTER_S:g} ms",
    )
    _add_live_options(sub, "message")
    sub.add_argument("--json", action="store_true", help="print the result as one JSON object")
    sub.set_defaults(go=_proxy)


def _proxy(args: argparse.Namespace) -> int:
    from channel_emu.live.proxy import Proxy
    from channel_emu.live.report import show

    config = _config_of(args)
    proxy: Callable[..., Proxy] = Proxy
    if args.tcp:
        from channel_emu.live.tcp_proxy import TcpProxy as proxy
    status, report = _serve(args, proxy, config, args.seed, direction=args.direction)
    if report is not None:
        print(json.dumps(report.plain()) if args.json else show(report))
    return status


def _add_fit(commands: Any) -> None:
    sub = commands.add_parser(
        "fit",
        help="estimate a channel from a recording: chain, delays, losses, with 95 %% intervals",
        description="Fits a channel with one or two hidden states to a trace of this emulator (its recorded "
        "states are not used) or to a CSV of any link with columns offered_ms, delivered_ms (blank: lost), "
        "camera. Prints the channel section for a scenario.",
    )
    sub.add_argument("trace", type=Path, help="file written by --trace, or a CSV")
    sub.add_argument(
        "--states",
        choices=["1", "2", "auto"],
        default="auto",
        help="number of hidden states; auto: chosen by BIC [%(default)s]",
    )
    sub.add_argument(
        "--discipline", choices=FITTED_DISCIPLINES, help="for a CSV: what the busy link did with a new frame [drop-new]"
    )
    sub.add_argument("--out", type=out_file, metavar="FILE.yaml", help="write a scenario with the fitted channel")
    sub.add_argument("--plot", type=out_file, metavar="FILE", help="write a figure: delays over time and the state")
    sub.add_argument("--json", action="store_true", help="print the result as one JSON object")
    sub.set_defaults(go=_fit)


def _fit(args: argparse.Namespace) -> int:
    from channel_emu.estimate import report
    from channel_emu.estimate.fit import fit

    result = fit(args.trace, args.states, discipline=args.discipline)
    if args.out:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(report.scenario_text(result))
    if args.plot:
        report.plot(result, args.plot)
    print(json.dumps(result.summary()) if args.json else report.format_fit(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
