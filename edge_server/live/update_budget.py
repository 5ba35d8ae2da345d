"""How long the next update may fit: a fixed time, or what keeps the whole update within a deadline.

An update is more than its fit: frames are decoded, views packed, the field copied for its readers, and on a
busy machine a step ends late. ``UpdateBudget`` measures this overhead and reserves time for it.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from edge_server.config import EdgeConfig
from edge_server.fields import Budget
from freshfield.scenario import Scenario
from freshfield.untrusted import read_json

log = logging.getLogger(__name__)

# The reserve is the longest overhead of the last 64 updates: without a trend, the next one is longer once in
# 65 times. Load comes in bursts, so the aim is fewer misses than one in 20. The price: after one slow update,
# 64 updates fit for less time.
_WINDOW = 64
_MARGIN_MS = 1.0
# A shorter fit is not worth the decoding of its views.
_LEAST_MS = 10.0
# Share of the deadline that is reserved before the first update has been measured.
_FIRST_RESERVE = 0.2
# Assumed of a scene whose speed is not given: a person walking.
_USUAL_SPEED_M_PER_S = 1.0


@dataclass
class UpdateBudget:
    """Sets the fitting time of each update.

    fit_ms: without a deadline, the time of every fit, however long the rest of the update takes; with one,
    the longest fit that is worth its time.
    deadline_ms: longest time from decision to publication; None: no deadline. ValueError if it leaves no time
    to fit.
    """

    fit_ms: float = math.inf
    deadline_ms: float | None = None
    _overhead_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))

    def __post_init__(self) -> None:
        if self.deadline_ms is not None and not self.deadline_ms >= 2 * _LEAST_MS:
            raise ValueError(f"deadline_ms: expected {2 * _LEAST_MS:g} or more, got {self.deadline_ms:g}")

    def next(self) -> Budget:
        """What the next fit may spend."""
        if self.deadline_ms is None:
            return Budget(seconds=self.fit_ms / 1e3)
        if self._overhead_ms:
            reserve = max(self._overhead_ms) + _MARGIN_MS
        else:
            reserve = _FIRST_RESERVE * self.deadline_ms
        return Budget(seconds=max(_LEAST_MS, min(self.deadline_ms - reserve, self.fit_ms)) / 1e3)

    def record(self, budget: Budget, update_ms: float) -> None:
        """Record that an update with ``budget`` took ``update_ms`` from its decision to its publication."""
        assert budget.seconds is not None
        self._overhead_ms.append(update_ms - budget.seconds * 1e3)


@dataclass(frozen=True)
class FrontierPoint:
    """A measured setting of updates, and the fidelity with it.

    effort, options: name and field options of the setting.
    speed_m_per_s: speed of what moves in the scene it was measured on.
    update_ms: time from decision to publication; for a field in layers, from one update to the next.
    psnr_db, psnr_moving_db: PSNR of the whole image, and of the pixels where the scene moves.
    error_db: upper bound of the standard error of their mean; 0 with one seed.
    measured: what the PSNR was measured on, what was "shown" or (earlier versions) what was "published".
    """

    effort: str
    options: dict[str, Any]
    speed_m_per_s: float
    update_ms: float
    psnr_db: float
    psnr_moving_db: float
    error_db: float = 0.0
    measured: str = "shown"

    @property
    def mean_db(self) -> float:
        """Mean of both: the whole image of a mostly static scene alone would hide what age costs."""
        return 0.5 * (self.psnr_db + self.psnr_moving_db)


def read_frontier(path: Path | None, representation: str, layers: bool = False) -> list[FrontierPoint]:
    """The points of one representation, measured on moving scenes.

    path: a frontier.json of ``edge-server frontier``; None: the shipped one.
    layers: whether to read the points of that representation in layers, or those without layers.
    Where an earlier version did not measure what was shown, a point has the PSNR of what was published.
    Raises ValueError for another kind of file, or one without such points.
    """
    source = path if path is not None else resources.files("edge_server").joinpath("frontier.json")
    try:
        data = read_json(source.read_text())
        rows: Sequence[Mapping[str, Any]] = data["updates"]
        points = [
            FrontierPoint(
                effort=row["effort"],
                options=dict(row["options"]),
                speed_m_per_s=float(row["speed_m_per_s"]),
                update_ms=float(row["update_s"]) * 1e3,
                psnr_db=float(row[f"{by}psnr_db"]),
                psnr_moving_db=float(row[f"{by}psnr_moving_db"]),
                error_db=0.5 * sum(row.get(f"{by}{k}_error") or 0.0 for k in ("psnr_db", "psnr_moving_db")),
                measured="shown" if by else "published",
            )
            for row in rows
            for by in ("shown_" if "shown_psnr_db" in row else "",)
            if row["field"] == representation and bool(row["options"].get("layers")) == layers
            if row[f"{by}psnr_moving_db"] is not None
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{source}: not a frontier that `edge-server frontier` wrote ({error})") from None
    if not points:
        named = f"{representation} in layers" if layers else representation
        raise ValueError(
            f"{source}: nothing was measured there for {named} on a moving scene; "
            f"run `edge-server frontier --field {representation}` and name its frontier.json"
        )
    return points


def best_point(points: Sequence[FrontierPoint], deadline_ms: float, speed_m_per_s: float) -> FrontierPoint:
    """The best point within the deadline, among those measured at the speed nearest to ``speed_m_per_s``.

    More time is not always better: what moves ages meanwhile. Of the points that are within the standard
    error of the best, the fastest is taken. If none meets the deadline, it is the fastest of all.
    """
    candidates = _at_nearest_speed(points, speed_m_per_s)
    fitting = [p for p in candidates if p.update_ms <= deadline_ms]
    if fitting:
        best = max(fitting, key=lambda p: p.mean_db)
        candidates = [p for p in fitting if best.mean_db - p.mean_db <= math.hypot(best.error_db, p.error_db)]
    return min(candidates, key=lambda p: (p.update_ms, -p.mean_db))


def _at_nearest_speed(points: Sequence[FrontierPoint], speed_m_per_s: float) -> list[FrontierPoint]:
    """Those measured at the speed nearest in ratio."""

    def distance(p: FrontierPoint) -> float:
        return abs(math.log(max(p.speed_m_per_s, 1e-3) / max(speed_m_per_s, 1e-3)))

    nearest = min(map(distance, points))
    return [p for p in points if distance(p) == nearest]


@dataclass(frozen=True)
class Frontier:
    """What accuracy costs in time, as measured for the field of a run.

    points: points at the measured speed nearest to ``speed_m_per_s``, the speed of the run's scene.
    about: which file they come from, or why there are none.
    """

    points: tuple[FrontierPoint, ...]
    speed_m_per_s: float
    about: str

    def best(self, deadline_ms: float, effort: str | None = None) -> FrontierPoint | None:
        """The best point within the deadline (``best_point``), of one effort if given; None: none known."""
        points = [p for p in self.points if effort in (None, p.effort)]
        return best_point(points, deadline_ms, self.speed_m_per_s) if points else None


def open_frontier(scenario: Scenario, config: EdgeConfig) -> Frontier:
    """The frontier that a scenario names, else the shipped one. Raises ValueError if it cannot be read or has
    no points for the scenario's field; for the shipped one only if the scenario sets a deadline."""
    path = None if config.frontier is None else scenario.path.parent / config.frontier
    speed = float(scenario.source.get("speed_m_per_s", _USUAL_SPEED_M_PER_S))
    try:
        points = read_frontier(path, config.field, bool(config.field_options.get("layers")))
    except ValueError as error:
        if config.deadline_ms is not None or path is not None:
            raise
        return Frontier((), speed, str(error))
    points = _at_nearest_speed(points, speed)
    file = config.frontier or "the shipped frontier.json, of room"
    first = points[0]
    return Frontier(tuple(points), speed, f"{file}, at {first.speed_m_per_s:g} m/s, as {first.measured}")


def open_budget(
    frontier: Frontier, config: EdgeConfig, deadline_ms: float | None, effort: str | None = None
) -> UpdateBudget:
    """The budget of updates with a deadline, or without one.

    effort: the level that the field has; None: any. ValueError: the deadline leaves no time to fit.
    """
    if deadline_ms is None:
        return UpdateBudget(config.update_ms)
    point = frontier.best(deadline_ms, effort)
    return UpdateBudget(math.inf if point is None else point.update_ms, deadline_ms)


def options_for(frontier: Frontier, config: EdgeConfig) -> dict[str, Any]:
    """The field's options: those of the best point within a deadline, overridden by the scenario's own."""
    point = None if config.deadline_ms is None else frontier.best(config.deadline_ms)
    if config.deadline_ms is None or point is None:
        return config.field_options
    log.info(
        "deadline of %g ms: %s effort, updates of %.0f ms (measured at %g m/s: %.1f dB %s, %.1f moving)",
        config.deadline_ms,
        point.effort,
        point.update_ms,
        point.speed_m_per_s,
        point.psnr_db,
        point.measured,
        point.psnr_moving_db,
    )
    if point.update_ms > config.deadline_ms:
        log.warning("no measured update is as short as that: updates do what fits")
    return {**point.options, **config.field_options}
