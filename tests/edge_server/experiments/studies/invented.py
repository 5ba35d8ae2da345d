"""Studies whose results follow a rule instead of being measured: what verdicts make of figures that are known."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.studies.registry import STUDIES
from edge_server.experiments.studies.study import StudyRequest, Verdict, judge
from edge_server.scheduler.learned.rewards import f_w


def request(tmp_path: Path, **more: Any) -> StudyRequest:
    return StudyRequest(True, tmp_path, Folders(), **more)


def figures(quality: float, age: float, views: float = 9.0) -> dict[str, Any]:
    return {
        "psnr_db": 20.0 + quality,
        "psnr_moving_db": 18.0 + quality,
        "ssim": 0.8 + quality / 50,
        "shown_psnr_db": 20.0 + quality,
        "shown_psnr_moving_db": 18.0 + quality,
        "lpips": 0.2 - quality / 50,
        "views": views,
        "aaoi_ms": age,
        "age_sum_ms": 18 * age,
        "wait_ms": 0.0,
    }


def noise(seed: int, value: float | None) -> float:
    return 0.05 * math.sin(12.9898 * seed + 78.233 * (value or 0.0))


def peak(at: float) -> Callable[[Any], dict[str, Any]]:
    """Best at ``at`` ms of omega; the limit is at the peak's own height."""

    def rule(trial: Any) -> dict[str, Any]:
        if trial.channel.get("preset") == "ideal":
            return figures(3.0 + noise(trial.seed, 0.0), 15.0, 18.0)
        value = trial.value if trial.value is not None else 1000.0
        return figures(2.0 - abs(math.log(value / at)) + noise(trial.seed, value), value / 2)

    return rule


def verdicts(name: str, tmp_path: Path, rule: Callable[[Any], dict[str, Any]], seeds: int = 6) -> list[Verdict]:
    """Of a study of trials on ``room`` whose results follow a rule."""
    points = STUDIES[name].cases(request(tmp_path, seeds=seeds, scenes=("room",)))
    rows = [{**p.labels, "seed": p.trial.seed, **rule(p.trial)} for p in points]
    table = SeedTable([{**row, "f_w": f_w(row), "f_w_corrected": f_w(row, corrected=True)} for row in rows])
    return judge(STUDIES[name], table)


def answers(found: list[Verdict], *words: str) -> set[str]:
    """What the verdicts say that have all the words in their claim or setting."""
    said = {v.verdict for v in found if all(word in f"{v.about} {v.claim}" for word in words)}
    assert said, f"no verdict has {words} in it: {[v.about for v in found]}"
    return said
