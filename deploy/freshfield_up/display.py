"""What the person at the terminal sees: a live table, or a line now and then where there is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Protocol

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from freshfield_up.resources import Use
from freshfield_up.status import RunStatus, Words, number

LINE_EVERY_S = 5.0
_COLUMNS_FROM = 12
"""From this many cameras on the table has two columns, so that it fits a small terminal."""
_FRESH_MS, _STALE_MS = 250.0, 1000.0


class Display(Protocol):
    def __enter__(self) -> Display: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None: ...

    def say(self, text: str) -> None:
        """A message that stays."""

    def show(self, status: RunStatus, headline: str, use: Mapping[str, Use]) -> None:
        """The state of things as of now."""


def make_display(table: bool) -> Display:
    """The table where stdout is a terminal and it is wanted, else lines."""
    return LiveTable() if table and sys.stdout.isatty() else Lines()


class Lines:
    """Plain lines for logs and pipes."""

    def __init__(self) -> None:
        self._next_s = 0.0

    def __enter__(self) -> Lines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        pass

    def say(self, text: str) -> None:
        print(text, flush=True)

    def show(self, status: RunStatus, headline: str, use: Mapping[str, Use]) -> None:
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


class LiveTable:
    """A table that is redrawn in place; messages scroll above it."""

    def __init__(self, console: Console | None = None) -> None:
        self._live = Live(console=console, auto_refresh=False, transient=False)

    def __enter__(self) -> LiveTable:
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._live.stop()

    def say(self, text: str) -> None:
        self._live.console.print(Text(text))

    def show(self, status: RunStatus, headline: str, use: Mapping[str, Use]) -> None:
        self._live.update(draw(status, headline, use), refresh=True)


def draw(status: RunStatus, headline: str, use: Mapping[str, Use]) -> Group:
    """The whole table as something rich can print."""
    processes = "   ".join(f"{name} {u.cpu:.2f} cores {u.rss_mb:.0f} MB" for name, u in use.items())
    return Group(
        Text(headline, style="bold"),
        _camera_table(status.cameras),
        Text.assemble(("channel  ", "bold"), _channel_line(status.channel)),
        Text.assemble(("field    ", "bold"), _edge_line(status.edge)),
        Text.assemble(("load     ", "bold"), processes or "-"),
    )


def _camera_table(cameras: tuple[Words, ...]) -> Table:
    columns = 2 if len(cameras) >= _COLUMNS_FROM else 1
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


def _camera_cells(camera: Words) -> list[Text]:
    age = number(camera, "age_ms")
    style = "dim" if age is None else "green" if age < _FRESH_MS else "yellow" if age < _STALE_MS else "red"
    name = f"{camera['camera']} (held out)" if camera.get("held_out") else str(camera["camera"])
    if camera.get("connected") is False:
        name += " (no connection)"
    return [
        Text(name),
        Text(_figure(age, ".0f"), style),
        Text(_figure(number(camera, "sent"), ".0f")),
        Text(_figure(number(camera, "delivered"), ".0f")),
    ]


def _channel_line(channel: Words) -> str:
    if not channel:
        return "no channel yet"
    parts = [str(channel.get("preset") or "custom")]
    state = channel.get("state")
    share = number(channel, "state_share", str(state))
    if state:
        parts.append(f"state {state}" + (f" ({share:.0%} of the time)" if share is not None else ""))
    parts.append(f"forwarded {_figure(number(channel, 'counts', 'forwarded'), '.0f')}")
    for fate in ("dropped_busy", "superseded", "skipped", "lost", "broken"):
        if count := number(channel, "counts", fate):
            parts.append(f"{fate.replace('_', ' ')} {count:.0f}")
    parts.append(f"delay error p99 {_figure(number(channel, 'delay_error_ms', 'p99'), '.2f')} ms")
    return ", ".join(parts)


def _edge_line(edge: Words) -> str:
    updates = number(edge, "updates", "count")
    if not updates:
        return str(edge.get("doing") or "no update yet")
    parts = [
        f"{updates:.0f} updates",
        f"{_figure(number(edge, 'updates', 'ms_p50'), '.0f')} ms each",
        f"PSNR {_figure(number(edge, 'scores', 'psnr_db'), '.2f')} dB",
        f"moving {_figure(number(edge, 'scores', 'psnr_moving_db'), '.2f')} dB",
        f"aAoI {_figure(number(edge, 'last', 'aaoi_ms'), '.0f')} ms",
        f"policy {edge.get('policy', '-')}",
    ]
    return ", ".join(parts) + (" (paused)" if edge.get("paused") else "")


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
