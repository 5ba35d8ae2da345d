"""The trade-off of accuracy against time, as ``edge-server frontier`` measured it: for the page, the report and the
recommended update time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from edge_server.live import live_constants as tuned
from edge_server.run_records import Frontier, FrontierPoint
from edge_server.settings import EdgeConfig
from freshfield.scenario import Scenario
from freshfield.untrusted import read_json, read_text


def read_frontier(path: Path | None, representation: str, layers: bool = False) -> list[FrontierPoint]:
    """The points of one representation, measured on moving scenes.

    path: a frontier.json of ``edge-server frontier``; None: the shipped one.
    layers: whether to read the points of that representation in layers, or those without layers.
    If an earlier version did not measure fidelity as shown, a point has the PSNR as published.
    Raises ValueError for another kind of file, or one without such points.
    """
    source = path if path is not None else resources.files("edge_server").joinpath("frontier.json")
    try:
        data = read_json(source.read_text() if path is None else read_text(path))
        rows = [
            row
            for row in data["updates"]
            if row["field"] == representation and bool(row["options"].get("layers")) == layers
        ]
        points = points_of(rows)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{source}: not a frontier that `edge-server frontier` wrote ({error})") from None
    if not points:
        named = f"{representation} in layers" if layers else representation
        raise ValueError(
            f"{source}: nothing was measured there for {named} on a moving scene; "
            f"run `edge-server frontier --field {representation}` and name its frontier.json"
        )
    return points


def points_of(rows: Sequence[Mapping[str, Any]]) -> list[FrontierPoint]:
    """The points of a frontier.json's ``updates``, without those that have no score of moving pixels.
    Raises KeyError, TypeError or ValueError for an invalid row."""
    return [
        FrontierPoint(
            speed_m_per_s=float(row["speed_m_per_s"]),
            update_ms=float(row["update_s"]) * 1e3,
            psnr_db=float(row[f"{by}psnr_db"]),
            psnr_moving_db=float(row[f"{by}psnr_moving_db"]),
            error_db=0.5 * sum(row.get(f"{by}{k}_error") or 0.0 for k in ("psnr_db", "psnr_moving_db")),
            measured="shown" if by else "published",
        )
        for row in rows
        for by in ("shown_" if "shown_psnr_db" in row else "",)
        if row[f"{by}psnr_moving_db"] is not None
    ]


def best_point(points: Sequence[FrontierPoint], speed_m_per_s: float = tuned.USUAL_SPEED_M_PER_S) -> FrontierPoint:
    """The best of the points measured at the speed nearest to ``speed_m_per_s``.

    More time is not always better, because moving objects age meanwhile. Of the points within the standard
    error of the best, the fastest is taken.
    """
    candidates = _at_nearest_speed(points, speed_m_per_s)
    best = max(candidates, key=lambda p: p.mean_db)
    candidates = [p for p in candidates if best.mean_db - p.mean_db <= math.hypot(best.error_db, p.error_db)]
    return min(candidates, key=lambda p: (p.update_ms, -p.mean_db))


def _at_nearest_speed(points: Sequence[FrontierPoint], speed_m_per_s: float) -> list[FrontierPoint]:
    """Those measured at the speed nearest in ratio."""

    def distance(p: FrontierPoint) -> float:
        return abs(math.log(max(p.speed_m_per_s, 1e-3) / max(speed_m_per_s, 1e-3)))

    nearest = min(map(distance, points))
    return [p for p in points if distance(p) == nearest]


def open_frontier(scenario: Scenario, config: EdgeConfig) -> Frontier:
    """The frontier that a scenario names, else the shipped one. Raises ValueError if the named one cannot be
    read or has no points for the scenario's field."""
    path = None if config.frontier is None else scenario.path.parent / config.frontier
    speed = float(scenario.source.get("speed_m_per_s", tuned.USUAL_SPEED_M_PER_S))
    try:
        points = read_frontier(path, config.field, bool(config.field_options.get("layers")))
    except ValueError as error:
        if path is not None:
            raise
        return Frontier([], str(error))
    points = _at_nearest_speed(points, speed)
    file = config.frontier or "the shipped frontier.json, of room"
    first = points[0]
    return Frontier(points, f"{file}, at {first.speed_m_per_s:g} m/s, as {first.measured}")
