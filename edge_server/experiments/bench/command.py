"""``edge-server bench``: measurements on this machine, each reported with the load of other processes."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge_server.experiments.bench.field import SCENES
from edge_server.experiments.bench.run import BenchError, BenchRun
from edge_server.experiments.common.arguments import add_lpips, command_parser, parse_options, run_command
from edge_server.experiments.engine import Engine
from edge_server.fields.registry import field_names, make_field
from edge_server.report.machine import machine, versions
from freshfield.files import out_folder, write_json, write_text

# Name of a part -> what it measures. It is a module of that name in this folder, with functions ``measure(run)``,
# ``table(figures)`` and ``draw(figures, path)``.
PARTS = {
    "field": "each representation on each scene: PSNR against seconds of fitting from scratch, seconds to 22..30 dB",
    "growth": (
        "how cost grows with cameras, image size, speed and people, from room: age shown, dB, cores,\n"
        f"{'':11}frames left out of updates; in virtual time"
    ),
}
DESCRIPTION = f"""\
Measure speed and quality on this machine. Figures are medians; outside cores is the number of cores that
other processes kept busy meanwhile.

  edge-server bench                       # field: hours
  edge-server bench field --quick
  edge-server bench field --field ngp,splat --option threads=2
  edge-server bench growth

{chr(10).join(f"{name:10} {text}" for name, text in PARTS.items())}

Each part writes OUT/PART.json, its tables to OUT/PART.md and a figure to OUT/PART.png. Every point is kept in
OUT/results.jsonl when it is measured: after Ctrl-C the same command goes on, and only what other code, data,
settings or another kind of processor computed is measured anew.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("bench", DESCRIPTION)
    add = parser.add_argument
    add("part", nargs="*", metavar="PART", help=f"what to measure: {', '.join(PARTS)} [field]")
    add("--out", type=out_folder, default="runs/bench", metavar="DIR", help="folder to write [%(default)s]")
    add("--quick", action="store_true", help="fewer repetitions")
    add("--field", default="", metavar="NAME,...", help="representations for field [all]")
    add("--scene", default="", metavar="NAME,...", help="scenes for field [all]")
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the representations, for field, e.g. threads=2; may be repeated",
    )
    add_lpips(parser)
    args = parser.parse_args(argv)
    names = tuple(dict.fromkeys(args.part or ["field"]))
    fields, scenes = (tuple(filter(None, words.split(","))) for words in (args.field, args.scene))
    if unknown := set(names) - set(PARTS):
        parser.error(f"no part is called {', '.join(unknown)}; there are: {', '.join(PARTS)}")
    if unknown := set(fields) - set(field_names()):
        parser.error(f"no field is called {', '.join(unknown)}; there are: {', '.join(field_names())}")
    if unknown := set(scenes) - set(SCENES):
        parser.error(f"--scene {', '.join(unknown)}: field knows {', '.join(SCENES)}")
    if "growth" in names and (fields or scenes or args.option):
        parser.error("growth: takes no --field, --scene or --option")
    try:
        options = parse_options(args.option)
        for field in fields or field_names():
            make_field(field, options)
    except ValueError as error:
        parser.error(str(error))
    run = BenchRun(Engine(args.out / "results.jsonl"), args.quick, fields, scenes, options, args.lpips)
    failed: list[str] = []

    def work() -> None:
        with run.engine:
            failed.extend(name for name in names if not _measure(name, run, args.out))

    status = run_command("bench", work, (), f"what was measured is in {args.out}: the same command goes on")
    return status or int(bool(failed))


def _measure(name: str, run: BenchRun, out: Path) -> bool:
    """Measure one part and write its files; returns whether it could be measured."""
    print(f"== {name}", flush=True)
    part = importlib.import_module(f"edge_server.experiments.bench.{name}")
    try:
        figures = part.measure(run)
    except BenchError as error:
        print(f"edge-server bench {name}: {error}", file=sys.stderr)
        return False  # the other parts go on
    tables = part.table(figures)
    facts = {"machine": machine(), "versions": versions(), "quick": run.quick}
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / f"{name}.json", {**facts, name: figures}, indent=1)
    text = [f"# Measured by `edge-server bench {name}{' --quick' if run.quick else ''}`", _conditions(facts)]
    part.draw(figures, out / f"{name}.png")
    text += [f"![{name}]({name}.png)"] if (out / f"{name}.png").is_file() else []
    write_text(out / f"{name}.md", "\n\n".join([*text, tables]) + "\n")
    print(f"{tables}\n{out / name}.md", flush=True)
    return True


def _conditions(facts: dict[str, Any]) -> str:
    m, v = facts["machine"], facts["versions"]
    known = ", ".join(f"{name} {version}" for name, version in v.items() if version is not None)
    gpus = "".join(f"{name}, " for name in m["gpus"])
    return (
        f"{gpus}{m['cpu']}, {m['cores']} cores, {m['memory_gb']} GB, {m['system']} {m['kernel']}; {known}. "
        "Outside cores: what others kept busy meanwhile."
    )
