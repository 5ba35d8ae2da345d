"""Tests whether embeddings of the images help if something important moves in one part of the scene, and
whether they do not harm if nothing moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from edge_server.experiments.common.statistics import interval
from edge_server.experiments.studies.engine import StudyError
from edge_server.experiments.studies.learning.setup import (
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    embeddings_missing,
    mean_of,
    no_worse,
    simple_policies,
)
from edge_server.experiments.studies.learning.workshop import PARTS, priced, workshop
from edge_server.experiments.studies.study import StudyRequest, Table, Verdict
from edge_server.experiments.training.scheduler.evaluation import BASELINE_POLICIES, Evaluation, rows
from edge_server.experiments.training.scheduler.setting import layout_of
from edge_server.experiments.training.scheduler.trainer import Row
from edge_server.report.style import CYCLE, figure, label_lines

EPISODES = {True: 300, False: 1200}
# scene -> (speed, pixels of the PSNR). A person walks or stands on one of four sides of the workshop.
SCENES = {"somebody moves": (1.0, "moving"), "nothing moves": (0.0, "whole")}

# In the figure: label of a family of policies -> prefix of their names.
LEARNT = ("with-", "without-")
FAMILIES = {
    "learnt with semantics": LEARNT[0],
    "learnt without": LEARNT[1],
    "thresholds": "threshold:",
    "freshest k": "freshest-k:",
    "random": "random",
}


class Semantics(TrainingStudy):
    name = "semantics"
    title = "Where semantics help, and whether they cost anything where they do not (6.31-6.33)"

    def report(self, request: StudyRequest, table: Table | None) -> list[Verdict]:
        if missing := embeddings_missing():
            raise StudyError(f"{self.name}: {missing}")
        return super().report(request, table)

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        found: list[Row] = []
        for scene in request.chosen(list(SCENES), list(SCENES)):
            speed, on = SCENES[scene]
            setting = workshop(speed)
            reward = priced(trainer, on)
            candidates = simple_policies("threshold", BASELINE_POLICIES)
            for name, parts in (("with", PARTS), ("without", PARTS[1:])):
                config = trainer.config("select", reward, EPISODES, layout_of(setting, parts))
                run_name = f"{self.name}-{scene.replace(' ', '-')}-{name}"
                candidates |= trainer.actors(name, run_name, setting, config)
            count = len(request.repeats(10, 100))
            evaluation = trainer.evaluate(setting, candidates, reward, count)
            here = rows(evaluation, scene=scene)
            found += here
            yield judge(scene, evaluation, on == "moving"), here
        draw(request.out / f"{self.name}.png", found)


def judge(scene: str, evaluation: Evaluation, moves: bool) -> list[Verdict]:
    """Verdicts whether policies with semantics are better than those without or, if nothing moves, not worse;
    and whether both are better than the best policy without learning."""
    about, seeing, blind = f"tower, ch5, {scene}", evaluation.runs("with"), evaluation.runs("without")
    text = ""
    for name, runs in (("with", seeing), ("without", blind)):
        views, won = evaluation.term(f"{name}-0", "views").mean, evaluation.share(mean_of(runs))
        text += f"{name}: {views:.1f} views, {won.text(2)} of the way from random to hindsight; "
    if moves:
        claim = "semantics help where something important moves."
        found = [better(about, claim, seeing, blind, text)]
    else:
        claim = "semantics cost no more than 1 % where nothing moves."
        found = [no_worse(about, claim, seeing, blind, evaluation)]
    fixed = [n for n in evaluation.outcomes if not n.startswith(("with", "random"))]
    best = max(fixed, key=lambda n: interval(evaluation.rewards(n).values()).mean)
    return found + [
        better(
            f"{about}, {name} semantics",
            "better than the best of all that does not learn.",
            runs,
            evaluation.rewards(best),
            f"{best}, known from the very seeds; ",
        )
        for name, runs in (("with", seeing), ("without", blind))
    ]


def draw(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the mean reward against the used views, one panel per scene: families of policies as lines,
    trained policies as diamonds. Without intervals, because the verdicts have those of the paired
    differences.

    rows: rows of the table.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    with figure(path, 1, len(scenes), height_inch=3.4) as (_, axes):
        for at, scene in zip(axes[0], scenes):
            known = [row for row in rows if row["scene"] == scene and row.get("views")]
            for k, (label, prefix) in enumerate(FAMILIES.items()):
                some = sorted(
                    (float(row["views"]), float(row["reward"])) for row in known if row["policy"].startswith(prefix)
                )
                style = "D" if prefix in LEARNT else ".-"
                at.plot([v for v, _ in some], [r for _, r in some], style, color=CYCLE[k], label=label)
            label_lines(at, "reward", "views used", scene)
        for at in axes[0][:-1]:
            at.get_legend().remove()
