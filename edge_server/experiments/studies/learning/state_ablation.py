"""The value of each part of the state [Z, age, pose] (6.33) for choosing views, and for choosing omega."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from edge_server.experiments.studies.learning.ppo_wait import THESIS_AGE
from edge_server.experiments.studies.learning.setup import (
    FOUR_VIEWPOINTS,
    Part,
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
from edge_server.experiments.training.scheduler.evaluation import Candidate, Evaluation, rows
from edge_server.experiments.training.scheduler.setting import layout_of
from edge_server.scheduler.learned.learner_spec import Action

EPISODES = {True: 100, False: 600}
WHICH_VIEWS, CHAPTER_6, FLUSHED = "which views", "chapter 6", "wait after a flush"
# name -> parts of the state
VARIANTS = {
    "age": ("age",),
    "age+pose": ("age", "pose"),
    "age+semantics": ("semantics", "age"),
    "all": ("semantics", "age", "pose"),
}
# The schedulers of chapter 6, with both interpretations of ``wait``.
KINDS: tuple[Action, ...] = ("threshold", "wait", "wait-arrived")
WHOLE = "Z, age, pose"
# name -> parts of the state: all, and without each of them
LEFT_OUT = {
    WHOLE: ("semantics", "age", "pose"),
    "age, pose": ("age", "pose"),
    "Z, pose": ("semantics", "pose"),
    "Z, age": ("semantics", "age"),
}


class Ablation(TrainingStudy):
    name = "ablation"
    title = "What each part of the state is worth: age, pose, semantics (6.33)"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        cases = {WHICH_VIEWS: self._which_views, CHAPTER_6: self._chapter_6, FLUSHED: self._flushed}
        for case in request.chosen(list(cases), [WHICH_VIEWS]):
            yield cases[case](trainer, request)

    def _which_views(self, trainer: StudyTrainer, request: StudyRequest) -> Part:
        variants = usable(VARIANTS)
        # All variants have the same decisions, drawn with all parts that any of them uses.
        parts = tuple(dict.fromkeys(part for v in variants.values() for part in v))
        setting = room("ch5", held_out=FOUR_VIEWPOINTS, parts=parts)
        reward, candidates = trainer.reward("set", "moving"), simple_policies("threshold")
        for name, used in variants.items():
            config = trainer.config("select", reward, EPISODES, layout_of(setting, used))
            candidates |= trainer.actors(f"learnt {name}", f"{self.name}-{name}", setting, config)
        evaluation = trainer.evaluate(setting, candidates, reward, len(request.repeats(10, 100)))
        return judge(evaluation, list(variants)), rows(evaluation)

    def _chapter_6(self, trainer: StudyTrainer, request: StudyRequest) -> Part:
        variants = usable(LEFT_OUT)
        evaluation = self._omegas(trainer, request, KINDS, variants)
        return judge_chapter_6(evaluation, list(variants)), rows(evaluation, channel="ch6")

    def _flushed(self, trainer: StudyTrainer, request: StudyRequest) -> Part:
        variants = usable(LEFT_OUT)
        fullest = {name: variants[name] for name in list(variants)[:1]}
        # After a flush no frame is in transit at a decision, so frames that arrive were generated later, and
        # both interpretations of wait are the same.
        flushed = self._omegas(trainer, request, ("wait",), variants, flush=True)
        kept = self._omegas(trainer, request, ("wait",), fullest)
        found = judge_flushed(flushed, kept, list(variants))
        return found, [*rows(flushed, channel="ch6, flushed"), *rows(kept, channel="ch6, beside flushed")]

    def _omegas(
        self,
        trainer: StudyTrainer,
        request: StudyRequest,
        kinds: Sequence[Action],
        variants: dict[str, tuple[str, ...]],
        flush: bool = False,
    ) -> Evaluation:
        """Train policies that choose omega by every variant of the state; evaluate them and all fixed
        omegas."""
        parts = tuple(dict.fromkeys(part for v in variants.values() for part in v))
        setting = room("ch6", held_out=FOUR_VIEWPOINTS, parts=parts, flush=flush)
        reward = dataclasses.replace(trainer.reward("corrected"), age=THESIS_AGE)
        candidates: dict[str, Candidate] = {}
        for kind in kinds:
            candidates |= simple_policies(kind)
            for name, used in variants.items():
                config = trainer.config(kind, reward, EPISODES, layout_of(setting, used), tries=3)
                folder = f"{self.name}-ch6-{kind}{'-flushed' * flush}-{name.replace(', ', '-')}"
                candidates |= trainer.actors(learnt(kind, name), folder, setting, config)
        return trainer.evaluate(setting, candidates, reward, len(request.repeats(16, 100)))


def usable(variants: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """The variants; without those that need embeddings if no embedder is available."""
    if missing := embeddings_missing():
        print(f"  semantics are left out: {missing}")
        return {name: parts for name, parts in variants.items() if "semantics" not in parts}
    return variants


def learnt(kind: str, variant: str) -> str:
    """Name of the policies that choose omega by a variant of the state."""
    return f"learnt {kind} by {variant}"


def judge_chapter_6(evaluation: Evaluation, variants: Sequence[str]) -> list[Verdict]:
    """Verdicts on omega chosen by each variant of the state, and on the two interpretations of wait."""
    found = [v for kind in KINDS for v in _left_out(evaluation, variants, kind, f"room, ch6, {kind}")]
    fullest = variants[0]
    arrived, generated = (evaluation.runs(learnt(k, fullest)) for k in ("wait-arrived", "wait"))
    claim = "frames that arrive while it waits (6.16) serve better than those generated meanwhile (6.5)"
    best_arrived, best_generated = (evaluation.best_fixed(kind)[0] for kind in ("wait-arrived", "wait"))
    return [
        *found,
        better("room, ch6, both learnt", f"{claim}.", arrived, generated),
        better("room, ch6, both at their best fixed omega", f"{claim}.", best_arrived, best_generated),
    ]


def _left_out(evaluation: Evaluation, variants: Sequence[str], kind: str, about: str) -> list[Verdict]:
    """Verdicts on one kind: compared with its best fixed omega, and with the whole state compared with its
    parts."""
    best, text = evaluation.best_fixed(kind)[0], fixed_of(evaluation, kind)
    trained = {name: evaluation.runs(learnt(kind, name)) for name in variants}
    found = [
        better(f"{about}, by {name}", "better than the best fixed omega.", runs, best, f"against {text}; ")
        for name, runs in trained.items()
    ]
    return found + [
        better(about, f"better by {WHOLE} than by {name}.", trained[WHOLE], runs)
        for name, runs in trained.items()
        if WHOLE in trained and name != WHOLE
    ]


def judge_flushed(flushed: Evaluation, kept: Evaluation, variants: Sequence[str]) -> list[Verdict]:
    """Verdicts on wait if frames in transit are discarded at a decision, and compared with wait if they are
    not."""
    fullest, claim = variants[0], "a flush before the wait serves better than none (6.5)."
    return [
        *_left_out(flushed, variants, "wait", "room, ch6, flushed, wait"),
        better(
            "room, ch6, both learnt", claim, flushed.runs(learnt("wait", fullest)), kept.runs(learnt("wait", fullest))
        ),
        better(
            "room, ch6, both at their best fixed omega",
            claim,
            flushed.best_fixed("wait")[0],
            kept.best_fixed("wait")[0],
        ),
    ]


def judge(evaluation: Evaluation, variants: Sequence[str]) -> list[Verdict]:
    """Verdicts on the policies trained with each variant of the state."""
    about = "room, ch5, moving, four viewpoints"
    trained = {n: evaluation.runs(f"learnt {n}") for n in variants}
    best, text = evaluation.best_fixed("threshold")[0], fixed_of(evaluation, "threshold")
    found = [
        better(f"{about}, {name}", "better than the best fixed threshold.", runs, best, f"against {text}; ")
        for name, runs in trained.items()
    ]
    found += [
        better(f"{about}, {name}", "better than age alone.", runs, trained["age"])
        for name, runs in trained.items()
        if name != "age"
    ]
    if "all" in trained:
        found.append(better(about, "semantics add to age and pose.", trained["all"], trained["age+pose"]))
    return found
