"""Figure 4.6, tables 4.2, 4.3: what is learned from the preferences of simulated experts, and its worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import Row, SeedTable
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.studies.drawing import draw_curve
from edge_server.experiments.studies.study import Study, StudyRequest, open_engine
from edge_server.experiments.studies.trial import scene_label, scenes_here
from edge_server.experiments.studies.verdicts import Claim, better, level
from edge_server.experiments.studies.viewpoints import (
    JUDGED,
    SCENES,
    Workload,
    files_of,
    measured,
    plan,
    stage_of,
    workload,
)
from edge_server.experiments.viewpoints.reconstructions import taste_score, varied_plan
from edge_server.experiments.viewpoints.stage import Stage, open_embedder
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Field
from edge_server.matplotlib_figures import figure, label_lines
from edge_server.viewpoints.capture_planner import Budget, Plan, plan_capture
from edge_server.viewpoints.experts import TASTES, SimulatedExpert
from edge_server.viewpoints.features import StepFeatures
from edge_server.viewpoints.policy import PolicyConfig, train_policy
from edge_server.viewpoints.preference_model import RewardModel, fit_reward, random_pair

ASKED = (10, 20, 40, 60)
HABITS: dict[str, dict[str, float | bool]] = {
    "careful": {},
    "10 % wrong": {"wrong": 0.1},
    "contradicting": {"contradicts": True},
}
_UNSEEN = 400  # pairs
_TRAINED_ON = "10 % wrong"
# The taste whose policy is also trained with embeddings of the captured pictures (4.8).
_EMBEDDED = "edges"
_UPDATES = {True: 30, False: 80}  # of PPO
_POOL = {True: 60, False: 120}  # reconstructions; a third of them is kept for unseen pairs
_ARMS = ("random", "coverage", "coverage, short way", "FisherRF")


@dataclass(frozen=True)
class Taught:
    """A capture: by an arm of ``viewpoints``, or by a policy that was taught by a taste.

    pool: number of reconstructions that experts compare; None: a capture by an arm.
    """

    arm: str
    scene: str
    seed: int
    work: Workload
    pool: int | None = None
    updates: int = 0

    @property
    def taste(self) -> str:
        return self.arm.removeprefix("policy, ").removesuffix(", embeddings")


@dataclass(frozen=True)
class Reconstruction:
    """The number of a reconstruction of the pool."""

    scene: str
    number: int
    work: Workload


def _cases(request: StudyRequest) -> list[Taught]:
    work, found = workload(request), []
    for scene in scenes_here(request, SCENES[request.quick]):
        taught = [f"policy, {taste}" for taste in (*TASTES, f"{_EMBEDDED}, embeddings")]
        for seed in request.repeats(3, 5):
            found += [Taught(arm, scene, seed, work) for arm in _ARMS]
            found += [Taught(arm, scene, seed, work, _POOL[request.quick], _UPDATES[request.quick]) for arm in taught]
    return found


def _measure(cases: Sequence[Taught], request: StudyRequest) -> list[Row]:
    """Rows of captures (label ``arm``), of answers (labels ``taste``, ``habit``, ``answers``), and of each policy's
    return (label ``update``)."""
    rows: list[Row] = []
    folders = request.folders
    with open_engine(request, "preferences", threads=1) as engine:
        for scene in dict.fromkeys(case.scene for case in cases):
            mine = [case for case in cases if case.scene == scene]
            asked = [Reconstruction(scene, k, mine[0].work) for k in range(max(c.pool or 0 for c in mine))]
            pool = engine.run(
                partial(reconstruct, folders=folders),
                asked,
                f"{scene}: reconstructions",
                files=lambda one: files_of(one, folders),
                group=lambda one: one.scene,
            )
            done = engine.run(
                partial(captured, folders=folders, pool=pool),
                mine,
                f"{scene}: captures",
                files=lambda one: files_of(one, folders),
                group=lambda one: one.scene,
            )
            name = {"scene": scene_label(scene)}
            rows += [{**name, "arm": c.arm, "seed": c.seed, **found["capture"]} for c, found in zip(mine, done)]
            rows += [
                {
                    **name,
                    "trained": c.arm,
                    "seed": c.seed,
                    "update": n,
                    "return": float(np.mean(found["returns"][n : n + 5])),
                }
                for c, found in zip(mine, done)
                for n in range(0, len(found["returns"]), 5)
            ]
            features, scores = _pool_features(stage_of(scene, mine[0].work, folders), pool)
            rows += [
                {**name, **row}
                for taste in TASTES
                for habit in HABITS
                for seed in request.repeats(6, 12)
                for row in question(features, scores[taste], taste, habit, seed)
            ]
    return rows


def reconstruct(one: Reconstruction, *, folders: Folders) -> Row:
    """A reconstruction of the pool: its views, chosen in various ways, and the score of each taste."""
    stage = stage_of(one.scene, one.work, folders)
    made = varied_plan(stage, one.number, JUDGED)
    return {"order": made.order, **_tastes(stage, stage.fit(made.views, one.work.steps, one.number))}


def _pool_features(stage: Stage, pool: Sequence[Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Features (N, d) of the reconstructions as trajectories, and their scores by taste."""
    steps = StepFeatures(stage.candidates)
    features = np.stack([steps.trajectory(list(item["order"])) for item in pool])
    return features, {taste: np.array([item[taste] for item in pool]) for taste in TASTES}


@lru_cache(1)
def _seen(scene: str, work: Workload, folders: Folders) -> tuple[np.ndarray | None, Any]:
    """Embeddings of the candidates' pictures, and the embedder; None, None if there is none."""
    stage = stage_of(scene, work, folders)
    embed, missing = open_embedder(stage.background)
    if embed is None:
        print(f"  embeddings are left out: {missing}")
        return None, None
    return embed([stage.take(k).image for k in range(len(stage.candidates))]).astype(np.float64), embed


def captured(one: Taught, *, folders: Folders, pool: Sequence[Any]) -> Row:
    """The capture of an arm, or by a policy trained on the reward of a taste's answers; and the policy's returns."""
    stage = stage_of(one.scene, one.work, folders)
    if one.pool is None:
        made = plan(stage, one.arm, one.seed, JUDGED, one.work)
        return {"returns": [], "capture": _capture(stage, made, one)}
    features, scores = _pool_features(stage, pool[: one.pool])
    expert = SimulatedExpert(one.taste, scores[one.taste], np.random.default_rng(one.seed), wrong=0.1)
    model = ask(expert, features, ASKED[-1])
    seen, embed = _seen(one.scene, one.work, folders) if one.arm.endswith("embeddings") else (None, None)
    config = PolicyConfig(views=JUDGED, updates=one.updates)
    policy, returns = train_policy(stage.candidates, model.reward, config, one.seed, seen, embed)
    # The seed draws the same first view as for the others.
    made = plan_capture(stage.candidates, policy, Budget(views=JUDGED), stage.take, seed=one.seed)
    return {"returns": returns, "capture": _capture(stage, made, one)}


def _capture(stage: Stage, made: Plan, one: Taught) -> Row:
    """What was measured of a capture, and the score of each taste."""
    field = stage.fit(made.views, one.work.steps, one.seed)
    return {**measured(stage, field, made.stops, Scorer(background=stage.background)), **_tastes(stage, field)}


def _tastes(stage: Stage, field: Field) -> Row:
    """The score of each taste."""
    return {taste: taste_score(stage, field, taste) for taste in TASTES}


def ask(expert: SimulatedExpert, features: np.ndarray, answers: int) -> RewardModel:
    """The reward model after so many answers."""
    while len(expert.asked) < answers:
        expert.answer(*random_pair(len(features), expert.rng))
    return fit_reward(features, expert.asked)


def question(features: np.ndarray, scores: np.ndarray, taste: str, habit: str, seed: int) -> list[Row]:
    """A row for each number of answers: agreement with the expert on unseen pairs."""
    rng = np.random.default_rng([seed, 1])
    order = rng.permutation(len(features))
    asked, unseen = order[len(order) // 3 :], order[: len(order) // 3]
    expert = SimulatedExpert(taste, scores[asked], rng, **HABITS[habit])  # type: ignore[arg-type]
    other = SimulatedExpert(taste, scores[unseen], np.random.default_rng([seed, 2]), **HABITS[habit])  # type: ignore[arg-type]
    first, second = (
        np.random.default_rng([seed, 3]).permuted(np.tile(np.arange(len(unseen)), (_UNSEEN, 1)), axis=1)[:, :2].T
    )
    said = np.array([other.answer(i, j).prefers_first for i, j in zip(first, second)])
    again = np.array([other.answer(i, j).prefers_first for i, j in zip(first, second)])
    rows = []
    for answers in ASKED:
        model = ask(expert, features[asked], answers)
        rewards = model.reward(features[unseen])
        expects = rewards[first] > rewards[second]
        rows.append(
            {
                "taste": taste,
                "habit": habit,
                "seed": seed,
                "answers": answers,
                "agreement": float((expects == said).mean()),
                "with_itself": float((said == again).mean()),
                "agreement_share": float((expects == said).mean() / max((said == again).mean(), 1e-9)),
                "knows": model.knows,
                "does_not_know": float(not model.knows),
            }
        )
    return rows


def _draw(request: StudyRequest, table: SeedTable) -> None:
    """Agreement on unseen pairs against the number of answers; the policies' returns against updates (figure 4.6)."""
    for (scene,) in table.distinct("scene"):
        with figure(request.figure(f"preferences-{scene}.png"), 2, height_inch=2.6) as (_, axes):
            top, bottom = axes[:, 0]
            for k, (taste, habit) in enumerate(table.distinct("taste", "habit")):
                labels = {"scene": scene, "taste": taste, "habit": habit}
                draw_curve(top, table.curve("answers", "agreement", **labels), f"{taste}, {habit}", k)
            label_lines(top, "agreement on\nunseen pairs", "answers", f"{scene}: simulated experts")
            for k, (arm,) in enumerate(table.distinct("trained")):
                curve = table.curve("update", "return", scene=scene, trained=arm)
                if curve:
                    draw_curve(bottom, curve, arm, k)
            label_lines(bottom, "return", "updates of the policy")


def _tables(table: SeedTable) -> str:
    """Agreement on unseen pairs, and captures of ``JUDGED`` views by arm."""
    mean = table.mean_text
    parts = ["Simulated experts only; nobody was asked."]
    for (scene,) in table.distinct("scene"):
        answers = []
        for taste, habit in table.distinct("taste", "habit"):
            of = {"scene": scene, "taste": taste, "habit": habit}
            knows = list(table.values("knows", **of, answers=ASKED[-1]).values())
            cells = (mean("agreement", 2, **of, answers=n) for n in ASKED)
            itself = mean("with_itself", 2, **of, answers=ASKED[-1])
            answers.append([f"{taste}, {habit}", *cells, itself, f"{sum(map(bool, knows))} of {len(knows)}"])
        kinds = (("psnr_db", 2), ("ssim", 3), ("path_m", 2), *((taste, 4) for taste in TASTES), ("choice_ms", 0))
        captures = [[a, *(mean(m, d, scene=scene, arm=a) for m, d in kinds)] for (a,) in table.distinct("arm")]
        head = ["agreement after", *(f"{n} answers" for n in ASKED), "expert with itself", "says it knows"]
        parts += [
            f"## {scene}",
            markdown_table(head, answers),
            markdown_table(["8 views of", "PSNR (dB)", "SSIM", "path (m)", *TASTES, "a choice (ms)"], captures),
        ]
    return "\n\n".join(parts)


PREFERENCES = Study(
    "preferences",
    "What preferences of simulated experts teach (figure 4.6, tables 4.2, 4.3)",
    _cases,
    _measure,
    ("psnr_db",),
    (
        *(
            Claim(
                f"after {ASKED[-1]} answers, one in ten wrong, the model agrees with the expert on unseen pairs at "
                "least 90 % as often as the expert with itself.",
                level({"taste": taste, "habit": _TRAINED_ON, "answers": ASKED[-1]}),
                0.9,
                {"taste": taste},
                ("agreement_share",),
            )
            for taste in TASTES
        ),
        Claim(
            "contradicting experts: the model says that it does not know, nine times in ten.",
            level({"habit": "contradicting", "answers": ASKED[-1]}),
            0.9,
            {"habit": "contradicting"},
            ("does_not_know",),
        ),
        *(
            Claim(
                f"{better_at} than {other}'s (table 4.3).",
                better({"arm": arm}, {"arm": other}),
                0.0,
                {"arm": arm},
                (m,),
            )
            for arm in (f"policy, {taste}" for taste in (*TASTES, f"{_EMBEDDED}, embeddings"))
            for other in ("random", "FisherRF")
            for m, better_at in (("psnr_db", "better views"), ("path_m", "a shorter path"))
        ),
    ),
    draw=(_draw,),
    tables=_tables,
)
