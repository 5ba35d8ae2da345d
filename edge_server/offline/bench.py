"""``edge-server bench``: what this machine does a second, with how busy others kept it beside each figure."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge_server.fields.registry import field_names
from edge_server.offline.usage import BenchError
from edge_server.report.machine import machine, versions

DESCRIPTION = """\
Measure this machine. Figures are medians; outside_cores says how many cores others kept busy meanwhile.

  edge-server bench                       # everything, several minutes
  edge-server bench field --quick
  edge-server bench ingest --json ingest.json

field      steps, rays and samples a second, ms a rendering, compile time, memory, seconds to 22..30 dB
limits     what this machine allows (random reads and additions, multiply-adds), and how near each kernel gets
ingest     a real edge server that trains, and a real client: how long an answer takes, whether memory grows
fidelity   what scoring one image costs
peer       seconds to 20 and 25 dB on lego and kitchen, beside nerfstudio's nerfacto where it is installed and
           the same field in plain torch; needs FRESHFIELD_DATA; not part of all
"""

PARTS = ("field", "limits", "ingest", "fidelity")
# Not part of "all": needs recorded data, and patience.
MORE = ("peer",)


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("edge-server bench", description=DESCRIPTION, formatter_class=raw)
    parser.add_argument(
        "part", nargs="?", choices=(*PARTS, *MORE, "all"), default="all", help="[%(default)s]"
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write figures there; plot and table beside"
    )
    parser.add_argument(
        "--field", action="append", default=[], metavar="NAME", help="of `field` [all there are]"
    )
    parser.add_argument("--quick", action="store_true", help="fewer repetitions, cached kernels only")
    parser.add_argument("--lpips", type=Path, metavar="DIR", help="LPIPS weights [$FRESHFIELD_LPIPS]")
    args = parser.parse_args(argv)
    if unknown := set(args.field) - set(field_names()):
        parser.error(f"no field is called {', '.join(unknown)}; there are: {', '.join(field_names())}")
    figures: dict[str, Any] = {"machine": machine(), "versions": versions(), "quick": args.quick}
    for part in PARTS if args.part == "all" else (args.part,):
        print(f"== {part}", flush=True)
        with tempfile.TemporaryDirectory(prefix="freshfield-bench-") as folder:
            module = importlib.import_module(f"edge_server.offline.bench_{part}")
            try:
                more = {"fields": args.field} if part == "field" else {}
                figures[part] = module.measure(args.quick, Path(folder), args.lpips, **more)
            except BenchError as error:
                print(f"edge-server bench {part}: {error}", file=sys.stderr)
                return 1
        for line in lines(figures[part]):
            print(f"  {line}", flush=True)
        if args.json is not None:  # after each part: an interrupted bench keeps what it has
            args.json.parent.mkdir(parents=True, exist_ok=True)
            args.json.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n")
            if hasattr(module, "draw"):
                module.draw(figures[part], args.json.with_suffix(".png"))
                args.json.with_suffix(".md").write_text(module.table(figures[part]) + "\n")
    return 0


def lines(figures: dict[str, Any], prefix: str = "") -> list[str]:
    """Nested figures as lines ``name  value``."""
    out = []
    for name, value in figures.items():
        if isinstance(value, dict):
            out += lines(value, f"{prefix}{name}.")
        else:
            shown = f"{value:,.3g}" if isinstance(value, float) and abs(value) < 1000 else f"{value}"
            out.append(f"{prefix + name:42} {f'{value:,.0f}' if _large(value) else shown}")
    return out


def _large(value: Any) -> bool:
    return isinstance(value, float) and abs(value) >= 1000


if __name__ == "__main__":
    sys.exit(main())
