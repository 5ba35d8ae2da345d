"""The display of a run: a live table on a terminal, else a line every few seconds."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Self

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from freshfield.scenario import NOTHING_HELD_OUT
from freshfield_up.resources import ResourceUse
from freshfield_up.status import RunStatus, Status, fmt, number

LINE_EVERY_S = 5.0
# From this many cameras on, the table has two columns to fit a small terminal.
_TWO_COLUMNS_FROM = 12
_FRESH_MS, _STALE_MS = 250.0, 1000.0


class Display:
    """Plain lines, for logs and pipes. A context manager."""

    def __init__(self) -> None:
        self._next_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def message(self, text: str) -> None:
        """Print a message that stays."""
        print(text, flush=True)

    def update(self, status: RunStatus, headline: str, use: Mapping[str, ResourceUse]) -> None:
        """Show the current state of the run. use: by process name."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + LINE_EVERY_S
        ages = sorted(age for camera in status.cameras if (age := number(camera, "age_ms")) is not None)
        print(
            f"[{headline.split('   ')[0]}] {len(ages)}/{len(status.cameras)} cameras"
            f"{f', age {ages[len(ages) // 2]:.0f} ms (median)' if ages else ''}; "
            f"{_edge_line(status.edge)}; {_channel_line(status.channel)}",
            flush=True,
        )


class LiveTable(Display):
    """A table that is redrawn in place; messages scroll above it."""

    def __init__(self, console: Console | None = None) -> None:
        self._live = Live(console=console, auto_refresh=False, transient=False)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def message(self, text: str) -> None:
        self._live.console.print(Text(text))

    def update(self, status: RunStatus, headline: str, use: Mapping[str, ResourceUse]) -> None:
        self._live.update(draw(status, headline, use), refresh=True)


def make_display(table: bool) -> Display:
    """A live table if ``table`` is true and stdout is a terminal, else plain lines."""
    return LiveTable() if table and sys.stdout.isatty() else Display()


def draw(status: RunStatus, headline: str, use: Mapping[str, ResourceUse]) -> Group:
    """The whole table as a rich renderable."""
    processes = "   ".join(f"{name} {u.cpu:.2f} cores {u.rss_mb:.0f} MB" for name, u in use.items())
    return Group(
        Text(headline, style="bold"),
        _camera_table(status.cameras),
        Text.assemble(("channel  ", "bold"), _channel_line(status.channel)),
        Text.assemble(("field    ", "bold"), _edge_line(status.edge)),
        Text.assemble(("load     ", "bold"), processes or "-"),
    )


def _camera_table(cameras: tuple[Status, ...]) -> Table:
    columns = 2 if len(cameras) >= _TWO_COLUMNS_FROM else 1
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for _ in range(columns):
        table.add_column("camera", no_wrap=True)
        table.add_column("age ms", justify="right")
        table.add_column("sent", justify="right")
        table.add_column("arrived", justify="right")
    rows = -(-len(cameras) // columns)
    for row in range(rows):
        cells: list[Text] = []
        for column in range(columns):
            index = column * rows + row
            cells += _camera_cells(cameras[index]) if index < len(cameras) else [Text()] * 4
        table.add_row(*cells)
    return table


def _camera_cells(camera: Status) -> list[Text]:
    age = number(camera, "age_ms")
    style = "dim" if age is None else "green" if age < _FRESH_MS else "yellow" if age < _STALE_MS else "red"
    name = f"{camera['camera']} (held out)" if camera.get("held_out") else str(camera["camera"])
    if camera.get("connected") is False:
        name += " (no connection)"
    return [
        Text(name),
        Text(fmt(age, ".0f"), style),
        Text(fmt(number(camera, "sent"), ".0f")),
        Text(fmt(number(camera, "delivered"), ".0f")),
    ]


def _channel_line(channel: Status) -> str:
    if not channel:
        return "no channel yet"
    parts = [str(channel.get("preset") or "custom")]
    state = channel.get("state")
    share = number(channel, "state_share", str(state))
    if state:
        parts.append(f"state {state}" + (f" ({share:.0%} of the time)" if share is not None else ""))
    parts.append(f"forwarded {fmt(number(channel, 'counts', 'forwarded'), '.0f')}")
    for fate in ("dropped_busy", "superseded", "skipped", "lost", "broken"):
        if count := number(channel, "counts", fate):
            parts.append(f"{fate.replace('_', ' ')} {count:.0f}")
    parts.append(f"delay error p99 {fmt(number(channel, 'delay_error_ms', 'p99'), '.2f')} ms")
    return ", ".join(parts)


def _edge_line(edge: Status) -> str:
    updates = number(edge, "updates", "count")
    if not updates:
        return str(edge.get("doing") or "no update yet")
    views = f" on {NOTHING_HELD_OUT}" if (edge.get("scores") or {}).get("on") == "selected" else ""
    parts = [
        f"{updates:.0f} updates",
        f"{fmt(number(edge, 'updates', 'ms_p50'), '.0f')} ms each",
        f"PSNR {fmt(number(edge, 'scores', 'psnr_db'), '.2f')} dB{views}",
        f"moving {fmt(number(edge, 'scores', 'psnr_moving_db'), '.2f')} dB",
        f"aAoI {fmt(number(edge, 'last', 'aaoi_ms'), '.0f')} ms",
        f"policy {edge.get('policy', '-')}",
    ]
    return ", ".join(parts) + (" (paused)" if edge.get("paused") else "")
