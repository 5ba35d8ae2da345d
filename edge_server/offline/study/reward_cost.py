"""What accuracy costs in time when it is the reward's: a cheap noisy reward often or an exact slow one; and
what a larger embedding is worth."""

from __future__ import annotations

from typing import Any

import numpy as np

from edge_server.offline.study.base import Ask, Point, Table, Verdict, by_bool
from edge_server.offline.study.learning import Learnt, Lesson, School, embeddings_missing, room
from edge_server.offline.study.statistics import interval, paired
from edge_server.offline.train_scheduler import OMEGAS_MS, layout_of
from edge_server.offline.training.contest import rivals, rows, write_rows
from edge_server.offline.training.report import smoothed, span
from edge_server.offline.training.trainer import Course
from edge_server.report.style import CYCLE, figure, label_lines
from edge_server.scheduler.learned.spec import Spec
from edge_server.scheduler.learned.state import StateLayout

EPISODES = {True: 60, False: 600}
# Optimiser steps of a fit that is a reward in training; what is learnt is judged by fits of JUDGED_STEPS.
BUDGETS = (10, 25, 50, 100)
QUICK_BUDGETS = (10, 50)
JUDGED_STEPS = 100
DIMS = (0, 4, 32)


class RewardCost:
    name = "reward-cost"
    title = "Reward against the time of training, by the effort of a fit; and against embedding size"

    def points(self, ask: Ask) -> list[Point]:
        return []

    def report(self, ask: Ask, table: Table) -> list[Verdict]:
        del table
        budgets = QUICK_BUDGETS if ask.quick else BUDGETS
        judged = room("ch5", steps=JUDGED_STEPS)
        with School(ask) as school:
            reward = school.reward("set")
            course = Course(Spec("select", StateLayout(("age", "pose"))), reward, EPISODES[ask.quick])
            learnt = {steps: school.teach(Lesson(f"{self.name}-{steps}", room("ch5", steps=steps), course))
                      for steps in budgets}  # fmt: skip
            everybody: dict[str, Any] = {
                **rivals(OMEGAS_MS["threshold"], ["threshold"], ("random", "all")),
                **{f"learnt by {steps} steps": one.actor for steps, one in learnt.items()},
            }
            contest = school.contest(judged, everybody, reward, len(ask.repeats(8, 100)))
            written = rows(contest, what="fit budget")
            found = _by_budget(contest, learnt)
            _draw(ask, learnt)
            if not ask.quick:
                sized, more = _by_dim(school, ask, reward)
                written, found = written + sized, found + more
        write_rows(ask.out / f"{self.name}.csv", written)
        return found


def _by_budget(contest: Any, learnt: dict[int, Learnt]) -> list[Verdict]:
    cheap, dear = min(learnt), max(learnt)
    over = paired(contest.rewards(f"learnt by {cheap} steps"), contest.rewards(f"learnt by {dear} steps"))
    told = ", ".join(
        f"{steps} steps {span(interval(list(contest.rewards(f'learnt by {steps} steps').values())))} after "
        f"{one.seconds:.0f} s" for steps, one in learnt.items()
    )  # fmt: skip
    return [
        Verdict(
            f"room, ch5, judged by fits of {JUDGED_STEPS} steps",
            "for the same number of decisions a cheap reward teaches as much as a dear one (no worse).",
            f"{told}; {cheap} less {dear}: {span(over)}.", by_bool(over.above(-0.01)),
        )
    ]  # fmt: skip


def _by_dim(school: School, ask: Ask, reward: Any) -> tuple[list[dict[str, Any]], list[Verdict]]:
    """Reward against the width of the embedding; nothing where there are no embeddings."""
    if missing := embeddings_missing():
        print(f"  embedding sizes are left out: {missing}")
        return [], []
    setting = room("ch5", parts=("semantics", "age", "pose"))
    mine: dict[str, Any] = {}
    for dim in DIMS:
        with_dim = setting if not dim else room("ch5", parts=setting.parts, embedding={"dim": dim})
        layout = layout_of(with_dim, ("semantics", "age", "pose") if dim else ("age", "pose"))
        lesson = Lesson(
            f"reward-cost-d{dim}", with_dim, Course(Spec("select", layout), reward, EPISODES[False])
        )
        actor = school.teach(lesson).actor
        contest = school.contest(with_dim, {**rivals((), (), ("random",)), f"d = {dim}": actor}, reward,
                                 len(ask.repeats(8, 100)))  # fmt: skip
        mine[f"d = {dim}"] = contest
    rewards = {name: contest.rewards(name) for name, contest in mine.items()}
    base = rewards["d = 0"]
    verdicts = [
        Verdict("room, ch5", f"{name} is better than none.", f"difference {span(paired(values, base))}.",
                by_bool(paired(values, base).above(0.0)))
        for name, values in rewards.items() if name != "d = 0"
    ]  # fmt: skip
    return [row for name, c in mine.items() for row in rows(c, what=name)], verdicts


def _draw(ask: Ask, learnt: dict[int, Learnt]) -> None:
    with figure(ask.out / "reward-cost.png", 1, height_inch=3.0) as (_, axes):
        for k, (steps, one) in enumerate(learnt.items()):
            seconds = np.cumsum([row["seconds"] for row in one.rows])
            values = smoothed(np.array([np.nan if r["reward"] is None else r["reward"] for r in one.rows]))
            # Rewards of different budgets have different zeros: what is gained since the start is compared.
            axes[0, 0].plot(
                seconds, values - values[0], color=CYCLE[k % len(CYCLE)], label=f"{steps} steps a fit"
            )
        label_lines(axes[0, 0], "reward gained in training", "seconds of training", "What a reward costs")
