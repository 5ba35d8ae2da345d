"""Measures cost in time and gain in dB of each optional part of a representation.

Every option is measured off and on, with all others at their defaults: after the same number of steps (its
gain) and after the same time (its gain including its cost). Some scenes need an option (different gains of
the cameras, slightly wrong poses, motion); on the others it should not harm. A representation without an
option has no rows for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

from edge_server.experiments.bench.option_ablation import MOVING, OPTIONS, SCENES, Scene, missing
from edge_server.experiments.bench.run import BenchError, BenchRun, label, result_settings
from edge_server.experiments.common.progress import Progress
from edge_server.experiments.common.tables import markdown_table, median_or_none
from edge_server.experiments.common.tables import number as _db
from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fields import Budget, Field
from edge_server.fields.registry import field_names, make_field
from freshfield.machine_load import LoadMeter


@dataclass(frozen=True)
class Workload:
    """The amount of work.

    seeds: number of seeds.
    steps, seconds: budgets of fits from scratch.
    updates: number of updates of a sequence.
    update_steps, update_s: budgets of an update.
    warm_steps: steps before the first update.
    """

    seeds: int
    steps: int
    seconds: tuple[float, ...]
    updates: int
    update_steps: int
    update_s: tuple[float, ...]
    warm_steps: int

    def budgets(self, moving: bool) -> dict[str, Budget]:
        """The budgets of a fit, or of an update, by name."""
        steps, seconds = (self.update_steps, self.update_s) if moving else (self.steps, self.seconds)
        return {f"{steps}_steps": Budget(steps=steps), **{f"{s:g}_s": Budget(seconds=s) for s in seconds}}

    def seconds_of(self, moving: bool) -> float:
        """Approximate time of one point."""
        once = sum(b.seconds or 0.01 * (b.steps or 0) for b in self.budgets(moving).values())
        return self.seeds * (once * (self.updates if moving else 1) + 0.01 * self.warm_steps * moving)


FULL = Workload(3, 400, (4.0,), 8, 25, (0.25,), 800)
QUICK = Workload(1, 150, (2.5,), 4, 25, (0.25,), 300)


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {points: {SCENE: {FIELD: {SETTINGS: figures}}}, rows: [...], left_out: {FIELD: {option: why}}}.

    Points that several rows share (with all options at their defaults) are measured once. Raises BenchError
    for an unknown option.
    """
    workload, names, store = QUICK if run.quick else FULL, run.fields or field_names(), run.store
    if unknown := set(run.only) - {o.name for o in OPTIONS}:
        raise BenchError(f"no option is called {', '.join(unknown)}: {', '.join(o.name for o in OPTIONS)}")
    wanted = [o for o in OPTIONS if not run.only or o.name in run.only]
    absent = missing({s for o in wanted for s in o.scenes})
    todo: list[tuple[str, str, str, Mapping[str, Any]]] = []  # name, scene, settings as text, as given
    for name in names:
        points: dict[tuple[str, str], Mapping[str, Any]] = {}
        for option in wanted:
            try:
                sides = [(label(name, settings), settings) for settings in (option.off, option.on)]
            except ValueError as error:
                why = str(error).split(";")[0]
                print(f"  {name}: {option.name} left out: {why}", flush=True)
                store.results.setdefault("left_out", {}).setdefault(name, {})[option.name] = why
                continue
            for scene in option.scenes:
                points |= {(scene, text): settings for text, settings in sides if scene not in absent}
        settings = result_settings(workload, name)
        todo += [
            (name, scene, text, options)
            for (scene, text), options in points.items()
            if store.find("points", scene, name, text, settings=settings) is None
        ]
    progress = Progress(sum(workload.seconds_of(scene in MOVING) for _, scene, *_ in todo))
    make = cache(lambda scene: SCENES[scene][1]())
    store.results["scenes"] = {s: SCENES[s][0] for o in OPTIONS for s in o.scenes}
    try:
        for name, scene, text, options in todo:
            point = partial(_point, name, make, scene, options, workload)
            settings = result_settings(workload, name)
            found = store.get("points", scene, name, text, settings=settings, compute=point)
            progress.advance(workload.seconds_of(scene in MOVING))
            scores = ", ".join(f"{k.replace('_', ' ')} {_db(db)} dB" for k, db in found["psnr_db"].items())
            progress.report(f"{name} {scene}", text, scores)
    finally:  # Ctrl-C, too
        store.results["rows"] = rows(store.results.get("points", {}))
    return store.results


def _point(
    name: str, make: Callable[[str], Scene], scene: str, options: Mapping[str, Any], workload: Workload
) -> dict[str, Any]:
    """Measure one representation with some options on one scene: medians over seeds."""
    make_field(name, options).warm_up()
    load, where = LoadMeter(), make(scene)
    fit = partial(_updates, where, workload) if where.sequence is not None else partial(_from_scratch, where)
    runs = {
        budget_name: [fit(make_field(name, options, seed=seed), budget) for seed in range(workload.seeds)]
        for budget_name, budget in workload.budgets(where.sequence is not None).items()
    }
    same_steps = next(iter(runs.values()))
    figures: dict[str, Any] = {
        key: {run: median_or_none([getattr(p, key) for p in found]) for run, found in runs.items()}
        for key in ("psnr_db", "psnr_moving_db")
    }
    figures["steps"] = {run: median_or_none([p.steps for p in found]) for run, found in runs.items()}
    figures["ms_per_step"] = median_or_none([1e3 * p.seconds / p.steps for p in same_steps])
    figures["cpu_ms_per_step"] = median_or_none([1e3 * p.cpu_s / p.steps for p in same_steps])
    return {**figures, "outside_cores": load.outside_cores()}


@dataclass(frozen=True)
class _Fitted:
    psnr_db: float
    psnr_moving_db: float | None
    steps: int
    seconds: float
    cpu_s: float


def _from_scratch(where: Scene, model: Field, budget: Budget) -> _Fitted:
    still = where.still
    assert still is not None
    cpu = time.process_time()
    report = model.fit(still.training, budget)
    cpu_s = time.process_time() - cpu
    score, _ = score_views(model, still.held_out, Scorer(background=still.background))
    return _Fitted(score.psnr_db, score.psnr_moving_db, report.steps, report.seconds, cpu_s)


def _updates(where: Scene, workload: Workload, model: Field, budget: Budget) -> _Fitted:
    """Update a field frame by frame of a sequence, after it has converged on the first frame."""
    sequence, scorer = where.sequence, Scorer()
    assert sequence is not None
    model.fit(sequence.training(0, where.late), Budget(steps=workload.warm_steps))
    scores: list[Score] = []
    steps, seconds, cpu_s = 0, 0.0, 0.0
    for frame in range(1, workload.updates + 1):
        views = sequence.training(frame, where.late)
        cpu = time.process_time()
        report = model.fit(views, budget)
        cpu_s += time.process_time() - cpu
        steps, seconds = steps + report.steps, seconds + report.seconds
        scores.append(sequence.score(model, frame, scorer))
    score = mean_score(scores)
    return _Fitted(score.psnr_db, score.psnr_moving_db, steps, seconds, cpu_s)


def rows(points: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Compare off and on for every option, scene and representation for which both are measured. points: as
    in the result of ``measure``."""
    names = dict.fromkeys(name for of_scene in points.values() for name in of_scene)
    out = []
    for option in OPTIONS:
        for name in names:
            try:
                sides = [label(name, options) for options in (option.off, option.on)]
            except ValueError:
                continue
            for scene in option.scenes:
                known = points.get(scene, {}).get(name, {})
                # One side may be from an earlier run with other budgets.
                budgets = [known[side]["settings"] for side in sides if side in known]
                if len(budgets) == 2 and budgets[0] == budgets[1]:
                    row = {"option": option.name, "scene": scene, "field": name}
                    row |= {"settings_off": sides[0], "settings_on": sides[1]}
                    out.append({**row, **_beside(known[sides[0]], known[sides[1]])})
    return out


def _beside(off: Mapping[str, Any], on: Mapping[str, Any]) -> dict[str, Any]:
    gains = {
        f"gain_{key}": {run: _minus(on[key].get(run), value) for run, value in off[key].items()}
        for key in ("psnr_db", "psnr_moving_db")
    }
    cost = {f"{key}_times": on[key] / off[key] for key in ("ms_per_step", "cpu_ms_per_step")}
    return {"off": dict(off), "on": dict(on), **gains, **cost}


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def table(figures: dict[str, Any]) -> str:
    """Two Markdown tables: fits from scratch, and updates during motion (moving pixels in parentheses)."""
    every = figures.get("rows", [])
    shown = dict.fromkeys(r["scene"] for r in every)
    texts = ["\n".join(f"- `{scene}`: {figures['scenes'][scene]}" for scene in shown)] if every else []
    for moving in (False, True):
        found = [r for r in every if (r["scene"] in MOVING) == moving]
        if not found:
            continue
        runs = list(dict.fromkeys(run for r in found for run in r["off"]["psnr_db"]))
        what = "updates of" if moving else "after"
        head = ["option", "on a scene", "representation", "off, on"]
        head += [f"dB {what} {run.replace('_', ' ')}: off, on, gain" for run in runs]
        head += ["ms a step: off, on", "of CPU ms", "outside cores"]
        lines = []
        for r in found:
            cells = [r["option"], r["scene"], r["field"], f"{r['settings_off']}; {r['settings_on']}"]
            for run in runs:
                cell = _pair(r, "psnr_db", run)
                cells.append(f"{cell} (moving {_pair(r, 'psnr_moving_db', run)})" if moving else cell)
            for key in ("ms_per_step", "cpu_ms_per_step", "outside_cores"):
                cells.append(", ".join(_db(r[side][key]) for side in ("off", "on")))
            lines.append(cells)
        texts.append(markdown_table(head, lines))
    for name, reasons in figures.get("left_out", {}).items():
        texts.append("\n".join(f"{name}, {option}: left out, {why}" for option, why in reasons.items()))
    return "\n\n".join(texts)


def _pair(row: Mapping[str, Any], key: str, run: str) -> str:
    off, on = (_db(row[side][key].get(run)) for side in ("off", "on"))
    return f"{off}, {on}, **{_db(row[f'gain_{key}'].get(run), sign='+')}**"
