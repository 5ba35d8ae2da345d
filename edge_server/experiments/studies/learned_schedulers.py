"""Studies of learned schedulers: figures 5.9 and 6.8, and what the thesis left open."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from edge_server.experiments.common.seed_table import Row
from edge_server.experiments.studies.findings import better, better_than_all, half_way, no_worse
from edge_server.experiments.studies.learning import (
    FOUR_VIEWPOINTS,
    Cases,
    LearningCase,
    RewardChoice,
    Training,
    measure,
    room,
)
from edge_server.experiments.studies.study import Claim, Statistic, Study, StudyRequest
from edge_server.experiments.training.evaluation import BASELINE_POLICIES
from edge_server.scheduler.learned.settings import Action

LEARNED, RANDOM, ALL = {"policy": "learned"}, {"policy": "random"}, {"policy": "all"}
THRESHOLD, WAIT, WAIT_ARRIVED = ({"policy": p, "best": "value"} for p in ("threshold", "wait", "wait-arrived"))
ELSEWHERE = {"judged_from": "elsewhere"}
# The thesis's weight of a millisecond of age, and a fifth of it. With the thesis's weight (6.5) a single
# young view is better than any number of views that are 30 ms older, so there is little to decide.
THESIS_AGE, LESS_AGE = -0.015, -0.003


def _study(name: str, title: str, cases: Cases, *claims: Claim) -> Study:
    """A study of learned schedulers, judged by the reward, case by case."""
    return Study(name, title, cases, measure(name), ("reward",), claims, ("case", "judged_by"))


def _claim(text: str, statistic: Statistic, bound: float = 0.0, **where: str) -> Claim:
    """A claim judged by cameras that neither reward nor train, unless ``where`` says otherwise."""
    return Claim(text, statistic, bound, {**ELSEWHERE, **where})


def _learned(name: str) -> Row:
    return {"policy": f"learned {name}"}


def _chosen(request: StudyRequest, cases: Sequence[LearningCase], quick: int) -> list[LearningCase]:
    """The cases that were asked for; by default all, or the first ``quick`` in a quick pass."""
    by_name = {case.name: case for case in cases}
    return [by_name[name] for name in request.chosen(list(by_name), list(by_name)[:quick])]


# --- figure 5.9 ----------------------------------------------------------------------------------------------

# Cameras that reward: one, as in the thesis, or four all round, so that a policy cannot optimize for a single
# viewpoint.
VIEWPOINTS = {"one viewpoint": ("cam00",), "four viewpoints": FOUR_VIEWPOINTS}
# (pixels of the PSNR, viewpoints, whether updates start from scratch, cost of a view). The first has the
# thesis's reward and start. Without a cost views hardly ever harm, so using all is hard to beat.
SELECT_CASES = (
    ("whole", "one viewpoint", True, 0.0),
    ("whole", "one viewpoint", False, 0.0),
    ("moving", "one viewpoint", False, 0.0),
    ("whole", "four viewpoints", False, 0.0),
    ("whole", "four viewpoints", False, 0.003),
)


def _select_cases(request: StudyRequest) -> list[LearningCase]:
    found = []
    for on, viewpoints, scratch, price in SELECT_CASES:
        priced = f", priced, {price:g} a view" if price else ""
        name = f"{on}, {viewpoints}, {'from nothing' if scratch else 'warm'}{priced}"
        reward = RewardChoice("set", on, {"views": -price})
        setting = room("ch5", held_out=VIEWPOINTS[viewpoints], scratch=scratch)
        training = Training("learned", "select", {True: 120, False: 600})
        found.append(LearningCase(name, setting, {"its reward": reward}, [training], ["threshold"], BASELINE_POLICIES))
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
            (
                "better than each policy without learning.",
                better_than_all(LEARNED, tuple({"policy": p} for p in BASELINE_POLICIES[2:])),
            ),
            (
                "most of what could be won is won: more than half of the way from random to the oracle.",
                half_way(LEARNED, RANDOM, {"policy": "oracle"}),
            ),
            (
                "the best threshold differs between decisions: who knew it beforehand would win.",
                better({"policy": "oracle threshold"}, THRESHOLD),
            ),
        )
    ),
)

# --- figure 6.8 ----------------------------------------------------------------------------------------------

# (channel, weight of age, pixels of the PSNR). A traffic state of ch6 lasts 30 ms, less than a decision; one
# of ch6-slow and swing lasts 3 s, and the best omega differs between the states of swing.
WAIT_CASES = (
    ("swing", LESS_AGE, "whole"),
    ("ch6-slow", THESIS_AGE, "whole"),
    ("swing", LESS_AGE, "moving"),
    ("ch6", THESIS_AGE, "whole"),
    ("swing", THESIS_AGE, "whole"),
    ("ch6-slow", LESS_AGE, "whole"),
    ("ch6", LESS_AGE, "whole"),
)


def _wait_cases(request: StudyRequest) -> list[LearningCase]:
    found = []
    for channel, age, pixels in WAIT_CASES:
        name = f"{channel}{', where it moves' if pixels == 'moving' else ''}, age {age:g}/ms"
        kinds: tuple[Action, ...] = ("wait", "threshold")
        trainings = [Training(f"learned {kind}", kind, {True: 90, False: 600}) for kind in kinds]
        reward = RewardChoice("corrected", pixels, {"age": age})
        found.append(
            LearningCase(name, room(channel), {"its reward": reward}, trainings, kinds, ("random",), (16, 100))
        )
    return _chosen(request, found, 2)


PPO_WAIT = _study(
    "ppo-wait",
    "A scheduler that learns how long to wait, or how old is too old (figure 6.8)",
    _wait_cases,
    *(
        _claim(f"{kind}: {text}", statistic, bound)
        for kind, best in (("wait", WAIT), ("threshold", THRESHOLD))
        for text, statistic, bound in (
            ("better than its best fixed omega.", better(_learned(kind), best), 0.0),
            ("no worse than its best fixed omega by 1 %.", no_worse(_learned(kind), best), -0.01),
            ("better than a uniformly random set.", better(_learned(kind), RANDOM), 0.0),
            (
                "the best omega differs between decisions: who knew it beforehand would win.",
                better({"policy": f"oracle {kind}"}, best),
                0.0,
            ),
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
        "chapter 6": (("threshold", "wait", "wait-arrived"), LEFT_OUT),
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
            ("wait-arrived", "wait-arrived", LEFT_OUT),
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
    _claim(
        "frames that arrive while it waits (6.16) serve better than those generated meanwhile (6.5), at the best "
        "fixed omega of each.",
        better(WAIT_ARRIVED, WAIT),
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
