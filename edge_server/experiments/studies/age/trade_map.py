"""Map of where the trade-off exists, over speed, delay, memory of the field and cost of computing.

It is not in the thesis. The limit of every policy is the result without delay: if using all views is close to
it, no scheduler can gain anything.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from edge_server.experiments.common.statistics import any_of, at_its_best, optimum, paired
from edge_server.experiments.studies.study import LEAST_DB, Point, Study, StudyRequest, Table, Verdict
from edge_server.experiments.studies.trial import recording
from edge_server.report.style import figure

# Cost of a step and of an update of 18 new views: splat at 64 x 64, warm, two cores (medians of two runs: 2.8
# and 4.0, 66 and 93).
CHARGED = {"ms_per_step": 3.0, "ms_per_update": 70.0}
PERIOD_MS = 30.0
METRIC = "psnr_moving_db"
# Thresholds and waits: one period plus these multiples of the mean delay.
SHARES = {"threshold": (0.5, 1.0, 2.0, 4.0), "wait": (0.5, 1.0, 2.0, 4.0)}
QUICK_SHARES = {"threshold": (0.75, 1.5, 3.0), "wait": (1.0, 2.5)}


@dataclass(frozen=True)
class Cell:
    """A cell of the map; its fields label its rows."""

    scene: str
    speed_m_per_s: float | None
    delay_ms: float
    memory: str
    compute: str

    @property
    def labels(self) -> dict[str, Any]:
        return vars(self)

    @property
    def text(self) -> str:
        speed = "" if self.speed_m_per_s is None else f" at {self.speed_m_per_s:g} m/s"
        return f"{self.scene}{speed}, mean delay {self.delay_ms:g} ms, {self.memory}, compute {self.compute}"


class Phase(Study):
    name = "phase"
    title = "Where the trade between age and fidelity exists"

    def points(self, request: StudyRequest) -> list[Point]:
        found = []
        for cell in self._cells(request):
            ours = recording(cell.scene) is None
            for seed in request.repeats(4 if ours else 3, 12):
                base = self._trial(request, cell, seed)
                for policy, value in self._policies(request, cell.delay_ms):
                    labels = {**cell.labels, "policy": policy, "omega_ms": value}
                    trial = dataclasses.replace(base, policy=policy, value=value)
                    found.append(Point(labels, trial))
                ideal = dataclasses.replace(base, channel={"preset": "ideal"})
                found.append(Point({**cell.labels, "policy": "no delay", "omega_ms": None}, ideal))
        return found

    def _cells(self, request: StudyRequest) -> Iterator[Cell]:
        quick = request.quick
        for scene in request.scenes_here(("room", "kitchen")):
            ours = recording(scene) is None
            speeds: tuple[float | None, ...] = (None,)
            if ours:
                speeds = (0.5, 2.0) if quick else (0.3, 1.0, 2.0, 4.0)
            delays: tuple[float, ...] = (30.0, 60.0, 120.0, 240.0)
            if quick:
                delays = (60.0, 150.0) if ours else (60.0,)
            for speed, delay in product(speeds, delays):
                usual = delay == 60.0  # the thesis's mean; a quick pass has one cell of the others
                if usual or not quick:
                    yield Cell(scene, speed, delay, "scratch", "zero")
                yield Cell(scene, speed, delay, "warm", "zero")
                if not quick or (ours and usual):
                    yield Cell(scene, speed, delay, "warm", "charged")
                if not quick:
                    yield Cell(scene, speed, delay, "scratch", "charged")

    def _trial(self, request: StudyRequest, cell: Cell, seed: int) -> Any:
        channel = {"preset": "ch5", "service": {"law": "exponential", "mean_ms": cell.delay_ms}}
        more: dict[str, Any] = {"every_ms": 1500.0}
        if recording(cell.scene) is None:
            more["speed_m_per_s"] = cell.speed_m_per_s
        base = request.trial(cell.scene, seed=seed, channel=channel, lpips=False, **more)
        if cell.memory == "warm":
            base = dataclasses.replace(
                base, scratch=False, settle=2, decisions=3, first_steps=2 * base.steps, steps=base.steps // 3
            )
        if cell.compute == "charged":
            base = dataclasses.replace(base, compute=CHARGED)
        return base

    def _policies(self, request: StudyRequest, delay_ms: float) -> Iterator[tuple[str, float | None]]:
        yield "all", None
        for policy, shares in (QUICK_SHARES if request.quick else SHARES).items():
            yield from ((policy, PERIOD_MS + share * delay_ms) for share in shares)

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        names = [f.name for f in dataclasses.fields(Cell)]
        cells = list(dict.fromkeys(Cell(*(row[name] for name in names)) for row in table.rows))
        verdicts = []
        for cell in cells:
            for metric, name in (("psnr_moving_db", "moving pixels"), ("psnr_db", "whole image")):
                verdicts += self._judge(table, cell, metric, name)
        self._draw(request, table, cells)
        return verdicts

    def _judge(self, table: Table, cell: Cell, metric: str, name: str) -> list[Verdict]:
        best = {p: _best(table, cell, metric, p) for p in SHARES}
        use_all = table.values(metric, policy="all", **cell.labels)
        limit = table.values(metric, policy="no delay", **cell.labels)
        gap = paired(limit, use_all)
        if not gap.count:
            return []
        nothing = " (nothing to win)" if gap.above(LEAST_DB) is False else ""
        text = [f"no delay is {gap} dB above use-all{nothing}"]
        gains = []
        for policy, (omega, values) in best.items():
            gains.append(gain := paired(values, use_all))
            text.append(f"best {policy} ({omega:g} ms) {gain}")
        about = f"{cell.text}; {name}"
        found = [
            Verdict(
                about,
                "giving up stale views (threshold, wait) beats using everything.",
                "; ".join(text) + " dB.",
                any_of(g.above(LEAST_DB) for g in gains),
                max(gains, key=lambda g: g.mean),
            )
        ]
        return found

    def _draw(self, request: StudyRequest, table: Table, cells: list[Cell]) -> None:
        """Draw speed against delay for each scene, colored by the gain of the best policy over use-all."""
        for scene in table.distinct("scene"):
            mine = [c for c in cells if c.scene == scene]
            kinds = list(dict.fromkeys((c.memory, c.compute) for c in mine))
            with figure(request.out / f"phase-{scene}.png", len(kinds), 1, height_inch=2.2) as (_, axes):
                for at, kind in zip(axes[:, 0], kinds):
                    shown = [c for c in mine if (c.memory, c.compute) == kind]
                    self._draw_map(at, table, shown, f"{scene}, {kind[0]}, compute {kind[1]}: moving pixels")

    def _draw_map(self, at: Any, table: Table, cells: list[Cell], title: str) -> None:
        speeds = sorted({c.speed_m_per_s or 0.0 for c in cells})
        delays = sorted({c.delay_ms for c in cells})
        gains = np.full((len(speeds), len(delays)), np.nan)
        for cell in cells:
            i, j = speeds.index(cell.speed_m_per_s or 0.0), delays.index(cell.delay_ms)
            use_all = table.values(METRIC, policy="all", **cell.labels)
            options = {p: _best(table, cell, METRIC, p) for p in SHARES}
            scored = {f"{p} {o:g} ms": paired(v, use_all).mean for p, (o, v) in options.items()}
            name = max(scored, key=lambda p: np.nan_to_num(scored[p], nan=-np.inf))
            gains[i, j] = scored[name]
            limit = paired(table.values(METRIC, policy="no delay", **cell.labels), use_all).mean
            words = f"{name if scored[name] > 0 else 'use all'}\n{scored[name]:+.1f} of {limit:+.1f} dB"
            at.text(j, i, words, ha="center", va="center", fontsize=8)
        at.imshow(gains, cmap="PuOr", vmin=-3, vmax=3, aspect="auto", origin="lower")
        at.grid(False)
        at.set_xticks(range(len(delays)), [f"{d:g}" for d in delays])
        at.set_yticks(range(len(speeds)), [f"{s:g}" if s else "own" for s in speeds])
        at.set_xlabel("mean delay (ms)")
        at.set_ylabel("speed (m/s)")
        at.set_title(title)


def _best(table: Table, cell: Cell, metric: str, policy: str) -> tuple[float, dict[int, float]]:
    """Best omega of a policy over the seeds, and seed -> value at the omega that the other half chose."""
    curve = table.curve("omega_ms", metric, policy=policy, **cell.labels)
    if not curve:
        return float("nan"), {}
    return optimum(curve).x, at_its_best(curve)
