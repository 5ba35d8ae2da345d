"""``edge-server bench``: how cost grows with cameras, image size, speed and people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edge_server.experiments.bench import growth
from edge_server.experiments.common.arguments import command_parser, run_command
from edge_server.experiments.engine import Engine
from edge_server.report.machine import machine, versions
from freshfield.files import out_folder, write_json, write_text

DESCRIPTION = """\
Measure how cost grows with cameras, image size, speed and people, one factor at a time, from room: age shown,
dB, cores, frames left out of updates; in virtual time, in some ten minutes of one core.

  edge-server bench growth
  edge-server bench growth --quick --out runs/growth

Seconds of fitting to a quality, by representation: edge-server frontier. Milliseconds of an update of a scenario:
edge-server costs.

Writes OUT/growth.json, its tables to OUT/growth.md and a figure to OUT/growth.png. Every point is kept in
OUT/results.jsonl when it is measured: after Ctrl-C the same command goes on, and only what other code, settings or
another kind of processor computed is measured anew.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("bench", DESCRIPTION)
    add = parser.add_argument
    add("part", nargs="?", choices=["growth"], default="growth", help="what to measure [%(default)s]")
    add("--out", type=out_folder, default="runs/bench", metavar="DIR", help="folder to write [%(default)s]")
    add("--quick", action="store_true", help="shorter runs")
    args = parser.parse_args(argv)
    stopped = f"what was measured is in {args.out}: the same command goes on"
    return run_command("bench", lambda: _measure(args.out, args.quick), (), stopped)


def _measure(out: Path, quick: bool) -> None:
    """Measure, and write the files."""
    with Engine(out / "results.jsonl") as engine:
        figures = growth.measure(engine, quick)
    m, known = machine(), ", ".join(f"{name} {version}" for name, version in versions().items() if version is not None)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "growth.json", {"machine": m, "versions": versions(), "quick": quick, "growth": figures}, indent=1)
    growth.draw(figures, out / "growth.png")
    tables = growth.table(figures)
    text = [
        f"# Measured by `edge-server bench growth{' --quick' if quick else ''}`",
        f"{m['cpu']}, {m['cores']} cores, {m['memory_gb']} GB, {m['system']} {m['kernel']}; {known}.",
        "![growth](growth.png)",
        tables,
    ]
    write_text(out / "growth.md", "\n\n".join(text) + "\n")
    print(f"{tables}\n{out / 'growth.md'}", flush=True)
