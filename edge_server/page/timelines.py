"""Charts of the last minutes: age and omega, fidelity, the channel's state."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import viser
from numpy.typing import NDArray

from edge_server.fidelity.scorer import fidelity_title
from edge_server.live.state import CameraView, Publication
from edge_server.page.colors import FRESH, HELD_OUT, MIDDLE, RGB, STALE, UNKNOWN, css
from edge_server.page.markup import html
from edge_server.page.page_constants import CHART_HEIGHT_PX, CHART_LINE_PX, CHART_POINTS, CHART_SAMPLES, WINDOW_S

STATE_WORDS = {"low": "good", "high": "bad"}
"""Display names of the thesis's network states, low and high traffic."""


class History:
    """Ages and the channel's state, sampled by the page with or without visitors: at most the last
    ``window_s`` seconds and ``most`` samples."""

    def __init__(self, window_s: float = WINDOW_S, most: int = CHART_SAMPLES) -> None:
        self._window_s = window_s
        self._samples: deque[tuple[float, float, float, float]] = deque(maxlen=most)
        self.state_names: list[str] = []

    def sample(self, t_s: float, cameras: Sequence[CameraView], channel: dict | None) -> None:
        """Record the training cameras' mean and worst age and the channel's state at ``t_s``."""
        ages = [c.age_ms for c in cameras if not c.held_out and c.age_ms is not None]
        mean, worst = (float(np.mean(ages)), float(np.max(ages))) if ages else (np.nan, np.nan)
        if self._samples and t_s <= self._samples[-1][0]:
            return  # a chart's x axis must increase
        self._samples.append((t_s, mean, worst, self._state_number(channel)))
        while self._samples[0][0] < t_s - self._window_s:
            self._samples.popleft()

    def columns(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """t_s, mean age, worst age (ms), state number; NaN where unknown."""
        data = np.array(self._samples, dtype=np.float64).reshape(-1, 4)
        return data[:, 0], data[:, 1], data[:, 2], data[:, 3]

    def _state_number(self, channel: dict | None) -> float:
        """Index of the state in the emulator's list, or in the order in which states were seen; their mean if
        each camera has its own chain; NaN if the emulator does not report it."""
        channel = channel or {}
        for name in _names(channel.get("states")):
            self._index(name)
        by_camera = channel.get("by_camera")
        chains = by_camera.values() if isinstance(by_camera, dict) else ()
        states = [channel.get("state"), *(chain.get("state") for chain in chains if isinstance(chain, dict))]
        numbers = [self._index(str(state)) for state in states if isinstance(state, str | int)]
        return float(np.mean(numbers)) if numbers else float("nan")

    def _index(self, name: str) -> int:
        if name not in self.state_names:
            self.state_names.append(name)
        return self.state_names.index(name)


def _names(states: Any) -> list[str]:
    return [str(name) for name in states] if isinstance(states, list | tuple) else []


class Timelines:
    """Three charts in the current GUI container. ``refresh`` is called about once a second."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._age = _Chart(
            gui, "Age of the newest frames, ms", (("mean", FRESH), ("worst", STALE), ("omega", UNKNOWN)), zero=True
        )
        self._psnr = _Chart(gui, "", (("PSNR", HELD_OUT), ("moving", MIDDLE)))
        self._channel = _Chart(gui, "Channel", (("state", MIDDLE),), zero=True, stepped=True)

    def refresh(self, history: History, publications: Sequence[Publication]) -> None:
        """Redraw the last WINDOW_S seconds."""
        t, mean, worst, state = history.columns()
        now = float(t[-1]) if len(t) else 0.0
        recent = [p for p in publications if p.t_s > now - WINDOW_S]
        omega = _latest_value(t, [(p.t_s, p.omega_ms) for p in recent])
        self._age.draw(t, mean, worst, omega)
        scored = [p for p in recent if p.psnr_db is not None]
        where = fidelity_title(p.scored_on for p in scored)
        self._psnr.title = f"{where}, dB"
        self._psnr.draw(
            _column(p.t_s for p in scored),
            _column(p.psnr_db for p in scored),
            _column(p.psnr_moving_db for p in scored),
        )
        names = ", ".join(f"{i} {STATE_WORDS.get(name, name)}" for i, name in enumerate(history.state_names))
        self._channel.draw(t, state, remark=names)


class _Chart:
    """A caption with the lines' colors, and the chart once there are two points.

    uPlot treats NaN as a number and then finds no range for its axis. So gaps are filled with the value
    before them, and the chart is rebuilt without lines that have no values.
    """

    def __init__(
        self, gui: viser.GuiApi, title: str, lines: Sequence[tuple[str, RGB]], zero: bool = False, stepped: bool = False
    ) -> None:
        self._gui, self.title, self._lines = gui, title, lines
        self._zero, self._stepped = zero, stepped
        self._caption = gui.add_html("", visible=False)
        self._place = gui.add_folder(None)
        self._shown: tuple[int, ...] = ()
        self._chart: Any = None

    def draw(self, t: NDArray, *curves: NDArray, remark: str = "") -> None:
        """Show curves (N,) over increasing t (N,) seconds, where the first curve has values."""
        known = np.isfinite(curves[0])
        if known.sum() < 2:
            return
        kept = _decimate(t[known], *(c[known] for c in curves))
        shown = tuple(i for i, c in enumerate(kept[1:]) if np.isfinite(c).any())
        data = (kept[0], *(_forward_fill(kept[1 + i]) for i in shown))
        if self._stepped:
            data = _stairs(*data)
        if shown != self._shown:
            self._shown = shown
            if self._chart is not None:
                self._chart.remove()
            with self._place:
                self._chart = self._make([self._lines[i] for i in shown], data)
        else:
            self._chart.data = data
        self._caption.content = html("chart_caption", self.title, [self._lines[i] for i in shown], remark)
        self._caption.visible = True

    def _make(self, lines: Sequence[tuple[str, RGB]], data: tuple[NDArray, ...]) -> Any:
        series: list[Any] = [{"label": "s"}]
        for label, color in lines:
            line: dict[str, Any] = {"label": label, "stroke": css(color), "width": CHART_LINE_PX}
            line |= {"points": {"show": False}}
            series.append(line | ({"fill": css(color) + "30"} if self._stepped else {}))
        axis: dict[str, Any] = {"font": "10px sans-serif", "gap": 3, "ticks": {"size": 3}}
        scales: dict[str, Any] = {"x": {"time": False}}
        if self._zero:
            scales["y"] = {"range": (0.0, None)}
        return self._gui.add_uplot(
            data=data,
            series=tuple(series),
            height=CHART_HEIGHT_PX,
            scales=scales,
            axes=cast(Any, ({"size": 22} | axis, {"size": 38, "space": 22} | axis)),
            legend={"show": False},
            padding=(6, 10, 0, 0),
        )


def _column(values: Any) -> NDArray:
    return np.array([np.nan if v is None else float(v) for v in values], dtype=np.float64)


def _decimate(*columns: NDArray) -> tuple[NDArray, ...]:
    """At most CHART_POINTS rows, the last one kept."""
    step = max(1, -(-len(columns[0]) // CHART_POINTS))
    return tuple(np.ascontiguousarray(c[::-1][::step][::-1], dtype=np.float64) for c in columns)


def _forward_fill(values: NDArray) -> NDArray:
    """Fill gaps with the value before them, a leading gap with the first value. One must be finite."""
    known = np.flatnonzero(np.isfinite(values))
    place = np.searchsorted(known, np.arange(len(values)), side="right") - 1
    return values[known[np.maximum(place, 0)]]


def _latest_value(t: NDArray, events: Sequence[tuple[float, float | None]]) -> NDArray:
    """The value of the latest event (t, value) before each t; NaN before the first."""
    if not events:
        return np.full(len(t), np.nan)
    values = np.concatenate([[np.nan], _column(v for _, v in events)])
    return values[np.searchsorted(_column(s for s, _ in events), t, side="right")]


def _stairs(t: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Corners of a step function: each value holds until the next sample."""
    return np.repeat(t, 2)[1:], np.repeat(y, 2)[:-1]
