"""The command ``edge-server report``: presents a run's files as a page with figures."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from edge_server.command import command_parser, exit_status
from freshfield.scenario import ScenarioError


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    report = command_parser(
        "edge-server report", "Write DIR/report.json, DIR/report.html and figures from what a run left in DIR."
    )
    report.add_argument("directory", type=Path, metavar="DIR", help="folder of a run or fit (its --out)")
    report.add_argument("--beside", type=Path, metavar="DIR", help="print its figures beside those of this other run")
    args = report.parse_args(argv)
    return exit_status(report.prog, lambda: _report(args), ScenarioError)


def _report(args: argparse.Namespace) -> None:
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
