"""``freshfield demo``: starts every process of a scenario on this machine, supervises them, and writes the report.

It starts the three commands that otherwise run by hand on separate machines: camera-node, channel-emu and
edge-server. Ctrl-C, SIGTERM, a closed terminal or the end of --for stops them in the order of the data. Exit code: 0
for a run that ended as asked, 1 if a process died, 2 if the run could not start.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from freshfield_up.deployment import open_launcher


def run(args: argparse.Namespace) -> int:
    """Run the scenario and return the exit status. Raises ScenarioError, FolderError or MissingCommand where the run
    cannot start."""
    return open_launcher(args.scenario, args.out, args.duration_s, args.port, args.data, args.seed, args.policy).run()


def seconds(text: str) -> float:
    """``90``, ``90s``, ``1.5m``, ``2h``; 0 means no end."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|m|min|h|)", text.strip())
    if not found:
        raise argparse.ArgumentTypeError(f"expected a time such as 60s, 5m or 0 (no end), got {text!r}")
    return float(found[1]) * {"": 1, "s": 1, "m": 60, "min": 60, "h": 3600}[found[2]]


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"expected a port from 1 to 65535, got {text!r}")
    return int(text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``freshfield demo``."""
    add = parser.add_argument
    add(
        "scenario",
        nargs="?",
        default="card",
        help="scenario file, or the name of a shipped one (freshfield scenario list) [%(default)s]",
    )
    add(
        "--for",
        dest="duration_s",
        type=seconds,
        default=60.0,
        metavar="TIME",
        help="end after this long: 90s, 5m, 2h; 0: on Ctrl-C [60s]",
    )
    add(
        "--out",
        type=Path,
        default=Path("runs/demo"),
        metavar="DIR",
        help="folder to write; replaces an earlier run in it [%(default)s]",
    )
    add("--port", type=_port, default=8080, help="port of the page on 127.0.0.1 [%(default)s]")
    add("--data", type=Path, metavar="DIR", help="folder of recorded data sets [$FRESHFIELD_DATA]")
    add("--seed", type=int, metavar="N", help="random seed, in place of the scenario's")
    add(
        "--policy",
        metavar="NAME[:VALUE]",
        help="in place of the scenario's: all, threshold:120, bandit:FILE, FILE.py:CLASS (docs/scheduling.md)",
    )
    parser.set_defaults(run=run)
