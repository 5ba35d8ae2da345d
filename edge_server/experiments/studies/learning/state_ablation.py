"""What each part of the state is worth (6.33): age; + pose; + semantics; all."""

from __future__ import annotations

from collections.abc import Sequence

from edge_server.experiments.studies.learning.setup import (
    FOUR_VIEWPOINTS,
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    embeddings_missing,
    fixed_of,
    room,
    simple_policies,
)
from edge_server.experiments.studies.study import StudyRequest, Verdict
from edge_server.experiments.training.scheduler.evaluation import Evaluation, rows
from edge_server.experiments.training.scheduler.setting import layout_of

EPISODES = {True: 100, False: 600}
# name -> parts of the state
VARIANTS = {
    "age": ("age",), "age+pose": ("age", "pose"), "age+semantics": ("semantics", "age"),
    "all": ("semantics", "age", "pose"),
}  # fmt: skip


class Ablation(TrainingStudy):
    name = "ablation"
    title = "What each part of the state is worth: age, pose, semantics (6.33)"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        variants = dict(VARIANTS)
        if missing := embeddings_missing():
            print(f"  semantics are left out: {missing}")
            variants = {name: parts for name, parts in variants.items() if "semantics" not in parts}
        # All variants see the same decisions, drawn with all parts that any of them uses.
        parts = tuple(dict.fromkeys(part for v in variants.values() for part in v))
        setting = room("ch5", held_out=FOUR_VIEWPOINTS, parts=parts)
        reward, candidates = trainer.reward("set", "moving"), simple_policies("threshold")
        for name, used in variants.items():
            config = trainer.config("select", reward, EPISODES, layout_of(setting, used))
            candidates |= trainer.actors(f"learnt {name}", f"{self.name}-{name}", setting, config)
        evaluation = trainer.evaluate(setting, candidates, reward, len(request.repeats(10, 100)))
        yield judge(evaluation, list(variants)), rows(evaluation)


def judge(evaluation: Evaluation, variants: Sequence[str]) -> list[Verdict]:
    """Verdicts on the policies trained with each variant of the state."""
    about = "room, ch5, moving, four viewpoints"
    trained = {n: evaluation.runs(f"learnt {n}") for n in variants}
    best, text = evaluation.best_fixed("threshold")[0], fixed_of(evaluation, "threshold")
    found = [better(f"{about}, {name}", "better than the best fixed threshold.", runs, best,
                    f"against {text}; ") for name, runs in trained.items()]  # fmt: skip
    found += [better(f"{about}, {name}", "better than age alone.", runs, trained["age"])
              for name, runs in trained.items() if name != "age"]  # fmt: skip
    if "all" in trained:
        found.append(better(about, "semantics add to age and pose.", trained["all"], trained["age+pose"]))
    return found
