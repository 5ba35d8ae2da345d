"""report.html: one self-contained page with the figures inside, from the template ``report.html.j2``."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, Undefined

from edge_server.fidelity.scorer import SELECTED
from edge_server.report.report_constants import FINAL_PART
from freshfield.scenario import NOTHING_HELD_OUT

TEMPLATE = "report.html.j2"


def render_page(report: Mapping[str, Any], figures: Mapping[str, Path]) -> str:
    """The page. report: contents of report.json. figures: PNGs by name, as ``figures.draw_all`` returns them."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"n": number, "counts": counts}
    images = {name: base64.b64encode(path.read_bytes()).decode() for name, path in figures.items()}
    why_whole: Mapping[str, str] = {}
    if report["foreground"]:
        from edge_server.foreground import WHY as why_whole  # only where a run cuts objects out

    template = environment.get_template(TEMPLATE)
    return template.render(
        r=report,
        figures=images,
        selected=SELECTED,
        nothing_held_out=NOTHING_HELD_OUT,
        final_part=FINAL_PART,
        why_whole=why_whole,
    )


def number(value: float | Undefined | None, digits: int = 0, unit: str = "", factor: float = 1.0) -> str:
    """``factor`` times a number for people; an en dash where there is none."""
    if value is None or isinstance(value, Undefined):
        return "–"
    return f"{factor * value:,.{digits}f}{unit}"


def counts(by_name: Mapping[str, int]) -> str:
    """Names and counts as a list, e.g. "crc 4, stale 1,200"."""
    return ", ".join(f"{name} {count:,}" for name, count in by_name.items())
