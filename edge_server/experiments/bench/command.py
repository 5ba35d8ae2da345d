"""``edge-server bench``: measurements on this machine, each reported with the load of other processes."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_server.experiments.bench.run import SCENES, BenchError, BenchRun
from edge_server.experiments.common.arguments import add_lpips, command_parser, parse_options
from edge_server.experiments.engine import Engine
from edge_server.fields.registry import field_names, make_field
from edge_server.report.machine import machine, versions
from freshfield.files import out_folder, write_json, write_text

DESCRIPTION = """\
Measure speed and quality on this machine. Figures are medians; outside cores is the number of cores that
other processes kept busy meanwhile.

  edge-server bench                       # the parts not marked "not part of all"; hours
  edge-server bench field --quick
  edge-server bench field --field ngp,splat --option threads=2
  edge-server bench track --scene room --field ngp --out runs/follow

{parts}

Each part writes OUT/PART.json, its tables to OUT/PART.md and, where it draws, OUT/PART.png. Every point is
kept in OUT/results.jsonl when it is measured: after Ctrl-C the same command goes on, and only what other
code, data, settings or another kind of processor computed is measured anew.
"""


@dataclass(frozen=True)
class Part:
    """A part of the bench.

    module: its module in this folder, with functions ``measure(run)`` and ``table(figures)``, each with ``suffix``
        in its name, and maybe ``draw(figures, path)``.
    help: what it measures.
    scenes: the scenes that it offers; empty: it has its own.
    fields: whether it measures the representations that are asked for.
    in_all: whether ``all`` includes it.
    """

    module: str
    help: str
    suffix: str = ""
    scenes: tuple[str, ...] = ()
    fields: bool = False
    in_all: bool = True

    def function(self, name: str) -> Any:
        """One of its functions; None if there is none."""
        module = importlib.import_module(f"edge_server.experiments.bench.{self.module}")
        return getattr(module, f"{name}{self.suffix}", None)


_MOVING = ("room", "kitchen")
PARTS = {
    "field": Part(
        "field",
        "steps, rays and samples a second, ms per rendering, compile time, memory, seconds to 22..30 dB",
        scenes=SCENES,
        fields=True,
    ),
    "track": Part("track", "updates after motion: how many dB behind a fit from scratch", scenes=_MOVING, fields=True),
    "drift": Part(
        "track",
        "the same over 300 updates of room: whether a field degrades",
        suffix="_drift",
        scenes=_MOVING,
        fields=True,
    ),
    "growth": Part(
        "growth",
        "how cost grows with cameras, image size, speed and people, from room: age shown, dB, cores,\n"
        "frames left out of updates; in virtual time",
        in_all=False,
    ),
    "surface": Part(
        "surface",
        "meshes of tile from 0.3 m: error and completeness against fit seconds and voxel size, seconds of\n"
        "each stage; needs the extra surface",
        fields=True,
        in_all=False,
    ),
    "cell": Part(
        "surface",
        "the same from the viewpoints of scenario cell, beside meshes from exact depth; needs the extra\nsurface",
        suffix="_cell",
        in_all=False,
    ),
    "scanned": Part(
        "scanned",
        "meshes of the tile alone, of scenario scan: from images masked by its detector, by true masks, and\n"
        "unmasked; needs the extras surface and embed",
        in_all=False,
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("bench", DESCRIPTION.format(parts=_help()))
    add = parser.add_argument
    add("part", nargs="*", metavar="PART", help=f"what to measure: {', '.join(PARTS)}, all [all]")
    add("--out", type=out_folder, default="runs/bench", metavar="DIR", help="folder to write [%(default)s]")
    add("--quick", action="store_true", help="fewer repetitions, cached kernels only")
    add("--field", default="", metavar="NAME,...", help=f"representations for {_with('fields')} [all]")
    add("--scene", default="", metavar="NAME,...", help=f"scenes for {_with('scenes')} [all; drift: room]")
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help=f"option of the field, for {_with('scenes')}, e.g. threads=2; may be repeated",
    )
    add_lpips(parser)
    args = parser.parse_args(argv)
    of_all = [name for name, part in PARTS.items() if part.in_all]
    names = [name for word in args.part or ["all"] for name in (of_all if word == "all" else [word])]
    fields, scenes = (tuple(filter(None, words.split(","))) for words in (args.field, args.scene))
    if unknown := set(names) - set(PARTS):
        parser.error(f"no part is called {', '.join(unknown)}; there are: {', '.join(PARTS)}, all")
    if unknown := set(fields) - set(field_names()):
        parser.error(f"no field is called {', '.join(unknown)}; there are: {', '.join(field_names())}")
    for name in names:
        part = PARTS[name]
        if (fields and not part.fields) or ((scenes or args.option) and not part.scenes):
            parser.error(f"{name}: takes no {'--field' if fields and not part.fields else '--scene or --option'}")
        if unknown := set(scenes) - set(part.scenes):
            parser.error(f"--scene {', '.join(unknown)}: {name} knows {', '.join(part.scenes)}")
    try:
        options = parse_options(args.option)
        for field in fields or field_names():
            make_field(field, options)
    except ValueError as error:
        parser.error(str(error))
    run = BenchRun(Engine(args.out / "results.jsonl"), args.quick, fields, scenes, options, args.lpips)
    try:
        with run.engine:
            return max([_measure(name, run, args.out) for name in dict.fromkeys(names)])
    except KeyboardInterrupt:
        print(f"\nstopped; what was measured is in {args.out}: the same command goes on", flush=True)
        return 130


def _measure(name: str, run: BenchRun, out: Path) -> int:
    """Measure one part and write its files; returns the exit status."""
    print(f"== {name}", flush=True)
    part = PARTS[name]
    try:
        figures = part.function("measure")(run)
    except BenchError as error:
        print(f"edge-server bench {name}: {error}", file=sys.stderr)
        return 1  # the other parts go on
    tables = part.function("table")(figures)
    facts = {"machine": machine(), "versions": versions(), "quick": run.quick}
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / f"{name}.json", {**facts, name: figures}, indent=1)
    text = [f"# Measured by `edge-server bench {name}{' --quick' if run.quick else ''}`", _conditions(facts)]
    if draw := part.function("draw"):
        draw(figures, out / f"{name}.png")
        text += [f"![{name}]({name}.png)"] if (out / f"{name}.png").is_file() else []
    write_text(out / f"{name}.md", "\n\n".join([*text, tables]) + "\n")
    print(f"{tables}\n{out / name}.md", flush=True)
    return 0


def _help() -> str:
    lines = []
    for name, part in PARTS.items():
        text = part.help + ("" if part.in_all else "; not part of all")
        lines.append(f"{name:10} " + text.replace("\n", f"\n{'':11}"))
    return "\n".join(lines)


def _with(what: str) -> str:
    return ", ".join(name for name, part in PARTS.items() if getattr(part, what))


def _conditions(facts: dict[str, Any]) -> str:
    m, v = facts["machine"], facts["versions"]
    known = ", ".join(f"{name} {version}" for name, version in v.items() if version is not None)
    gpus = "".join(f"{name}, " for name in m["gpus"])
    return (
        f"{gpus}{m['cpu']}, {m['cores']} cores, {m['memory_gb']} GB, {m['system']} {m['kernel']}; {known}. "
        "Outside cores: what others kept busy meanwhile."
    )
