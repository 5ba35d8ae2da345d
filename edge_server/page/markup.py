"""The panel's HTML, from the macros of ``panel.html.j2``: functions from state to text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from edge_server.fidelity.scorer import SELECTED
from edge_server.live.state import CameraView, Publication
from edge_server.page.colors import HELD_OUT, MEASURED, PRESENT, age_color, css, scale_color
from edge_server.page.page_constants import FRESH_MS, NAMED_CAMERAS, STALE_MS
from edge_server.run_records import Frontier
from freshfield.scenario import NOTHING_HELD_OUT


@dataclass(frozen=True)
class Summary:
    """The values of the tiles; None is shown as a dash. condition: live, waiting or paused.

    age_parts_ms: of the age of what is shown, by name; empty before there is anything to show.
    """

    scenario: str
    field: str
    doing: str
    condition: str
    updates: int
    update_ms: float | None
    psnr_db: float | None
    scored_on: str | None
    mean_age_ms: float | None
    worst_age_ms: float | None
    reporting: int
    cameras: int
    t_s: float
    age_parts_ms: Mapping[str, float]


def html(macro: str, *values: Any) -> str:
    """A part of the panel that needs nothing but the template, by the name of its macro in ``panel.html.j2``."""
    return str(getattr(_panel, macro)(*values))


def status(s: Summary) -> str:
    """Status line, six tiles, and the parts of the age of what is shown."""
    names = {None: "held-out views", SELECTED: NOTHING_HELD_OUT}
    return str(_panel.status(s, names.get(s.scored_on, s.scored_on)))


def frontier(found: Frontier, present: tuple[float, float, float | None] | None) -> str:
    """Chart of the trade-off of accuracy against time: PSNR against update time, with the curves of the best setting
    bold, and the run's own point ``present`` (``EdgeState.present``). Without measured points, how to measure them."""
    if not found.points:
        return html("note", f"What accuracy costs in time is not measured for this field. {found.about}")
    now = [(present[0], db) for db in present[1:] if db is not None] if present is not None else []
    known = [(p.update_ms, db) for p in found.points for db in (p.psnr_db, p.psnr_moving_db)] + now
    times, levels = [math.log(max(ms, 1.0)) for ms, _ in known], [db for _, db in known]
    left, low = min(times), min(levels)
    wide, high = max(max(times) - left, 1e-3), max(max(levels) - low, 1e-3)

    def at(ms: float, db: float) -> str:
        x = 30.0 + 280.0 * (math.log(max(ms, 1.0)) - left) / wide
        return f"{x:.1f},{8.0 + 84.0 * (1.0 - (db - low) / high):.1f}"

    measured = sorted(found.points, key=lambda p: p.update_ms)
    whole = " ".join(at(p.update_ms, p.psnr_db) for p in measured)
    moving = " ".join(at(p.update_ms, p.psnr_moving_db) for p in measured)
    ends = (
        (26, 12, "end", f"{low + high:.0f}"),
        (26, 94, "end", f"{low:.0f} dB"),
        (30, 106, "start", f"{math.exp(left):.0f} ms an update"),
        (310, 106, "end", f"{math.exp(left + wide):.0f} ms"),
    )
    return str(_panel.frontier(whole, moving, [at(ms, db).split(",") for ms, db in now], ends, found.about))


def decision_words(last: Publication, cameras: Sequence[CameraView], policy: str) -> str:
    """What the newest update used, and what it left out, in words.

    last: the update. cameras: of the run; held-out ones are not counted. policy: its name.
    """
    there = {c.camera: c.age_ms for c in cameras if not c.held_out and c.age_ms is not None}
    unused = sorted((name for name in there if name not in last.selected), key=lambda name: -(there[name] or 0.0))
    used = len(last.selected)
    words = f"uses all {used} views" if not unused else f"uses {used} of {used + len(unused)} views"
    if last.omega_ms is not None:
        omega = f"{last.omega_ms:.0f} ms"
        kind = policy.partition("-")[0]
        words = {"wait": f"waits {omega}, then {words}", "threshold": f"{words}, up to {omega} old"}.get(
            kind, f"{words}; the policy chose {omega}"
        )
    if unused:
        named = ", ".join(f"{name} ({there[name]:.0f} ms old)" for name in unused[:NAMED_CAMERAS])
        words += f"; leaves out {named}" + (
            f" and {len(unused) - NAMED_CAMERAS} more" if unused[NAMED_CAMERAS:] else ""
        )
    if last.refused:
        words += f"; refuses {', '.join(last.refused)}, which contradict the others"
    # Room for two lines, so that the elements below do not move.
    return str(_panel.note(f"Update {last.number} {words}.", lines=2))


def comparison_caption(camera: str, psnr_db: float | None, update: int, held_out: bool) -> str:
    """The caption above the pair of images. held_out: whether the camera is held out."""
    truth = "truth at the present" if held_out else NOTHING_HELD_OUT
    return str(_panel.comparison_caption(camera, psnr_db, update, truth))


def channel_line(channel: dict[str, Any]) -> str:
    """The emulator's status in one line; values that it does not report are left out."""
    counts = channel.get("counts")
    delay = channel.get("drawn_delay_ms")
    mean_ms = delay.get("mean") if isinstance(delay, dict) else None
    parts = [str(channel[key]) for key in ("preset", "discipline") if channel.get(key)]
    if isinstance(mean_ms, int | float):
        parts.append(f"mean delay {mean_ms:.0f} ms")
    for key in ("forwarded", "dropped_busy", "superseded", "lost"):
        count = counts.get(key) if isinstance(counts, dict) else None
        if count:
            parts.append(f"{count} {key.replace('_', ' ')}")
    return html("note", ", ".join(parts))


def number(value: float | None, digits: int = 0) -> str:
    """A number for people: a dash for None and NaN."""
    if value is None or value != value:
        return Markup("&ndash;")
    if value in (float("inf"), float("-inf")):
        return Markup("&infin;") if value > 0 else Markup("-&infin;")
    return f"{value:.{digits}f}"


def _clock(seconds: float) -> str:
    whole = max(0, int(seconds))
    return f"{whole // 60}:{whole % 60:02d}"


_environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
_environment.filters |= {
    "n": number,
    "css": css,
    "clock": _clock,
    "age_css": lambda age_ms: css(age_color(age_ms)),
    "scale_css": lambda fraction: css(scale_color(fraction)),
}
_environment.globals |= {"measured": css(MEASURED), "present": css(PRESENT), "held_out": css(HELD_OUT)}
_environment.globals |= {"fresh_ms": FRESH_MS, "stale_ms": STALE_MS}
_panel: Any = _environment.get_template("panel.html.j2").module
