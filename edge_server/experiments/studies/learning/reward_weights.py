"""How much the weights of a reward matter (6.36-6.38): policies learnt by each, judged by every one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from edge_server.experiments.common.tables import write_csv
from edge_server.experiments.studies.learning.setup import (
    School,
    Taught,
    better,
    named_runs,
    over,
    room,
    runs_of,
)
from edge_server.experiments.studies.study import Ask, Table, Verdict, by_bool
from edge_server.experiments.training.scheduler.command import OMEGAS_MS
from edge_server.experiments.training.scheduler.evaluation import Contest, rivals, rows
from edge_server.experiments.training.scheduler.report import span
from edge_server.experiments.training.scheduler.trainer import Course
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.rewards import Reward
from edge_server.scheduler.learned.state import StateLayout

EPISODES = {True: 40, False: 600}


class Weights(Taught):
    name = "weights"
    title = "Sensitivity to the weights of the reward (6.36-6.38)"

    def report(self, ask: Ask, table: Table) -> list[Verdict]:
        del table
        setting, spec = room("swing"), Spec("wait", StateLayout(("age", "pose")), OMEGAS_MS["wait"])
        with School(ask) as school:
            rewards = variants(school)
            everybody: dict[str, Any] = {**rivals(OMEGAS_MS["wait"], ["wait"], ("random", "all"))}
            for name, reward in rewards.items():
                course = Course(spec, reward, ask.taught(EPISODES), tries=3)
                learnt = school.teach_all(f"{self.name}-{name}", setting, course)
                everybody |= named_runs(f"learnt {name}", learnt)
            contest = school.contest(setting, everybody, rewards["corrected"], len(ask.repeats(8, 100)))
        found, written = [], []
        for name, reward in rewards.items():
            contest.reward = reward
            written += rows(contest, judged_by=name)
            found += judge(contest, name, list(rewards))
        write_csv(ask.out / f"{self.name}.csv", written)
        return found


def judge(contest: Contest, name: str, names: Sequence[str]) -> list[Verdict]:
    """What was learnt by the reward ``name``, and by the others of ``names``, judged by ``name``, which is
    the contest's reward."""
    mine, about = runs_of(contest, f"learnt {name}"), f"room, swing, {name}"
    best, fixed = contest.best_fixed("wait")
    losses = {o: over(mine, runs_of(contest, f"learnt {o}")) for o in names if o != name}
    worst = max(losses, key=lambda o: losses[o].mean)
    answers = [loss.above(0.0) for loss in losses.values()]
    return [
        better(about, "what was learnt by it is better than the best fixed wait.", mine, best,
               f"the best is {fixed}; "),
        Verdict(about, "it matters: what was learnt by other weights is worse by these.",
                "; ".join(f"{o} {span(loss)}" for o, loss in losses.items()) + f"; most: {worst}.",
                by_bool(None if None in answers and True not in answers else True in answers)),
    ]  # fmt: skip


def variants(school: School) -> dict[str, Reward]:
    """Rewards by name: the thesis's, ours with the sign put right, and ages that count less."""
    corrected = school.reward("corrected")
    return {
        "thesis": school.reward("thesis"),
        "corrected": corrected,
        "age a fifth": dataclasses.replace(corrected, age=corrected.age / 5),
        "age a fiftieth": dataclasses.replace(corrected, age=corrected.age / 50),
        "moving": dataclasses.replace(corrected, fidelity="moving", age=corrected.age / 5),
    }
