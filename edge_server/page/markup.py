"""The panel's HTML: pure functions from state to text. Everything from outside is escaped."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

from edge_server.fidelity.scorer import SELECTED
from edge_server.live.frontier import best_point
from edge_server.live.state import CameraView
from edge_server.page.colors import AGAINST, FOR, FRESH_MS, HELD_OUT, RGB, STALE_MS, age_color, css, scale_color
from edge_server.run_records import Frontier
from freshfield.scenario import NOTHING_HELD_OUT

if TYPE_CHECKING:  # loaded only with a learned policy
    from edge_server.scheduler.learned.explain import Explanation

# Number of cameras in the explanation of a decision.
EXPLAINED_CAMERAS = 6
_DIM = "color:var(--mantine-color-dimmed)"
_CELL = "padding:.1em .35em;text-align:right"
_CARD = "background:rgba(128,140,160,.10);border-radius:6px"

INTRO = (
    f'<div style="padding:.5em .9em 0;font-size:.82em;line-height:1.45">'
    "Cameras send frames over a bad network. A radiance field learns the scene from whatever has arrived, "
    f'so what you see is always a little <b>old</b>. <span style="{_DIM}">Drag to turn, scroll to '
    "approach, right-drag to shift. Click a camera to look through it.</span></div>"
)


@dataclass(frozen=True)
class Summary:
    """The values of the tiles; None is shown as a dash. condition: live, waiting or paused."""

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
    age_parts_ms: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """The parts of the age of what is shown, by name; empty before there is anything to show."""


def status(s: Summary) -> str:
    """Status line, six tiles, and the parts of the age of what is shown."""
    dot = css(scale_color(0.0 if s.condition == "live" else 0.5))
    head = (
        f'<div style="padding:.45em .9em;font-size:.85em"><span style="color:{dot}">&#9679;</span> '
        f"<b>{escape(s.scenario)}</b> &middot; {escape(s.field or 'no field')} &middot; "
        f"{s.condition} &middot; {_clock(s.t_s)}"
        f'<div style="{_DIM};font-size:.92em;white-space:nowrap;overflow:hidden;text-overflow:ellipsis;'
        f'min-height:1.4em">{escape(s.doing)}</div></div>'
    )
    names = {None: "held-out views", SELECTED: NOTHING_HELD_OUT}
    on = escape(f"PSNR on {names.get(s.scored_on, s.scored_on)}")
    tiles = (
        (on, number(s.psnr_db, 1), "dB"),
        ("updates", str(s.updates), ""),
        ("update", number(s.update_ms), "ms each"),
        ("mean age", number(s.mean_age_ms), "ms", s.mean_age_ms),
        ("worst age", number(s.worst_age_ms), "ms", s.worst_age_ms),
        ("cameras", f"{s.reporting}/{s.cameras}", ""),
    )
    cells = "".join(_tile(*tile) for tile in tiles)
    grid = "display:grid;grid-template-columns:repeat(3,1fr);gap:.4em;padding:0 .9em .5em"
    return f'{head}<div style="{grid}">{cells}</div>{_age_parts(s.age_parts_ms)}'


def _age_parts(parts_ms: Mapping[str, float]) -> str:
    """A bar whose pieces are as long as the parts of the age, and their names and milliseconds."""
    if not parts_ms:
        return ""
    total_ms = max(sum(parts_ms.values()), 1e-3)
    pieces, words = [], []
    for k, (name, ms) in enumerate(parts_ms.items()):
        color = css(scale_color(k / max(len(parts_ms) - 1, 1)))
        pieces.append(f'<div style="width:{100 * ms / total_ms:.1f}%;background:{color}"></div>')
        swatch = f'<span style="color:{color}">&#9632;</span>'
        words.append(f'<span style="white-space:nowrap">{swatch} {escape(name)} {number(ms)}</span>')
    return (
        '<div style="padding:0 .9em .5em;font-size:.75em">'
        f'<span style="{_DIM}">age of what is shown, {number(total_ms)} ms</span>'
        f'<div style="display:flex;height:7px;border-radius:4px;overflow:hidden">{"".join(pieces)}</div>'
        f"<div>{' '.join(words)}</div></div>"
    )


def frontier(found: Frontier, present: tuple[float, float, float | None] | None) -> str:
    """What accuracy costs in time: PSNR against the time of an update, the curves of the best setting bold,
    and the run's own point ``present`` (``EdgeState.present``). Without measured points, how to measure
    them."""
    if not found.points:
        return note(f"What accuracy costs in time is not measured for this field. {found.about}")
    now = [(present[0], db) for db in present[1:] if db is not None] if present is not None else []
    known = [(p.update_ms, db) for p in found.points for db in (p.psnr_db, p.psnr_moving_db)] + now
    times, levels = [math.log(max(ms, 1.0)) for ms, _ in known], [db for _, db in known]
    left, low = min(times), min(levels)
    wide, high = max(max(times) - left, 1e-3), max(max(levels) - low, 1e-3)

    def at(ms: float, db: float) -> str:
        x = 30.0 + 280.0 * (math.log(max(ms, 1.0)) - left) / wide
        return f"{x:.1f},{8.0 + 84.0 * (1.0 - (db - low) / high):.1f}"

    lines, best = "", best_point(found.points, found.speed_m_per_s)
    for name in dict.fromkeys(p.effort for p in found.points):
        mine = sorted((p for p in found.points if p.effort == name), key=lambda p: p.update_ms)
        bold = name == best.effort
        for key, dash in (("psnr_db", ""), ("psnr_moving_db", "4 3")):
            path = " ".join(at(p.update_ms, getattr(p, key)) for p in mine)
            lines += (
                f'<polyline points="{path}" fill="none" stroke="{css(FOR)}" stroke-dasharray="{dash}" '
                f'stroke-width="{1.8 if bold else 0.8}" opacity="{1.0 if bold else 0.45}"/>'
            )
    for ms, db in now:
        x, y = at(ms, db).split(",")
        lines += f'<circle cx="{x}" cy="{y}" r="4" fill="{css(AGAINST)}"/>'
    ends = "".join(
        f'<text x="{x}" y="{y}" text-anchor="{anchor}" font-size="9" fill="currentColor">{words}</text>'
        for x, y, anchor, words in (
            (26, 12, "end", f"{low + high:.0f}"),
            (26, 94, "end", f"{low:.0f} dB"),
            (30, 106, "start", f"{math.exp(left):.0f} ms an update"),
            (310, 106, "end", f"{math.exp(left + wide):.0f} ms"),
        )
    )
    return (
        '<div style="padding:.2em .9em .4em;font-size:.75em">'
        f'<svg viewBox="0 0 320 110" width="100%">{lines}{ends}</svg>'
        f'<span style="color:{css(AGAINST)}">&#9679;</span> now, shown; lines measured: whole image, '
        f'dashed where it moves<div style="{_DIM}">{escape(found.about)}, by edge-server frontier</div></div>'
    )


def _tile(name: str, value: str, unit: str, age_ms: float | None = None) -> str:
    edge = f"border-left:3px solid {css(age_color(age_ms))};" if age_ms is not None else ""
    big = "font-size:1.15em;font-weight:600;font-variant-numeric:tabular-nums"
    return (
        f'<div style="{_CARD};{edge}padding:.3em .55em;white-space:nowrap;overflow:hidden">'
        f'<div style="{_DIM};font-size:.7em;white-space:normal">{name}</div>'
        f'<div><span style="{big}">{value}</span>'
        f'<span style="{_DIM};font-size:.7em"> {unit}</span></div></div>'
    )


def legend() -> str:
    """The age scale and the color of held-out cameras."""
    stops = ",".join(css(scale_color(i / 8)) for i in range(9))
    middle = (FRESH_MS * STALE_MS) ** 0.5
    return (
        '<div style="padding:.5em .9em .2em;font-size:.75em">'
        f'<div style="height:7px;border-radius:4px;background:linear-gradient(90deg,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between;{_DIM}">'
        f"<span>fresh, {FRESH_MS:g} ms</span><span>{_rounded(middle)} ms</span>"
        f"<span>stale, {STALE_MS / 1000:g} s</span></div>"
        f'<div><span style="color:{css(HELD_OUT)}">&#9632;</span> held out: ground truth, never trained on'
        "</div></div>"
    )


def table(cameras: Sequence[CameraView], selected: Sequence[str] = ()) -> str:
    """One row for each camera: age, frames delivered and rejected. Cameras of the last update are ticked."""
    chosen = set(selected)
    rows = "".join(_row(c, c.camera in chosen) for c in cameras)
    return _table(("camera", "age", "used", "delivered", "rejected"), rows)


def _table(columns: Sequence[str], rows: str) -> str:
    """Rows of HTML under the names of their columns; the first column is on the left."""
    head = "".join(
        f'<th style="{_CELL};font-weight:400{"" if i else ";text-align:left"}">{name}</th>'
        for i, name in enumerate(columns)
    )
    return (
        '<div style="padding:0 .6em .5em"><table style="width:100%;border-collapse:collapse;font-size:.78em;'
        f'font-variant-numeric:tabular-nums"><thead style="{_DIM}"><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _row(camera: CameraView, used: bool) -> str:
    color = css(HELD_OUT if camera.held_out else age_color(camera.age_ms))
    age = "no frame yet" if camera.age_ms is None else f"{number(camera.age_ms)} ms"
    tick = "truth" if camera.held_out else ("&#10003;" if used else "")
    rejected = f"color:{css(scale_color(1.0))}" if camera.rejected else _DIM
    return (
        f'<tr><td style="{_CELL};text-align:left"><span style="color:{color}">&#9632;</span> '
        f"{escape(camera.camera)}</td>"
        f'<td style="{_CELL}">{age}</td><td style="{_CELL}">{tick}</td>'
        f'<td style="{_CELL}">{camera.delivered}</td>'
        f'<td style="{_CELL};{rejected}">{camera.rejected}</td></tr>'
    )


def comparison_caption(camera: str, psnr_db: float | None, update: int, held_out: bool) -> str:
    """The caption above the pair of images. held_out: the camera is."""
    truth = "truth at the present" if held_out else NOTHING_HELD_OUT
    score = "" if psnr_db is None else f"{number(psnr_db, 1)} dB &middot; "
    return (
        f'<div style="padding:.4em .9em .25em;font-size:.78em"><b>{escape(camera)}</b>, '
        f'<span style="{_DIM}">{score}update {update}</span>'
        f'<div style="display:grid;grid-template-columns:1fr 1fr;{_DIM};font-size:.95em">'
        f"<span>{truth}</span><span>what the field renders</span></div></div>"
    )


def chart_caption(title: str, lines: Sequence[tuple[str, RGB]], remark: str = "") -> str:
    """A chart's title on the left; on the right ``remark``, or the names of its lines in their colors."""
    names = " ".join(
        f'<span style="color:{css(color)};margin-left:.6em;white-space:nowrap">&#9473; {escape(name)}</span>'
        for name, color in lines
    )
    right = f'<span style="{_DIM}">{escape(remark)}</span>' if remark else names
    return (
        '<div style="padding:.35em .9em .1em;font-size:.78em;display:flex;justify-content:space-between">'
        f"<span>{escape(title)}</span><span>{right}</span></div>"
    )


def decision_explanation(e: Explanation) -> str:
    """A learned policy's decision: bars of the contributions of parts of the state and of cameras."""
    largest = sorted(zip(e.names, e.cameras.tolist()), key=lambda pair: -abs(pair[1]))[:EXPLAINED_CAMERAS]
    widest = max((abs(share) for share in (*e.parts.values(), *(s for _, s in largest))), default=0.0)
    bars = "".join(_bar(name, share, widest) for name, share in e.parts.items())
    bars += f'<div style="height:.4em"></div>{"".join(_bar(n, s, widest) for n, s in largest)}'
    return (
        f'<div style="padding:.3em .9em;font-size:.78em"><div><b>{escape(e.action)}</b> '
        f'<span style="{_DIM}">logit {e.logit:+.2f}, of average cameras {e.baseline_logit:+.2f}</span></div>'
        f"{bars}"
        f'<div style="{_DIM}"><span style="color:{css(FOR)}">&#9632;</span> for it '
        f'<span style="color:{css(AGAINST)}">&#9632;</span> against it</div></div>'
    )


def _bar(name: str, share: float, widest: float) -> str:
    percent = 100.0 * abs(share) / widest if widest > 0 else 0.0
    bar = f"width:{percent:.0f}%;height:.7em;border-radius:2px;background:{css(FOR if share >= 0 else AGAINST)}"
    grid = "display:grid;grid-template-columns:6.5em 1fr 3.5em;gap:.4em;align-items:center"
    return (
        f'<div style="{grid}"><span style="overflow:hidden;text-overflow:ellipsis">{escape(name)}</span>'
        f'<div style="{bar}"></div>'
        f'<span style="text-align:right;font-variant-numeric:tabular-nums">{share:+.2f}</span></div>'
    )


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
    return note(", ".join(parts))


def note(text: str) -> str:
    """One dimmed line."""
    return f'<div style="padding:.3em .9em;font-size:.78em;{_DIM}">{escape(text)}</div>'


def warning(text: str) -> str:
    """Lines that must not be missed."""
    return f'<div style="margin:.4em .9em;padding:.4em .6em;background:#a33;color:#fff">{escape(text)}</div>'


def number(value: float | None, digits: int = 0) -> str:
    """A number for people: a dash for None and NaN."""
    if value is None or value != value:
        return "&ndash;"
    if value in (float("inf"), float("-inf")):
        return "&infin;" if value > 0 else "-&infin;"
    return f"{value:.{digits}f}"


def _clock(seconds: float) -> str:
    whole = max(0, int(seconds))
    return f"{whole // 60}:{whole % 60:02d}"


def _rounded(value: float) -> int:
    return round(value / 10) * 10 if value > 100 else round(value)
