"""How long the next update may fit: a fixed time, or whatever keeps the whole update within a deadline.

An update is more than its fit: frames are decoded, views packed, the field copied for those who look at it,
and on a busy machine a step ends late. ``Deadline`` watches what that came to and leaves so much room.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

from edge_server.fields import Budget

# The rest of an update is taken to be as long as the longest of the last 64 was: without a trend, the next is
# longer once in 65 times. Load comes in bursts, so fewer misses than one in 20 are aimed at; what a hiccup
# costs is 64 updates that are shorter by it.
_WINDOW = 64
_MARGIN_MS = 1.0
# Below this a fit is not worth the decoding of its views.
_LEAST_MS = 10.0
# Until an update was measured: the share of the deadline that is not spent fitting.
_FIRST_RESERVE = 0.2


class Pacing(Protocol):
    """What the loop asks before an update, and tells after it."""

    def budget(self) -> Budget: ...

    def done(self, budget: Budget, update_ms: float) -> None: ...


@dataclass(frozen=True)
class Fixed:
    """Every update may fit for the same time, whatever else it takes."""

    fit_ms: float

    def budget(self) -> Budget:
        return Budget(seconds=self.fit_ms / 1e3)

    def done(self, budget: Budget, update_ms: float) -> None:
        pass


@dataclass
class Deadline:
    """From decision to publication in ``deadline_ms``; ``fit_ms``: longest fit worth making.

    met, missed: updates so far. ValueError for a deadline that leaves no time to fit.
    """

    deadline_ms: float
    fit_ms: float = math.inf
    met: int = 0
    missed: int = 0
    _rest_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))

    def __post_init__(self) -> None:
        if not self.deadline_ms >= 2 * _LEAST_MS:
            raise ValueError(f"deadline_ms: expected {2 * _LEAST_MS:g} or more, got {self.deadline_ms:g}")

    def budget(self) -> Budget:
        """What the next fit may spend: the deadline less what the rest of an update takes."""
        if self._rest_ms:
            reserve = max(self._rest_ms) + _MARGIN_MS
        else:
            reserve = _FIRST_RESERVE * self.deadline_ms
        return Budget(seconds=max(_LEAST_MS, min(self.deadline_ms - reserve, self.fit_ms)) / 1e3)

    def done(self, budget: Budget, update_ms: float) -> None:
        """An update of ``budget`` took ``update_ms`` from its decision to its publication."""
        assert budget.seconds is not None
        self._rest_ms.append(update_ms - budget.seconds * 1e3)
        if update_ms <= self.deadline_ms:
            self.met += 1
        else:
            self.missed += 1


@dataclass(frozen=True)
class Point:
    """One measured way to spend an update, and the fidelity at the present it led to.

    options: of the field (its effort). update_ms: from decision to publication. psnr_db: whole image;
    psnr_moving_db: where the scene moves. error_db: standard error of their mean, at most; 0 of one seed.
    """

    effort: str
    options: dict[str, Any]
    speed_m_per_s: float
    update_ms: float
    psnr_db: float
    psnr_moving_db: float
    error_db: float = 0.0

    @property
    def worth_db(self) -> float:
        """The mean of both: the whole image of a mostly still scene alone would hide what age costs."""
        return 0.5 * (self.psnr_db + self.psnr_moving_db)


def read_points(path: Path | None, representation: str) -> list[Point]:
    """The moving-scene points of a ``frontier.json`` (``edge-server frontier``), for one representation;
    None: those measured once and shipped. ValueError where the file is none or knows nothing of it."""
    source = path if path is not None else resources.files("edge_server").joinpath("frontier.json")
    try:
        data = json.loads(source.read_text())
        rows: Sequence[Mapping[str, Any]] = data["updates"]
        points = [
            Point(
                effort=row["effort"],
                options=dict(row["options"]),
                speed_m_per_s=float(row["speed_m_per_s"]),
                update_ms=float(row["update_s"]) * 1e3,
                psnr_db=float(row["psnr_db"]),
                psnr_moving_db=float(row["psnr_moving_db"]),
                error_db=0.5 * sum(row.get(f"{k}_error") or 0.0 for k in ("psnr_db", "psnr_moving_db")),
            )
            for row in rows
            if row["field"] == representation and row["psnr_moving_db"] is not None
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{source}: not a frontier that `edge-server frontier` wrote ({error})") from None
    if not points:
        raise ValueError(
            f"{source}: nothing was measured there for {representation} on a moving scene; "
            f"run `edge-server frontier --field {representation}` and name its frontier.json"
        )
    return points


def choose(points: Sequence[Point], deadline_ms: float, speed_m_per_s: float) -> Point:
    """The best point that fits the deadline, measured at the speed nearest to the scene's; the quickest one
    where none fits. More time is not always better: what moves grows old meanwhile. Of points that cannot be
    told from the best one by their seeds, the quickest."""

    def off(p: Point) -> float:
        return abs(math.log(max(p.speed_m_per_s, 1e-3) / max(speed_m_per_s, 1e-3)))

    nearest = min(off(p) for p in points)
    here = [p for p in points if off(p) == nearest]
    fitting = [p for p in here if p.update_ms <= deadline_ms]
    if fitting:
        best = max(fitting, key=lambda p: p.worth_db)
        here = [p for p in fitting if best.worth_db - p.worth_db <= math.hypot(best.error_db, p.error_db)]
    return min(here, key=lambda p: (p.update_ms, -p.worth_db))
