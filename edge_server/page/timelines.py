"""The last minutes as curves: age, fidelity, cost of an update, the channel's state."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from edge_server.page.colours import FRESH, HELD_OUT, MIDDLE, STALE, UNKNOWN, css
from edge_server.state import CameraView, Publication

WINDOW_S = 120.0
# More points than the chart has pixels would only be sent, never seen.
MAX_POINTS = 300
HEIGHT = 118
_LINE = 1.6


class History:
    """Ages and the channel's state as sampled by the page, also while nobody watches. Bounded."""

    def __init__(self, window_s: float = WINDOW_S, most: int = 1200) -> None:
        self._window_s = window_s
        self._samples: deque[tuple[float, float, float, float]] = deque(maxlen=most)
        self.state_names: list[str] = []

    def sample(self, t_s: float, cameras: Sequence[CameraView], channel: dict | None) -> None:
        """Note the training cameras' mean and worst age and the channel's state at ``t_s``."""
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
        """The state's index among the names seen; NaN where the emulator does not say."""
        state = (channel or {}).get("state")
        if not isinstance(state, str | int):
            return float("nan")
        for name in (channel or {}).get("states", ()):
            if str(name) not in self.state_names:
                self.state_names.append(str(name))
        if str(state) not in self.state_names:
            self.state_names.append(str(state))
        return float(self.state_names.index(str(state)))


class Timelines:
    """Four charts in the present GUI container. ``refresh`` is called about once a second."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._age = _chart(gui, "Age of the newest frames, ms", ("mean", FRESH), ("worst", STALE),
                           ("omega", UNKNOWN))  # fmt: skip
        self._psnr = _chart(gui, "Fidelity at the present, dB", ("PSNR", HELD_OUT), ("moving pixels", MIDDLE))
        self._cost = _chart(gui, "Cost of an update, ms", ("update", UNKNOWN))
        self._channel = _chart(gui, "State of the channel", ("state", MIDDLE), stepped=True)

    def refresh(self, history: History, publications: Sequence[Publication]) -> None:
        """Redraw the last WINDOW_S seconds of what there is."""
        t, mean, worst, state = history.columns()
        now = float(t[-1]) if len(t) else 0.0
        recent = [p for p in publications if p.t_s > now - WINDOW_S]
        omega = _held(t, [(p.t_s, p.omega_ms) for p in recent])
        _draw(self._age, _thin(t, mean, worst, omega))
        scored = [p for p in recent if p.psnr_db is not None and np.isfinite(p.psnr_db)]
        _draw(self._psnr, _thin(_column(p.t_s for p in scored), _column(p.psnr_db for p in scored),
                                _column(p.psnr_moving_db for p in scored)))  # fmt: skip
        _draw(self._cost, _thin(_column(p.t_s for p in recent), _column(p.update_ms for p in recent)))
        known = np.isfinite(state)
        _draw(self._channel, _thin(*_steps(t[known], state[known])))
        names = history.state_names
        title = f"State of the channel: {', '.join(f'{i} {n}' for i, n in enumerate(names))}"
        if names and self._channel.title != title:
            self._channel.title = title


def _chart(gui: viser.GuiApi, title: str, *lines: tuple[str, tuple], stepped: bool = False) -> Any:
    series: list[Any] = [{"label": "s"}]
    for label, colour in lines:
        one: dict[str, Any] = {"label": label, "stroke": css(colour), "width": _LINE, "points": {"show": False}}
        if stepped:
            one["fill"] = css(colour) + "30"
        series.append(one)
    axes: tuple[Any, ...] = ({"size": 22, "font": "10px sans-serif"}, {"size": 40, "font": "10px sans-serif"})
    return gui.add_uplot(
        data=tuple(np.array([0.0, 1.0]) for _ in series), series=tuple(series), title=title, height=HEIGHT,
        scales={"x": {"time": False}}, axes=axes, legend={"show": len(lines) > 1, "live": False},
        cursor={"y": False}, padding=(0, 10, 0, 0), visible=False,
    )  # fmt: skip


def _draw(chart: Any, data: tuple[NDArray, ...]) -> None:
    """Show the curves once there are two points to connect."""
    if len(data[0]) < 2:
        return
    chart.data = data
    chart.visible = True


def _column(values: Any) -> NDArray:
    return np.array([np.nan if v is None else float(v) for v in values], dtype=np.float64)


def _thin(*columns: NDArray) -> tuple[NDArray, ...]:
    """At most MAX_POINTS rows, the last one kept; an infinity becomes a gap."""
    step = max(1, -(-len(columns[0]) // MAX_POINTS))
    picked = tuple(np.ascontiguousarray(c[::-1][::step][::-1], dtype=np.float64) for c in columns)
    return tuple(np.where(np.isfinite(c), c, np.nan) for c in picked)


def _held(t: NDArray, events: Sequence[tuple[float, float | None]]) -> NDArray:
    """Value in force at each t: that of the latest event before it, NaN before the first."""
    if not events:
        return np.full(len(t), np.nan)
    values = np.concatenate([[np.nan], _column(v for _, v in events)])
    return values[np.searchsorted(_column(s for s, _ in events), t, side="right")]


def _steps(t: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Corners of a staircase: each value holds until the next sample."""
    if len(t) < 2:
        return t, y
    return np.repeat(t, 2)[1:], np.repeat(y, 2)[:-1]
