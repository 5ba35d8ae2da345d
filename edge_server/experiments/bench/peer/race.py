"""Measures seconds to a quality, of our fields and of peers on the same machine in the same run.

Every contestant gets the same training views and is scored by the mean PSNR of all held-out views; the time
for scoring is not counted. docs/fields.md says how to set up each peer.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.bench.peer.contestant import Contestant, PeerMissing, on_white
from edge_server.experiments.bench.peer.nerfacto import nerfacto
from edge_server.experiments.bench.peer.opensplat import opensplat
from edge_server.experiments.bench.run import BenchError, BenchRun, open_recording
from edge_server.experiments.common.result_store import settings_digest
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.scenes.multiview_still import MultiviewStill, mean_baselines
from edge_server.fidelity.psnr import psnr
from edge_server.fields import Budget, Field
from edge_server.fields.ngp.settings import NgpSettings
from edge_server.fields.registry import make_field
from freshfield.machine_load import LoadMeter

TARGETS_DB = (20, 25)
# Longest fitting time in seconds, and number of runs with different seeds.
QUICK, FULL = (60.0, 1), (300.0, 3)
# Seconds of fitting before the first evaluation, of our fields and of peers; each further slice is longer by
# the factor.
_FIRST_S, _FIRST_PEER_S, _GROWTH = 0.25, 4.0, 1.5
# Recordings, and the divisors of their image sizes.
SCALES = {"lego": 4.0, "kitchen": 1.0}
OURS = ("splat", "ngp")


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure for every scene, contestant and run the seconds to each quality, and the best quality. Raises
    BenchError."""
    (limit_s, runs), store = QUICK if run.quick else FULL, run.store
    stills: dict[str, MultiviewStill] = {}
    for scene, scale in SCALES.items():
        try:
            still = stills[scene] = open_recording(scene, scale)
        except DatasetError as error:
            raise BenchError(str(error)) from None
        about = {"scene": still.describe(), "held_out": len(still.held_out)}
        store.get(scene, "about", compute=partial(_about, still, about), settings=about)
    missing = store.results["missing"] = dict[str, str]()
    for seed, (scene, still) in product(range(runs), stills.items()):
        for name, enter in _contestants(scene, run.folder).items():
            if name in missing:
                continue
            settings = {"limit_s": limit_s, "ours": settings_digest(name) if name in OURS else None}
            work = partial(_race, enter, still, seed, limit_s, name in OURS)
            print(f"  {scene}, {name}, run {seed + 1} of {runs}", flush=True)
            try:
                store.get(scene, name, str(seed), compute=work, settings=settings)
            except PeerMissing as reason:
                missing[name] = str(reason)
                print(f"    left out: {reason}", flush=True)
    return store.results


def _about(still: MultiviewStill, about: dict[str, Any]) -> dict[str, Any]:
    return {**about, **mean_baselines(still.training, still.held_out, still.background)}


# (still, seed) -> contestant to be trained on it. Raises PeerMissing.
_Enter = Callable[[MultiviewStill, int], Contestant]


def _contestants(scene: str, folder: Path) -> dict[str, _Enter]:
    return {
        **{name: partial(_ours, name) for name in OURS},
        "ngp in plain torch": _plain_torch,
        "nerfacto": partial(nerfacto, scene),
        **({"opensplat": partial(opensplat, folder)} if scene == "kitchen" else {}),
    }


def _race(enter: _Enter, still: MultiviewStill, seed: int, limit_s: float, ours: bool) -> dict[str, Any]:
    contestant = enter(still, seed)
    load, reached = LoadMeter(), dict[int, float]()
    spent, evaluated_s, best, slice_s = 0.0, 0.0, 0.0, _FIRST_S if ours else _FIRST_PEER_S
    truths = [(v, on_white(v.image)) for v in still.held_out]
    try:
        while spent < limit_s and best < TARGETS_DB[-1]:
            spent += contestant.train(min(slice_s, limit_s - spent))
            slice_s *= _GROWTH
            scores = [psnr(contestant.render(view), truth) or 0.0 for view, truth in truths]
            now_db = statistics.fmean(scores)
            for target in TARGETS_DB:
                if now_db >= target:  # linearly interpolated between two evaluations
                    at_s = float(np.interp(target, [best, now_db], [evaluated_s, spent]))
                    reached.setdefault(target, at_s)
            best, evaluated_s = max(best, now_db), spent
        steps = contestant.steps()
    finally:
        contestant.close()
    return {
        "seconds_to": {f"{target}": reached.get(target) for target in TARGETS_DB},
        "best_db": best,
        "within_s": spent,
        "steps": steps,
        "outside_cores": load.outside_cores(),
    }


def _ours(name: str, still: MultiviewStill, seed: int) -> Contestant:
    return _of_field(make_field(name, seed=seed), still)


def _plain_torch(still: MultiviewStill, seed: int) -> Contestant:
    """``ngp`` in plain torch, with as many rays per step as the kernels use after they have settled."""
    from edge_server.fields.ngp.torch_field import NgpTorchField  # imports torch

    settled = make_field("ngp", seed=seed)
    settled.fit(still.training, Budget(seconds=2.0))
    done = settled.fit(still.training, Budget(steps=20))
    settings = NgpSettings(device="cpu", seed=seed, rays=round(done.rays / done.steps))
    return _of_field(NgpTorchField(settings, device="cpu"), still)


def _of_field(field: Field, still: MultiviewStill) -> Contestant:
    steps = 0

    def train(seconds: float) -> float:
        nonlocal steps
        done = field.fit(still.training, Budget(seconds=seconds))
        steps += done.steps
        return done.seconds

    field.warm_up()
    return Contestant(train, lambda view: field.render(view.camera_to_world, view.intrinsics).color, lambda: steps)


def table(figures: Mapping[str, Any]) -> str:
    """A table with a row for every scene and contestant: medians over the runs, and their range in
    parentheses."""
    rows = []
    for scene in SCALES:
        found = {n: list(r.values()) for n, r in figures.get(scene, {}).items() if n != "about"}
        fastest = {t: min((_median(r, t) for n, r in found.items() if n in OURS), default=None) for t in _T}
        for name, runs in found.items():
            best, spent = [r["best_db"] for r in runs], max(r["within_s"] for r in runs)
            times = [_times(runs, t, fastest[t] if name not in OURS else None) for t in _T]
            last = (
                f"{min(best):.1f} to {max(best):.1f} after {spent:.0f} s"
                if len(runs) > 1
                else (f"{best[0]:.1f} after {spent:.0f} s")
            )
            outside = [r["outside_cores"] for r in runs if r["outside_cores"] is not None]
            rows.append((scene, f"`{name}`", len(runs), *times, last, f"{max(outside, default=0.0):.1f}"))
    heads = ("scene", "contestant", "runs", *(f"s to {t} dB" for t in _T), "best, dB", "outside cores")
    about = "; ".join(
        f"`{s}`: {a['scene']}, {a['held_out']} held out, mean color {a['mean_colour_db']:.1f} dB"
        for s in SCALES
        if (a := figures.get(s, {}).get("about"))
    )
    missing = "".join(f"\n\n`{n}`: left out, {why}." for n, why in figures.get("missing", {}).items())
    return f"{about}.\n\n{markdown_table(heads, rows)}{missing}"


_T = tuple(f"{t}" for t in TARGETS_DB)


def _median(runs: list[dict[str, Any]], target: str) -> float:
    """Median seconds to the target; infinite if half of the runs or more did not reach it."""
    return statistics.median(r["seconds_to"][target] or float("inf") for r in runs)


def _times(runs: list[dict[str, Any]], target: str, ours_s: float | None) -> str:
    seconds = [r["seconds_to"][target] for r in runs]
    reached = [s for s in seconds if s is not None]
    if not reached:
        return "not reached"
    spread = f" ({min(reached):.2g} to {max(reached):.2g})" if len(reached) > 1 else ""
    if len(reached) < len(seconds):
        return f"{len(reached)} of {len(seconds)} runs{spread}"
    middle = statistics.median(reached)
    return f"{middle:.2g}{spread}" + (f", {middle / ours_s:.0f} times ours" if ours_s else "")
