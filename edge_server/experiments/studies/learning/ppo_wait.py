"""Figure 6.8: contextual-bandit PPO over omega (6.34-6.43): waiting and thresholds, by channel."""

from __future__ import annotations

import dataclasses

from edge_server.experiments.common.statistics import crossed
from edge_server.experiments.studies.learning.setup import (
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    mean_of,
    no_worse,
    paired_difference,
    room,
    simple_policies,
)
from edge_server.experiments.studies.study import StudyRequest, Verdict
from edge_server.experiments.training.scheduler.evaluation import Candidate, Evaluation, rows
from edge_server.experiments.training.scheduler.report import percent, quartiles
from edge_server.scheduler.learned.learner_spec import Action

KINDS: tuple[Action, ...] = ("wait", "threshold")
# The thesis's weight of a millisecond of age, and a fifth of it. With the thesis's weight (6.5) a single
# young view is better than any number of views that are 30 ms older, so there is little to decide.
THESIS_AGE, LESS_AGE = -0.015, -0.003
# (channel, weight of age, pixels of the PSNR). A traffic state of ch6 lasts 30 ms, less than a decision; one
# of ch6-slow and swing lasts 3 s, and the best omega differs between the states of swing.
QUICK_CASES = (("swing", LESS_AGE, "whole"), ("ch6-slow", THESIS_AGE, "whole"))
CASES = (
    *QUICK_CASES,
    ("swing", LESS_AGE, "moving"),
    ("ch6", THESIS_AGE, "whole"),
    ("swing", THESIS_AGE, "whole"),
    ("ch6-slow", LESS_AGE, "whole"),
    ("ch6", LESS_AGE, "whole"),
)
# The thesis's gain of waiting over thresholds (6.5.3).
THESIS_PERCENT = 6
# Episodes of one training, by whether it is a quick pass.
EPISODES = {True: 90, False: 600}


class PpoWait(TrainingStudy):
    name = "ppo-wait"
    title = "A scheduler that learns how long to wait, or how old is too old (figure 6.8)"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        cases = {named(*case): case for case in CASES}
        for case in request.chosen(list(cases), list(cases)[: len(QUICK_CASES)]):
            channel, age, pixels = cases[case]
            setting, mark = room(channel), "-moving" if pixels == "moving" else ""
            reward = dataclasses.replace(trainer.reward("corrected", pixels), age=age)
            candidates: dict[str, Candidate] = {}
            for kind in KINDS:
                name, config = (
                    f"{self.name}-{channel}{age:g}{mark}-{kind}",
                    trainer.config(kind, reward, EPISODES, tries=3),
                )
                candidates |= simple_policies(kind)
                candidates |= trainer.actors(f"learnt-{kind}", name, setting, config)
            count = len(request.repeats(16, 100))
            evaluation = trainer.evaluate(setting, candidates, reward, count)
            found = rows(evaluation, channel=channel, age_weight=age, pixels=pixels)
            yield judge(case, channel, evaluation), found


def named(channel: str, age: float, pixels: str) -> str:
    """Name of a case."""
    where = ", where it moves" if pixels == "moving" else ""
    return f"{channel}{where}, age {age:g}/ms"


def judge(case: str, channel: str, evaluation: Evaluation) -> list[Verdict]:
    """The verdicts of a case on the thesis's claims and on ours."""
    found = []
    trained = {kind: evaluation.runs(f"learnt-{kind}") for kind in KINDS}
    for kind in KINDS:
        about, mine = f"room, {case}, {kind}", trained[kind]
        best, name = evaluation.best_fixed(kind)
        best_values = evaluation.best_values(kind)
        same = paired_difference(mine, evaluation.rewards(name))
        text = (
            f"the best is {name}, over which it has {same.text(4)} where that is known from the very seeds "
            "it is tested on; over the best as the other half of the seeds chose it, "
        )
        if channel != "ch6":
            claim = "better than its best fixed omega, where a traffic state lasts long enough to be used."
            found.append(better(about, claim, mine, best, text))
        else:
            claim = "no worse than its best fixed omega by 1 %, where nothing can be foreseen."
            found.append(no_worse(about, claim, mine, best, evaluation))
        found.append(
            better(
                about,
                "better than a uniformly random set.",
                mine,
                evaluation.rewards("random"),
                f"{percent(mean_of(mine), evaluation.rewards('random'))}; ",
            )
        )
        found.append(
            Verdict(
                about,
                "the best omega differs between decisions: who knew it beforehand would win.",
                f"as one fit has it, it is {quartiles(best_values)}; to know it would be worth "
                f"{best_values['gain'].text(4)} over the best fixed one, as another fit has it; learnt "
                f"{crossed(mine).text(4)}.",
                best_values["gain"].above(0.0),
                best_values["gain"],
            )
        )
    wait, threshold = trained["wait"], trained["threshold"]
    found.append(
        better(
            f"room, {case}",
            f"waiting beats thresholds, both learnt (6.5.3: by {THESIS_PERCENT} %).",
            wait,
            threshold,
            f"{percent(mean_of(wait), mean_of(threshold))}; ",
        )
    )
    return found
