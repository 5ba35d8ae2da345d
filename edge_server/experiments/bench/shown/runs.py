"""Runs of ``bench shown``: as deployed, with free computing, and with nothing late.

``layers`` is the splat field in layers on arrivals, with a decision every 20 ms; ``before`` is the same field
without layers, in cycles of 250 ms. Computing is charged as measured on one core: an update of layers by the
part times of the run in which nothing is late, without the training and the renderings of the static field,
which another core does; a cycle by the costs in docs/studies.md.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from edge_server.experiments.bench.run import BenchError, BenchRun
from edge_server.experiments.bench.shown.rows import FIRST_SEED, Row, find
from edge_server.experiments.common.result_store import ResultStore, settings_digest
from edge_server.experiments.common.tables import number
from edge_server.experiments.virtual.costs import UpdateCosts
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.shown_truth import PARTS, PERFECT, KnownWorld, ShownTruth
from edge_server.experiments.virtual.virtual_deployment import Compute, RunSettings
from edge_server.fidelity.psnr import psnr_of_mse
from edge_server.live.state import Publication
from freshfield.scenario import Scenario, ScenarioError

SECONDS, QUICK_SECONDS = 12.0, 8.0
SHOWN_EVERY_MS, SETTLED_S = 50.0, 60.0  # of a long run, what is shown within the first minute does not count
_CYCLE = Compute(ms_per_step=3.0, ms_per_update=70.0)
LAYERS_RUN = RunSettings(steps=10, epoch_ms=20.0, score_every_ms=None, shown_every_ms=SHOWN_EVERY_MS)
_CYCLE_RUN = replace(LAYERS_RUN, steps=60, epoch_ms=250.0, compute=_CYCLE)


@dataclass(frozen=True)
class Variant:
    """A variant of a run.

    edge: a key of ``rows.EDGES``.
    late: use the scene's network, else an ideal one.
    charged: charge computing.
    splits: whether it serves only to separate the effects of network and computing.
    repeats: run with each seed of a row, else only with the first.
    """

    edge: str
    late: bool = True
    charged: bool = True
    splits: bool = False
    repeats: bool = False

    def settings(self, compute: Compute) -> RunSettings:
        """The settings of a run. compute: cost of an update of layers."""
        if self.edge == "before":
            return _CYCLE_RUN
        return replace(LAYERS_RUN, compute=compute) if self.charged else LAYERS_RUN


FIRST_VARIANT = "nothing late"  # measures the costs that the others are charged
VARIANTS = {
    FIRST_VARIANT: Variant("layers", late=False, charged=False),
    "shown": Variant("layers", repeats=True),
    "computing free": Variant("layers", charged=False, splits=True),
    "before": Variant("before"),
}


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {ROW: {VARIANT: {seed: means over the instants of the last third, or of all but the first
    minute of a long run}}}. Raises BenchError."""
    seconds = QUICK_SECONDS if run.quick else SECONDS
    try:
        for row in find(run.scenes):
            world = KnownWorld(row.scenario(FIRST_SEED, "layers"))
            for name, variant in VARIANTS.items():
                repeats = row.seeds if variant.repeats and not run.quick else 1
                if row.charged_as and name != "shown":
                    continue
                long_s = 60.0 * row.minutes * (not run.quick)
                for seed in range(FIRST_SEED, FIRST_SEED + repeats):
                    if row.split or not variant.splits:
                        _measure(row, name, seed, world, run.store, long_s or seconds)
    except ScenarioError as error:
        raise BenchError(str(error)) from None
    return run.store.results


def _measure(row: Row, name: str, seed: int, world: KnownWorld, store: ResultStore, seconds: float) -> None:
    """Do one run, unless it is known. Raises BenchError or ScenarioError."""
    variant, scenario = VARIANTS[name], row.scenario(seed, VARIANTS[name].edge)
    if not variant.late:
        scenario = replace(scenario, channel={"preset": "ideal"})
    compute = Compute()
    if name != FIRST_VARIANT:
        of = row.charged_as or row.name
        if of not in store.results:
            raise BenchError(f"{row.name} is charged as {of}, which is not known: measure that first (--resume)")
        cost = store.results[of][FIRST_VARIANT][str(FIRST_SEED)]["cost"]
        compute = Compute(ms_per_update=row.slower * cost["update_ms"], ms_per_view=row.slower * cost["view_ms"])
    sections = {key: getattr(scenario, key) for key in ("phase", "source", "channel", "edge")}
    settings = variant.settings(compute)
    if seconds > SETTLED_S:
        settings = replace(settings, shown_every_ms=10.0 * SHOWN_EVERY_MS)
    known = {
        "seconds": seconds,
        "cameras": len(scenario.cameras),
        **sections,
        "run": asdict(settings),
        "defaults": settings_digest(scenario.edge["field"], scenario.edge["field_options"]),
    }
    work = partial(_run, scenario, settings, world, seconds)
    found = store.get(row.name, name, str(seed), settings=known, compute=work)
    text = ", ".join(f"{part} {number(found['psnr_db'][part])}" for part in PARTS)
    print(f"  {row.name}, {name}, seed {seed}: {text} dB", flush=True)


def _run(scenario: Scenario, settings: RunSettings, world: KnownWorld, seconds: float) -> dict[str, Any]:
    """Run one deployment; returns means over its last third, or over all but its first minute. Raises
    ScenarioError."""
    truth = ShownTruth(world, from_ns=round(min(2.0 * seconds / 3.0, SETTLED_S) * 1e9))
    costs = UpdateCosts()

    def published(publication: Publication) -> None:
        truth.published(publication)
        costs.published(deployment.updates, publication.published_ns >= truth.from_ns)

    deployment = build_deployment(scenario, settings, truth=truth, on_published=published)
    costs.watch(deployment.updates.field)
    begun = time.monotonic()
    while (now_s := deployment.clock.now_ns() / 1e9) < seconds:
        deployment.run(min(seconds - now_s, 60.0))
        if seconds > SETTLED_S:
            print(f"    {deployment.clock.now_ns() / 6e10:g} min", flush=True)
    if not truth.instants:
        raise ScenarioError(f"{scenario.path}: nothing was published within {seconds:g} s")
    items = deployment.with_images(tuple(deployment.updates.buffer.newest().values()))
    found = {**means(truth.instants), "cost": costs.measured(items), "wall_s": time.monotonic() - begun}
    if seconds > SETTLED_S:
        found["by_minute"] = by_minute(truth.instants)
    return {
        **found,
        "updates": len(deployment.publications),
        "charged": vars(settings.compute),
        "seconds": seconds,
        "arrivals": deployment.updates.buffer.arrivals,
        "left_out": deployment.updates.buffer.shed,
    }


def by_minute(instants: Sequence[dict[str, Any]]) -> list[dict[str, float]]:
    """Mean age in ms and moving PSNR in dB of each minute of a run."""
    minutes: dict[int, list[dict[str, Any]]] = {}
    for instant in instants:
        minutes.setdefault(int(instant["t_s"] // 60.0), []).append(instant)
    return [
        {"minute": minute + 1, "age_ms": of["age_ms"]["mean"], "psnr_moving_db": of["psnr_db"]["moving"]}
        for minute, of in ((minute, means(part)) for minute, part in sorted(minutes.items()))
    ]


def means(instants: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over instants: psnr_db and squared_error by part, also of the perfect fields ``newest``, ``mean``
    and ``frozen``; mean ages; and p50 and p95 of lag_ms."""
    lags = [i["lag_ms"] for i in instants if i["lag_ms"] is not None]
    found: dict[str, Any] = {
        "instants": len(instants),
        "lag_ms": {f"p{q}": float(np.percentile(lags, q)) if lags else None for q in (50, 95)},
        "age_ms": {
            name: statistics.fmean(i["age_ms"][name] or 0.0 for i in instants) for name in instants[0]["age_ms"]
        },
    }
    for kind in ("shown", *PERFECT):
        errors = {part: [e for i in instants if (e := i[kind][part]) is not None] for part in PARTS}
        place = found if kind == "shown" else found.setdefault("perfect", {}).setdefault(kind, {})
        place["psnr_db"] = {p: statistics.fmean(map(psnr_of_mse, e)) if e else None for p, e in errors.items()}
        place["squared_error"] = {p: statistics.fmean(e) if e else None for p, e in errors.items()}
    return found
