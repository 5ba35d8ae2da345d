"""Map of where the trade-off exists, over speed, delay, memory of the field and cost of computing.

It is not in the thesis. The limit of every policy is the result without delay: if using all views is close to
it, no scheduler can gain anything.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from edge_server.experiments.common.seed_table import Row, SeedTable, difference
from edge_server.experiments.studies.age_curves import with_mean_delay
from edge_server.experiments.studies.findings import better, better_than_all
from edge_server.experiments.studies.study import Claim, Study, StudyRequest
from edge_server.experiments.studies.trial import (
    Point,
    Trial,
    recording,
    run_points,
    scene_label,
    scenes_here,
    usual_trial,
)
from edge_server.report.style import figure

# Cost of a step and of an update of 18 new views: splat at 64 x 64, warm, two cores (medians of two runs: 2.8
# and 4.0, 66 and 93).
CHARGED = {"ms_per_step": 3.0, "ms_per_update": 70.0}
PERIOD_MS = 30.0
METRIC = "psnr_moving_db"
# Thresholds and waits: one period plus these multiples of the mean delay.
SHARES = {"threshold": (0.5, 1.0, 2.0, 4.0), "wait": (0.5, 1.0, 2.0, 4.0)}
QUICK_SHARES = {"threshold": (0.75, 1.5, 3.0), "wait": (1.0, 2.5)}
AXES = ("scene", "speed", "delay_ms", "field_start", "compute")


def _cells(request: StudyRequest, scene: str) -> Iterator[tuple[float | None, float, str, str]]:
    """Speed, mean delay, start of the field and computing."""
    quick, ours = request.quick, recording(scene) is None
    speeds: tuple[float | None, ...] = (None,)
    if ours:
        speeds = (0.5, 2.0) if quick else (0.3, 1.0, 2.0, 4.0)
    delays: tuple[float, ...] = (30.0, 60.0, 120.0, 240.0)
    if quick:
        delays = (60.0, 150.0) if ours else (60.0,)
    for speed, delay in product(speeds, delays):
        usual = delay == 60.0  # the thesis's mean; a quick pass has one cell of the others
        if usual or not quick:
            yield speed, delay, "scratch", "zero"
        yield speed, delay, "warm", "zero"
        if not quick or (ours and usual):
            yield speed, delay, "warm", "charged"
        if not quick:
            yield speed, delay, "scratch", "charged"


def _cases(request: StudyRequest) -> list[Point]:
    found = []
    (channel,) = request.channels({"ch5": {"preset": "ch5"}}).values()
    for scene in scenes_here(request, ("room", "kitchen")):
        ours = recording(scene) is None
        for cell, seed in product(_cells(request, scene), request.repeats(4 if ours else 3, 12)):
            speed, delay, start, compute = cell
            labels: Row = dict(
                zip(AXES, (scene_label(scene), "own" if speed is None else speed, delay, start, compute))
            )
            base = _trial(request, scene, seed, cell, with_mean_delay(channel, delay))
            found.append(Point({**labels, "policy": "all"}, base))
            for policy, shares in (QUICK_SHARES if request.quick else SHARES).items():
                for omega_ms in (PERIOD_MS + share * delay for share in shares):
                    trial = dataclasses.replace(base, policy=policy, value=omega_ms)
                    found.append(Point({**labels, "policy": policy, "omega_ms": omega_ms}, trial))
            ideal = dataclasses.replace(base, channel={"preset": "ideal"})
            found.append(Point({**labels, "policy": "no delay"}, ideal))
    return found


def _trial(request: StudyRequest, scene: str, seed: int, cell: tuple[Any, ...], channel: Row) -> Trial:
    speed, _, start, compute = cell
    more: Row = {"every_ms": 1500.0} | ({} if speed is None else {"speed_m_per_s": speed})
    base = usual_trial(request, scene, seed=seed, channel=channel, lpips=False, **more)
    if start == "warm":
        base = dataclasses.replace(
            base, scratch=False, settle=2, decisions=3, first_steps=2 * base.steps, steps=base.steps // 3
        )
    return dataclasses.replace(base, compute=CHARGED) if compute == "charged" else base


BEST = {policy: {"policy": policy, "best": "omega_ms"} for policy in SHARES}


def _draw(request: StudyRequest, table: SeedTable) -> None:
    """Draw speed against delay for each scene, colored by the gain of the best policy over use-all."""
    for (scene,) in table.distinct("scene"):
        kinds = list(dict.fromkeys(v[3:] for v in table.distinct(*AXES) if v[0] == scene))
        with figure(request.out / f"phase-{scene}.png", len(kinds), 1, height_inch=2.2) as (_, axes):
            for at, kind in zip(axes[:, 0], kinds):
                cells = [dict(zip(AXES, v)) for v in table.distinct(*AXES) if v[0] == scene and v[3:] == kind]
                _draw_map(at, table, cells, f"{scene}, {kind[0]}, compute {kind[1]}: moving pixels")


def _draw_map(at: Any, table: SeedTable, cells: list[Row], title: str) -> None:
    speeds, delays = (sorted({c[name] for c in cells}, key=str) for name in ("speed", "delay_ms"))
    gains = np.full((len(speeds), len(delays)), np.nan)
    for cell in cells:
        i, j = speeds.index(cell["speed"]), delays.index(cell["delay_ms"])
        use_all = table.runs(METRIC, **cell, policy="all")
        scored = {p: difference(table.best_runs(METRIC, False, **cell, **of), use_all).mean for p, of in BEST.items()}
        name = max(scored, key=lambda p: np.nan_to_num(scored[p], nan=-np.inf))
        gains[i, j] = scored[name]
        limit = difference(table.runs(METRIC, **cell, policy="no delay"), use_all).mean
        words = f"{name if scored[name] > 0 else 'use all'}\n{scored[name]:+.1f} of {limit:+.1f} dB"
        at.text(j, i, words, ha="center", va="center", fontsize=8)
    at.imshow(gains, cmap="PuOr", vmin=-3, vmax=3, aspect="auto", origin="lower")
    at.grid(False)
    at.set_xticks(range(len(delays)), [f"{d:g}" for d in delays])
    at.set_yticks(range(len(speeds)), [str(s) for s in speeds])
    at.set_xlabel("mean delay (ms)")
    at.set_ylabel("speed (m/s)")
    at.set_title(title)


PHASE = Study(
    "phase",
    "Where the trade between age and fidelity exists",
    _cases,
    run_points,
    (METRIC, "psnr_db"),
    (
        Claim(
            "there is something to win: no delay is better.", better({"policy": "no delay"}, {"policy": "all"}), None
        ),
        Claim(
            "giving up stale views (threshold, wait) beats using everything.",
            better_than_all({"policy": "all"}, tuple(BEST.values()), one_suffices=True),
            None,
        ),
    ),
    AXES,
    _draw,
)
