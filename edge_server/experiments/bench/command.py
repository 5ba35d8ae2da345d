"""``edge-server bench``: measurements on this machine, each reported with the load of other processes."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from edge_server.experiments.bench.run import SCENES, BenchError, BenchRun
from edge_server.experiments.common.arguments import add_lpips, command_parser, parse_options
from edge_server.experiments.common.result_store import ResultStore
from edge_server.experiments.common.tables import markdown_table
from edge_server.fields.registry import field_names, make_field
from edge_server.report.machine import machine, versions
from freshfield.files import out_file, write_json, write_text

DESCRIPTION = """\
Measure speed and quality on this machine. Figures are medians; outside_cores is the number of cores that
other processes kept busy meanwhile.

  edge-server bench                       # the parts not marked "not part of all"; hours
  edge-server bench field --quick
  edge-server bench field --field ngp,splat --option device=cuda --json gpu.json
  edge-server bench track --scene room --field ngp
  edge-server bench field track options --json docs/results/field.json
  edge-server bench ingest --json ingest.json

field      steps, rays and samples a second, ms per rendering, compile time, memory, seconds to 22..30 dB
track      updates after motion: how many dB behind a fit from scratch
drift      the same over 300 updates of room: whether a field degrades
options    what each optional part of a representation costs in time and gains in dB
limits     what this machine allows (random reads and additions, multiply-adds), and how near each kernel gets
ingest     a real edge server that trains, and a real client: response time, growth of memory
decide     time of a learned policy's decision, without embeddings, with 18 and with 200 cameras
embed      ms to embed a frame with the shipped detectors or --model FILE, beside plain ONNX Runtime; needs
           the extra embed; not part of all
peer       seconds to 20 and 25 dB on lego and kitchen, beside ngp in plain torch and, where installed
           (docs/fields.md), nerfstudio's nerfacto and OpenSplat; needs FRESHFIELD_DATA; not part of all
shown      what is shown at random instants of synthetic scenes, in virtual time: content lag, ages, what a
           perfect field would show, and the causes of lost dB; not part of all
growth     how cost grows with cameras, image size, speed and people, from room: age shown, dB, cores,
           frames left out of updates; in virtual time; not part of all
surface    meshes of tile from 0.3 m: error and completeness against fit seconds and voxel size, seconds of
           each stage; needs the extra surface; not part of all
scanned    meshes of the tile alone, of scenario scan: from images masked by its detector, by true masks,
           and unmasked; needs the extras surface and embed; not part of all

With --json FILE, figures are written scene by scene as they are measured, and at the end of a part also
its tables (FILE with .md) and PART.png. After Ctrl-C, --resume continues where it stopped.
"""

PARTS = ("field", "track", "drift", "options", "limits", "ingest", "decide")
# Not part of "all": they need an extra, or recorded data and patience.
MORE = ("embed", "peer", "shown", "growth", "surface", "scanned")
# Parts that store each figure when it is measured, and skip known ones.
_RESUMABLE = ("field", "track", "drift", "options", "peer", "shown", "growth", "surface")
_MODULES = {"growth": "shown.growth", "drift": "track"}  # parts whose module has another name
# The scenes that each part offers; shown also accepts others.
_SCENES = {"field": SCENES, "track": ("room", "kitchen"), "drift": ("room", "kitchen")}
# Flag -> the parts that it applies to.
_ONLY_OF = {
    "field": tuple(p for p in _RESUMABLE if p not in ("peer", "shown", "growth")),
    "resume": (*PARTS, *MORE),
    "only": ("options", "surface"),
    "scene": (*_SCENES, "shown"),
    "option": tuple(_SCENES),
    "model": ("embed",),
}


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = _parser()
    args = parser.parse_args(argv)
    parts = list(dict.fromkeys(p for part in args.part or ["all"] for p in (PARTS if part == "all" else (part,))))
    if unknown := set(parts) - {*PARTS, *MORE}:
        parser.error(f"no part is called {', '.join(unknown)}; there are: {', '.join((*PARTS, *MORE))}, all")
    args.field = [name for words in args.field for name in words.split(",")]
    if unknown := set(args.field) - set(field_names()):
        parser.error(f"no field is called {', '.join(unknown)}; there are: {', '.join(field_names())}")
    if args.resume and args.json is None:
        parser.error("--resume needs --json FILE, the file to go on with")
    for flag, of in _ONLY_OF.items():
        if getattr(args, flag) and not set(parts) & set(of):
            parser.error(f"--{flag.replace('_', '-')} is for {', '.join(of)}; asked for: {', '.join(parts)}")
    for part in parts:
        if unknown := set(args.scene) - set(_SCENES.get(part, args.scene)):
            parser.error(f"--scene {', '.join(unknown)}: {part} knows {', '.join(_SCENES[part])}")
    try:
        args.option = parse_options(args.option)
        for name in args.field or field_names():
            make_field(name, args.option)
        figures = _known(args.json, args.quick) if args.resume else {}
    except (BenchError, ValueError) as error:
        parser.error(str(error))
    figures |= {"machine": machine(), "versions": versions(), "quick": args.quick}
    figures["runs"] = figures.get("runs", 0) + 1
    status = 0
    for part in parts:
        print(f"== {part}", flush=True)
        module = _module(part)
        try:
            _measure(part, module, args, figures)
        except BenchError as error:
            print(f"edge-server bench {part}: {error}", file=sys.stderr)
            status = 1  # continue with the other parts
            continue
        except KeyboardInterrupt:
            _write(args.json, figures)
            where = f"; what was measured is in {args.json}: --resume goes on" if args.json else ""
            print(f"\nstopped{where}", flush=True)
            return 130
        print(_table(module, figures[part]), flush=True)
        _write(args.json, figures)
    return status


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("bench", DESCRIPTION)
    add = parser.add_argument
    add("part", nargs="*", metavar="PART", help=f"what to measure: {', '.join((*PARTS, *MORE))}, all [all]")
    add("--json", type=out_file, metavar="FILE", help="write the figures to FILE as JSON; plots and tables beside it")
    add("--resume", action="store_true", help="continue: keep the figures in FILE, measure the rest")
    add(
        "--field",
        action="append",
        default=[],
        metavar="NAME",
        help="representations for field, track, drift, options, surface [all]",
    )
    add("--quick", action="store_true", help="fewer repetitions, cached kernels only")
    add_lpips(parser)
    add(
        "--only",
        action="append",
        default=[],
        metavar="NAME",
        help="measure only this row of options (e.g. exposure) or of surface (cell); may be repeated [all]",
    )
    add("--model", type=Path, metavar="FILE", help="ONNX file of a YOLO detector, for embed [the shipped ones]")
    add(
        "--scene",
        action="append",
        default=[],
        metavar="NAME",
        help=f"scene, for field: {', '.join(_SCENES['field'])} [all]; for track, drift: "
        f"{', '.join(_SCENES['track'])} [track: both; drift: room]; for shown: a row of its table, or any "
        "scenario with a synthetic scene [all rows]",
    )
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the field, for field, track, drift, e.g. device=cuda; may be repeated",
    )
    return parser


def _known(path: Path, quick: bool) -> dict[str, Any]:
    """The figures of an earlier run. Raises BenchError if they cannot be continued."""
    if not path.is_file():
        return {}
    try:
        known: dict[str, Any] = json.loads(path.read_text())
        known_quick = known["quick"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BenchError(f"--resume: {path} is not what bench writes: {error}") from None
    if known_quick != quick:
        raise BenchError(
            f"--resume: {path} was measured {'with' if known_quick else 'without'} --quick: go on alike, "
            "or write another file"
        )
    return known


def _module(part: str) -> ModuleType:
    return importlib.import_module(f"edge_server.experiments.bench.{_MODULES.get(part, part)}")


def _measure(part: str, module: ModuleType, args: argparse.Namespace, figures: dict[str, Any]) -> None:
    """Measure one part, and store its results in ``figures``."""
    store = ResultStore()
    if part in _RESUMABLE:
        store = ResultStore(figures.setdefault(part, {}), lambda *_: _write_json(args.json, figures))
    elif args.resume and part in figures:
        print("  known already", flush=True)
        return
    with tempfile.TemporaryDirectory(prefix="freshfield-bench-") as folder:
        run = BenchRun(
            args.quick,
            Path(folder),
            args.lpips,
            tuple(args.field),
            store,
            tuple(args.scene),
            args.option,
            tuple(args.only),
            args.model,
        )
        figures[part] = getattr(module, "measure_drift" if part == "drift" else "measure")(run)


def _write_json(path: Path | None, figures: dict[str, Any]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, figures, indent=1)


def _write(path: Path | None, figures: dict[str, Any]) -> None:
    """Write the JSON and, in the same folder, its tables and PART.png of every part that draws one."""
    if path is None:
        return
    _write_json(path, figures)
    text = [f"# Measured by `edge-server bench{' --quick' if figures['quick'] else ''}`", _conditions(figures)]
    for part in (*PARTS, *MORE):
        if not figures.get(part):
            continue
        module = _module(part)
        text.append(f"## {part}")
        if hasattr(module, "draw"):
            plot = path.with_name(f"{part}.png")
            module.draw(figures[part], plot)
            text += [f"![{part}]({plot.name})"] if plot.is_file() else []
        text.append(_table(module, figures[part]))
    write_text(path.with_suffix(".md"), "\n\n".join(text) + "\n")


def _conditions(figures: dict[str, Any]) -> str:
    m, v = figures["machine"], figures["versions"]
    known = ", ".join(f"{name} {version}" for name, version in v.items() if version is not None)
    runs = "one run" if figures["runs"] == 1 else f"{figures['runs']} runs"
    gpus = "".join(f"{name}, " for name in m["gpus"])
    return (
        f"{gpus}{m['cpu']}, {m['cores']} cores, {m['memory_gb']} GB, {m['system']} {m['kernel']}; {known}. "
        f"Measured in {runs}; outside cores: what others kept busy meanwhile."
    )


def _table(module: ModuleType, figures: dict[str, Any]) -> str:
    """The part's own tables, or one table of all figures by name."""
    if hasattr(module, "table"):
        text: str = module.table(figures)
        return text
    return markdown_table(("figure", "value"), flat(figures))


def flat(figures: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested figures as pairs of a name, ``a.b.c``, and a formatted value; lists are left out."""
    out: list[tuple[str, str]] = []
    for name, value in figures.items():
        if isinstance(value, dict):
            out += flat(value, f"{prefix}{name}.")
        elif not isinstance(value, list):
            out.append((prefix + name, _shown(value)))
    return out


def _shown(value: Any) -> str:
    if not isinstance(value, float):
        return f"{value}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:,.3g}"
