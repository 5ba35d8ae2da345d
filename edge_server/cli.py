"""The ``edge-server`` command."""

from __future__ import annotations

import argparse
import importlib
import logging
import sys
from collections.abc import Sequence

from freshfield.scenario import ScenarioError
from freshfield.transport import TransportError

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
    for name, (_, line) in _COMMANDS.items():
        commands.add_parser(name, help=line, add_help=False)
    words = list(sys.argv[1:] if argv is None else argv)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
    try:
        if words and words[0] in _COMMANDS:
            command = importlib.import_module(f"edge_server.{_COMMANDS[words[0]][0]}").main
            more = (f"{prog} render",) if words[0] == "render" else ()
            return int(command(words[1:], *more))
        parser.parse_args(words)
        return 0
    except BrokenPipeError:  # nobody reads the output
        raise
    except (ScenarioError, TransportError, OSError) as error:  # OSError: of a file or folder
        print(f"{prog}: {error}", file=sys.stderr)
        return 2


# Commands, each imported only when called: command -> (module, help).
_COMMANDS = {
    "run": ("run_command", "serve a scenario: receive its frames, update the field, show it"),
    "report": (
        "report.report_command",
        "join the ledgers of all processes and write report.json, report.html and figures",
    ),
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
    "compare": ("experiments.compare_command", "compare what policies show in a scenario, over seeds, with intervals"),
    "simulate": (
        "experiments.virtual.simulate_command",
        "run a scenario's whole deployment in virtual time, reproducible bit for bit",
    ),
    "warm-up": ("fields.warm_up_command", "compile a field's kernels, so that the first run starts at once"),
    "costs": (
        "experiments.virtual.costs_command",
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
    "fetch-lpips": (
        "fidelity.fetch_lpips_command",
        "fetch LPIPS weights with the public package and convert them for --lpips",
    ),
}


if __name__ == "__main__":
    sys.exit(main())
