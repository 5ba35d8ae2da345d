"""What each optional part of a representation costs in time and gains in dB, one by one.

Every option is tried off and on, everything else at its default: after the same number of steps, which says
what it is worth, and after the same seconds, which says whether it is worth its time. Some scenes call for
an option (cameras whose gains differ, poses that are a little wrong, motion), others do not: there it should
cost nothing. A representation that does not have an option is left out of its rows.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from edge_server.experiments.bench.option_ablation import CHOICES, MOVING, SCENES, Scene, missing
from edge_server.experiments.common.machine_load import BenchError, Usage
from edge_server.experiments.common.progress import Progress
from edge_server.experiments.common.result_store import Kept, settled
from edge_server.experiments.fitting.evaluate import evaluate
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fields import Budget, Field
from edge_server.fields.registry import field_names, make_field


@dataclass(frozen=True)
class Effort:
    """Budgets from scratch and of an update, in steps and seconds. warm_steps: before the first update."""

    seeds: int
    steps: int
    seconds: tuple[float, ...]
    updates: int
    update_steps: int
    update_s: tuple[float, ...]
    warm_steps: int

    def budgets(self, moving: bool) -> dict[str, Budget]:
        """Of a fit, or of an update; by name."""
        steps, seconds = (self.update_steps, self.update_s) if moving else (self.steps, self.seconds)
        return {f"{steps}_steps": Budget(steps=steps), **{f"{s:g}_s": Budget(seconds=s) for s in seconds}}

    def work(self, moving: bool) -> float:
        """Of one point, in seconds, roughly."""
        once = sum(b.seconds or 0.01 * (b.steps or 0) for b in self.budgets(moving).values())
        return self.seeds * (once * (self.updates if moving else 1) + 0.01 * self.warm_steps * moving)


FULL = Effort(3, 400, (4.0,), 8, 25, (0.25,), 800)
QUICK = Effort(1, 150, (2.5,), 4, 25, (0.25,), 300)


def measure(
    quick: bool,
    folder: Path,
    lpips: Path | None = None,
    fields: Sequence[str] = (),
    kept: Kept | None = None,
    only: Sequence[str] = (),
) -> dict[str, Any]:
    """{points: {SCENE: {FIELD: {SETTINGS: figures}}}, rows: [...], left_out: {FIELD: {choice: why}}}.

    Points that several rows share (everything at its default) are measured once. only: names of choices
    [all]. BenchError: there is no such choice.
    """
    del folder, lpips
    effort, kept = QUICK if quick else FULL, kept or Kept()
    names = tuple(fields) or field_names()
    if unknown := set(only) - {c.name for c in CHOICES}:
        raise BenchError(f"no option is called {', '.join(unknown)}: {', '.join(c.name for c in CHOICES)}")
    choices = [c for c in CHOICES if not only or c.name in only]
    absent = missing({s for c in choices for s in c.scenes})
    todo: list[tuple[str, str, str, Mapping[str, Any]]] = []  # name, scene, settings as text, as given
    for name in names:
        points: dict[tuple[str, str], Mapping[str, Any]] = {}
        for choice in choices:
            try:
                sides = [(label(name, options), options) for options in (choice.off, choice.on)]
            except ValueError as error:
                why = str(error).split(";")[0]
                print(f"  {name}: {choice.name} left out: {why}", flush=True)
                kept.figures.setdefault("left_out", {}).setdefault(name, {})[choice.name] = why
                continue
            for scene in choice.scenes:
                points |= {(scene, text): options for text, options in sides if scene not in absent}
        todo += [
            (name, scene, text, options)
            for (scene, text), options in points.items()
            if not kept.has("points", scene, name, text, settings=_as_json(effort, name))
        ]
    progress = Progress(sum(effort.work(scene in MOVING) for _, scene, *_ in todo))
    make = cache(lambda scene: SCENES[scene][1]())
    kept.put("scenes", {s: SCENES[s][0] for c in CHOICES for s in c.scenes})
    try:
        for name, scene, text, options in todo:
            point = partial(_point, name, make, scene, options, effort)
            settings = _as_json(effort, name)
            found = kept.get("points", scene, name, text, settings=settings, measure=point)
            progress.did(effort.work(scene in MOVING))
            told = ", ".join(f"{run.replace('_', ' ')} {_db(db)} dB" for run, db in found["psnr_db"].items())
            progress.say(f"{name} {scene}", text, told)
    finally:  # Ctrl-C, too
        kept.put("rows", rows(kept.figures.get("points", {})))
    return kept.figures


def _as_json(effort: Effort, name: str) -> dict[str, Any]:
    """The settings that a point is kept with; what differs from the defaults is in its name."""
    values = {key: list(v) if isinstance(v, tuple) else v for key, v in dataclasses.asdict(effort).items()}
    return {**values, "defaults": settled(name)}


def label(name: str, options: Mapping[str, Any]) -> str:
    """Settings of a representation as text, without those that are at their default anyway. ValueError: it
    does not have them, or not these values."""
    usual = getattr(make_field(name), "settings", None)
    chosen = getattr(make_field(name, options), "settings", None)
    different = {k: v for k, v in options.items() if getattr(usual, k, None) != getattr(chosen, k, v)}
    return ", ".join(f"{k}={v}" for k, v in different.items()) or "default"


def _point(
    name: str, make: Callable[[str], Scene], scene: str, options: Mapping[str, Any], effort: Effort
) -> dict[str, Any]:
    """One representation with some settings on one scene: medians over seeds."""
    make_field(name, options).warm_up()
    usage, where = Usage("bench"), make(scene)
    fit = partial(_updates, where, effort) if where.film is not None else partial(_from_scratch, where)
    runs = {
        budget_name: [fit(make_field(name, options, seed=seed), budget) for seed in range(effort.seeds)]
        for budget_name, budget in effort.budgets(where.film is not None).items()
    }
    same_steps = next(iter(runs.values()))
    figures: dict[str, Any] = {
        key: {run: _median([getattr(p, key) for p in found]) for run, found in runs.items()}
        for key in ("psnr_db", "psnr_moving_db")
    }
    figures["steps"] = {run: _median([p.steps for p in found]) for run, found in runs.items()}
    figures["ms_per_step"] = _median([1e3 * p.seconds / p.steps for p in same_steps])
    figures["cpu_ms_per_step"] = _median([1e3 * p.cpu_s / p.steps for p in same_steps])
    return {**figures, "outside_cores": usage.outside(usage.row(0.0))}


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
    score, _ = evaluate(model, still.held_out, Scorer(background=still.background))
    return _Fitted(score.psnr_db, score.psnr_moving_db, report.steps, report.seconds, cpu_s)


def _updates(where: Scene, effort: Effort, model: Field, budget: Budget) -> _Fitted:
    """Frame after frame of a film, from a field that has settled on the first."""
    film, scorer = where.film, Scorer()
    assert film is not None
    model.fit(film.training(0, where.late), Budget(steps=effort.warm_steps))
    scores: list[Score] = []
    steps, seconds, cpu_s = 0, 0.0, 0.0
    for frame in range(1, effort.updates + 1):
        views = film.training(frame, where.late)
        cpu = time.process_time()
        report = model.fit(views, budget)
        cpu_s += time.process_time() - cpu
        steps, seconds = steps + report.steps, seconds + report.seconds
        scores.append(film.score(model, frame, scorer))
    score = mean_score(scores)
    return _Fitted(score.psnr_db, score.psnr_moving_db, steps, seconds, cpu_s)


def _median(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(statistics.median(known)) if known else None


def rows(points: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Off beside on, for every choice, scene and representation of which both are measured. points: as
    ``measure`` keeps them."""
    names = dict.fromkeys(name for of_scene in points.values() for name in of_scene)
    out = []
    for choice in CHOICES:
        for name in names:
            try:
                sides = [label(name, options) for options in (choice.off, choice.on)]
            except ValueError:
                continue
            for scene in choice.scenes:
                known = points.get(scene, {}).get(name, {})
                # Of an earlier run with other budgets, one side may still stand there.
                budgets = [known[side]["settings"] for side in sides if side in known]
                if len(budgets) == 2 and budgets[0] == budgets[1]:
                    row = {"option": choice.name, "scene": scene, "field": name}
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
    """Two Markdown tables: fits from scratch, and updates after motion (moving pixels in parentheses)."""
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
        lines = [head, ["---"] * len(head)]
        for r in found:
            cells = [r["option"], r["scene"], r["field"], f"{r['settings_off']}; {r['settings_on']}"]
            for run in runs:
                cell = _pair(r, "psnr_db", run)
                cells.append(f"{cell} (moving {_pair(r, 'psnr_moving_db', run)})" if moving else cell)
            for key in ("ms_per_step", "cpu_ms_per_step", "outside_cores"):
                cells.append(", ".join(_db(r[side][key]) for side in ("off", "on")))
            lines.append(cells)
        texts.append("\n".join(f"| {' | '.join(cells)} |" for cells in lines))
    for name, reasons in figures.get("left_out", {}).items():
        texts.append("\n".join(f"{name}, {choice}: left out, {why}" for choice, why in reasons.items()))
    return "\n\n".join(texts)


def _pair(row: Mapping[str, Any], key: str, run: str) -> str:
    off, on = (_db(row[side][key].get(run)) for side in ("off", "on"))
    return f"{off}, {on}, **{_db(row[f'gain_{key}'].get(run), '+')}**"


def _db(value: float | None, sign: str = "") -> str:
    return "-" if value is None else f"{value:{sign}.2f}"
