"""Runs deployments with faults drawn from many seeds, shared out over processes or the machines of a Ray cluster.

    python -m tests.chaos 0..9999 [--jobs N] [--ray ADDRESS] [--out FILE]

After Ctrl-C the same command runs the missing seeds only. On a cluster each machine has this checkout at the same path.
Exit code: 1 if a seed failed; its minimal faults and the command that repeats them are printed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from edge_server.command import run_command
from edge_server.experiments.common.arguments import add_workers
from edge_server.experiments.engine import Engine, EngineError
from tests.chaos.seeds import failure, read_seeds, run_seed


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = argparse.ArgumentParser("python -m tests.chaos", description=__doc__.partition("\n")[0])
    parser.add_argument("seeds", type=read_seeds, help="A..B, or numbers separated by commas")
    add_workers(parser)
    parser.add_argument("--out", type=Path, default="runs/chaos.jsonl", metavar="FILE", help="results [%(default)s]")
    args = parser.parse_args(argv)
    failed = []

    def work() -> None:
        with Engine(args.out, args.jobs, args.ray) as engine:
            failed.extend(found for found in engine.run(run_seed, args.seeds, "seeds") if found["problems"])

    status = run_command("tests.chaos", work, (EngineError,), f"what is finished is in {args.out}")
    for found in failed:
        print(failure(found))
    return status or int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
