"""Studies of learned schedulers: figures 5.9 and 6.8, and what the thesis left open."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from edge_server.experiments.common.seed_table import Row
from edge_server.experiments.studies.learning import (
    FOUR_VIEWPOINTS,
    Cases,
    LearningCase,
    RewardChoice,
    Training,
    measure,
    room,
)
from edge_server.experiments.studies.study import Study, StudyRequest
from edge_server.experiments.studies.verdicts import Claim, Statistic, better, better_than_all
from edge_server.scheduler.learned.learner_spec import Action

LEARNED, RANDOM, ALL = {"policy": "learned"}, {"policy": "random"}, {"policy": "all"}
THRESHOLD, WAIT = ({"policy": p, "best": "value"} for p in ("threshold", "wait"))
ELSEWHERE = {"judged_from": "elsewhere"}
# The thesis's weight of a millisecond of age, and a fifth of it. With the thesis's weight (6.5) a single
# young view is better than any number of views that are 30 ms older, so there is little to decide.
THESIS_AGE, LESS_AGE = -0.015, -0.003


def _study(name: str, title: str, cases: Cases, *claims: Claim) -> Study:
    """A study of learned schedulers, judged by the reward, case by case."""
    return Study(name, title, cases, measure(name), ("reward",), claims, ("case", "judged_by"))


def _claim(text: str, statistic: Statistic, **where: str) -> Claim:
    """A claim judged by cameras that neither reward nor train, unless ``where`` says otherwise."""
    return Claim(text, statistic, where={**ELSEWHERE, **where})


def _learned(name: str) -> Row:
    return {"policy": f"learned {name}"}


def _chosen(request: StudyRequest, cases: Sequence[LearningCase], quick: int) -> list[LearningCase]:
    """The cases that were asked for; by default all, or the first ``quick`` in a quick pass."""
    by_name = {case.name: case for case in cases}
    return [by_name[name] for name in request.chosen(list(by_name), list(by_name)[:quick])]


# --- figure 5.9 ----------------------------------------------------------------------------------------------

# Name -> (cameras that reward, whether updates start from scratch, cost of a view). The first has the thesis's reward,
# camera and start; four cameras all round keep a policy from optimizing for a single viewpoint, and without a cost
# views hardly ever harm, so that using all is hard to beat.
SELECT_CASES = {
    "whole, one viewpoint, from nothing": (("cam00",), True, 0.0),
    "whole, four viewpoints, warm, priced, 0.003 a view": (FOUR_VIEWPOINTS, False, 0.003),
}


def _select_cases(request: StudyRequest) -> list[LearningCase]:
    found = []
    for name, (held_out, scratch, price) in SELECT_CASES.items():
        rewards = {"its reward": RewardChoice("set", weights={"views": -price})}
        training = Training("learned", "select", {True: 120, False: 600})
        found.append(
            LearningCase(name, room("ch5", held_out=held_out, scratch=scratch), rewards, [training], ["threshold"])
        )
    return _chosen(request, found, len(found))


PPO_SELECT = _study(
    "ppo-select",
    "A scheduler that learns which views to use (figure 5.9)",
    _select_cases,
    *(
        _claim(text, statistic, judged_from=where)
        for where in ("where it is rewarded", "elsewhere")
        for text, statistic in (
            (
                "better than a uniformly random set; the thesis has +16.7 % over its first episodes (5.6.2).",
                better(LEARNED, RANDOM),
            ),
            ("better than every fixed threshold (5.6.2).", better(LEARNED, THRESHOLD)),
            ("better than using all.", better(LEARNED, ALL)),
        )
    ),
)

# --- figure 6.8 ----------------------------------------------------------------------------------------------

# (channel, weight of age). A traffic state of ch6 lasts 30 ms, less than a decision; one of ch6-slow and swing lasts
# 3 s, and the best omega differs between the states of swing.
WAIT_CASES = (("swing", LESS_AGE), ("ch6-slow", THESIS_AGE), ("ch6", THESIS_AGE))


def _wait_cases(request: StudyRequest) -> list[LearningCase]:
    found = []
    kinds: tuple[Action, ...] = ("wait", "threshold")
    for channel, age in WAIT_CASES:
        trainings = [Training(f"learned {kind}", kind, {True: 90, False: 600}) for kind in kinds]
        rewards = {"its reward": RewardChoice("corrected", weights={"age": age})}
        name = f"{channel}, age {age:g}/ms"
        found.append(LearningCase(name, room(channel), rewards, trainings, kinds, ("random",), (16, 100)))
    return _chosen(request, found, 2)


PPO_WAIT = _study(
    "ppo-wait",
    "A scheduler that learns how long to wait, or how old is too old (figure 6.8)",
    _wait_cases,
    *(
        _claim(f"{kind}: {text}", better(_learned(kind), other))
        for kind, best in (("wait", WAIT), ("threshold", THRESHOLD))
        for text, other in (
            ("better than its best fixed omega.", best),
            ("better than a uniformly random set.", RANDOM),
        )
    ),
    _claim("waiting beats thresholds, both learned (6.5.3: by 6 %).", better(_learned("wait"), _learned("threshold"))),
)

# --- the state's parts (6.33) --------------------------------------------------------------------------------

WHICH_VIEWS = {
    "age": ("age",),
    "age, pose": ("age", "pose"),
    "Z, age": ("semantics", "age"),
    "Z, age, pose": ("semantics", "age", "pose"),
}
WHOLE = "Z, age, pose"
LEFT_OUT = {
    WHOLE: WHICH_VIEWS[WHOLE],
    "age, pose": ("age", "pose"),
    "Z, pose": ("semantics", "pose"),
    "Z, age": ("semantics", "age"),
}


def _state_case(name: str, kinds: Sequence[Action], variants: dict[str, tuple[str, ...]]) -> LearningCase:
    # All variants have the same decisions, drawn with all parts that any of them uses.
    parts = tuple(dict.fromkeys(part for v in variants.values() for part in v))
    select = kinds == ("select",)
    setting = room("ch5" if select else "ch6", held_out=FOUR_VIEWPOINTS, parts=parts)
    reward = RewardChoice("set", "moving") if select else RewardChoice("corrected", weights={"age": THESIS_AGE})
    trainings = [
        Training(f"{kind} by {variant}", kind, {True: 100, False: 600}, used)
        for kind, (variant, used) in product(kinds, variants.items())
    ]
    return LearningCase(name, setting, {"its reward": reward}, trainings, ["threshold"] if select else kinds)


def _ablation_cases(request: StudyRequest) -> list[LearningCase]:
    cases: dict[str, tuple[tuple[Action, ...], dict[str, tuple[str, ...]]]] = {
        "which views": (("select",), WHICH_VIEWS),
        "chapter 6": (("threshold", "wait"), LEFT_OUT),
    }
    return [_state_case(name, *cases[name]) for name in request.chosen(list(cases), list(cases)[:1])]


ABLATION = _study(
    "ablation",
    "What each part of the state is worth: age, pose, semantics (6.33)",
    _ablation_cases,
    *(
        _claim(
            f"{kind} by {variant}: better than the best fixed one.",
            better({"policy": f"{kind} by {variant}"}, {"policy": fixed, "best": "value"}),
        )
        for kind, fixed, variants in (
            ("select", "threshold", WHICH_VIEWS),
            ("threshold", "threshold", LEFT_OUT),
            ("wait", "wait", LEFT_OUT),
        )
        for variant in variants
    ),
    *(
        _claim(
            f"{kind}: better by {WHOLE} than by {variant}.",
            better({"policy": f"{kind} by {WHOLE}"}, {"policy": f"{kind} by {variant}"}),
        )
        for kind, variants in (("select", WHICH_VIEWS), ("threshold", LEFT_OUT), ("wait", LEFT_OUT))
        for variant in variants
        if variant != WHOLE
    ),
)

# --- the reward's weights (6.36-6.38) ------------------------------------------------------------------------

# The thesis's, ours with the corrected sign, and variants with a lower weight of age.
WEIGHTED = {
    "thesis": RewardChoice("thesis"),
    "corrected": RewardChoice("corrected"),
    "age a fifth": RewardChoice("corrected", weights={"age": LESS_AGE}),
    "age a fiftieth": RewardChoice("corrected", weights={"age": THESIS_AGE / 50}),
    "moving": RewardChoice("corrected", "moving", {"age": LESS_AGE}),
}


def _weight_cases(request: StudyRequest) -> list[LearningCase]:
    trainings = [
        Training(f"learned by {name}", "wait", {True: 40, False: 600}, reward=reward)
        for name, reward in WEIGHTED.items()
    ]
    return [LearningCase("swing", room("swing"), WEIGHTED, trainings, ["wait"], ("random",), (8, 100))]


WEIGHTS = _study(
    "weights",
    "Sensitivity to the weights of the reward (6.36-6.38)",
    _weight_cases,
    *(
        _claim(text, statistic, judged_by=name)
        for name in WEIGHTED
        for text, statistic in (
            ("what was learned by it is better than the best fixed wait.", better(_learned(f"by {name}"), WAIT)),
            (
                "it matters: what was learned by other weights is worse by these.",
                better_than_all(
                    _learned(f"by {name}"), tuple(_learned(f"by {other}") for other in WEIGHTED if other != name)
                ),
            ),
        )
    ),
)

# --- a channel that changes during use -----------------------------------------------------------------------

SLOW = {"preset": "ch5", "service": {"law": "exponential", "mean_ms": 200.0}}
LOSSY = {"preset": "ch5", "faults": {"loss": {"probability": 0.5}}}
# name -> channel
CHANGES: dict[str, str | Row] = {
    "delays three times as long": SLOW,
    "bursts": "swing",
    "half of the frames lost": LOSSY,
}


def _drift_cases(request: StudyRequest) -> list[LearningCase]:
    found = []
    for name, channel in CHANGES.items():
        trainings = [
            Training("learned before", "threshold", {True: 40, False: 600}, setting=room("ch5")),
            Training("learned afterwards", "threshold", {True: 40, False: 600}),
        ]
        rewards = {"its reward": RewardChoice("corrected", weights={"age": LESS_AGE})}
        found.append(LearningCase(name, room(channel), rewards, trainings, ["threshold"], seeds=(8, 100)))
    return _chosen(request, found, 1)


DRIFT = _study(
    "drift",
    "The channel changes during use: what was learned before, and what is learned afterwards",
    _drift_cases,
    _claim(
        "what is learned on the new channel is better than what was learned on the old.",
        better(_learned("afterwards"), _learned("before")),
    ),
    _claim(
        "what was learned on the old channel is still better than the best fixed threshold.",
        better(_learned("before"), THRESHOLD),
    ),
)
