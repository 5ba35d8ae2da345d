"""Runs scenarios on this machine, writes and checks scenario files, tells what a machine lacks.

The programs of a deployment on several machines are commands of their own: camera-node, channel-emu and edge-server.
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from freshfield.scenario import ScenarioError
from freshfield_up import check_plugin, scenario_command
from freshfield_up.folder import FolderError
from freshfield_up.launcher import open_launcher
from freshfield_up.process_set import MissingCommand, Options

EXAMPLES = """examples:
  freshfield demo                              the default scenario for a minute, page on http://127.0.0.1:8080
  freshfield demo quad --for 5m --out runs/quad
  freshfield scenario list                     what ships
  freshfield scenario init mine.yaml --like quad
  freshfield scenario keys edge                what a section may say
  freshfield scenario check mine.yaml
  freshfield doctor mine.yaml                  what this machine lacks for it
  freshfield render runs/quad --orbit quad.mp4
  freshfield check-plugin policy mine.py:Mine  whether a class of your own keeps its contract
  freshfield warm-up                           compile the field's kernels before the first run
  freshfield completion bash > ~/.local/share/bash-completion/completions/freshfield

One program a machine: camera-node, channel-emu, edge-server; each has --help.
"""


# Commands of another program -> its module.
_ELSEWHERE = {"doctor": "camera_node.cli", "render": "edge_server.cli", "warm-up": "edge_server.cli"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 1 (a process died, or something is missing) or 2 (bad
    input)."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if words and words[0] in _ELSEWHERE:
            return int(importlib.import_module(_ELSEWHERE[words[0]]).main(words, prog="freshfield"))
        args = parser().parse_args(words)
        return int(args.run(args))
    except ImportError as error:
        print(f"freshfield: {error.name} is missing: pip install 'freshfield[edge]'", file=sys.stderr)
        return 2
    except BrokenPipeError:  # nobody reads the output
        raise
    except (ScenarioError, FolderError, MissingCommand, OSError) as error:
        print(f"freshfield: {error}", file=sys.stderr)
        return 2


def parser() -> argparse.ArgumentParser:
    """The parser of ``freshfield``."""
    found = argparse.ArgumentParser(
        prog="freshfield",
        description=__doc__.split("\n")[0],
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    found.add_argument("--version", action="version", version=f"freshfield {version('freshfield')}")
    commands = found.add_subparsers(metavar="COMMAND", required=True)
    demo = commands.add_parser(
        "demo",
        help="run a scenario on this machine: all its processes, the page, then a report",
        description="Starts every process of a scenario on this machine, shows its page and writes a report at the "
        "end. Ctrl-C, --for or the end of a replayed recording ends it. Exit status: 0 ended so, 1 a process died, "
        "2 it could not start.",
    )
    _add_demo_arguments(demo)
    scenario_command.add_arguments(
        commands.add_parser("scenario", help="list, show, start, check scenario files; their keys")
    )
    check = commands.add_parser(
        "check-plugin",
        help="check a source, policy, effect, fault, field or selector of your own",
        description="Checks that a class keeps the contract of its kind, one line a check: in usual and hard cases its "
        "answers have the right type, shape and finite values, are the same again for the same seed and leave the "
        "inputs as they were; parameters out of range are refused. Exit status: 0 it does, 1 not, 2 no such class.",
    )
    check_plugin.add_arguments(check)
    commands.add_parser("doctor", add_help=False, help="check this machine's part of a scenario (camera-node doctor)")
    commands.add_parser("render", add_help=False, help="images and videos of a run (edge-server render)")
    commands.add_parser("warm-up", add_help=False, help="compile the field's kernels (edge-server warm-up)")
    completion = commands.add_parser("completion", help="print a shell's completion of this command (needs shtab)")
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"))
    completion.set_defaults(run=_completion)
    return found


def _demo(args: argparse.Namespace) -> int:
    """Run the scenario and return the exit status. Raises ScenarioError, FolderError or MissingCommand where the run
    cannot start."""
    options = Options(args.out, args.duration_s, args.port, args.data, args.seed, args.policy)
    return open_launcher(args.scenario, options).run()


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


def _add_demo_arguments(parser: argparse.ArgumentParser) -> None:
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
    parser.set_defaults(run=_demo)


def _completion(args: argparse.Namespace) -> int:
    try:
        import shtab
    except ImportError:
        raise ScenarioError("completion needs the package shtab: pip install shtab") from None
    print(shtab.complete(parser(), shell=args.shell))
    return 0


if __name__ == "__main__":
    sys.exit(main())
