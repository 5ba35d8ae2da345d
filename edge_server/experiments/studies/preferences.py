"""Figure 4.6, tables 4.2, 4.3: what is learned from the preferences of simulated experts, and its worth."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from edge_server.experiments.common.result_store import ResultStore, content_key
from edge_server.experiments.common.source_digest import source_digest
from edge_server.experiments.common.statistics import interval, paired
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.studies.drawing import draw_curve
from edge_server.experiments.studies.study import Study, StudyRequest, Table, Verdict
from edge_server.experiments.studies.trial import Row, scenario_of
from edge_server.experiments.studies.viewpoints import FULL, JUDGED, QUICK, SCENES, Workload, plan
from edge_server.experiments.viewpoints.reconstructions import taste_score, varied_plan
from edge_server.experiments.viewpoints.stage import Stage, open_embedder, open_stage
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Field
from edge_server.report.style import figure, label_lines
from edge_server.viewpoints.capture_planner import Budget, Plan, plan_capture
from edge_server.viewpoints.experts import TASTES, SimulatedExpert
from edge_server.viewpoints.features import StepFeatures
from edge_server.viewpoints.policy import PolicyConfig, train_policy
from edge_server.viewpoints.preference_model import RewardModel, fit_reward, next_pair
from freshfield.files import write_csv, write_text

ASKED = (10, 20, 40, 60)
HABITS: dict[str, dict[str, float | bool]] = {
    "careful": {},
    "10 % wrong": {"wrong": 0.1},
    "30 % lazy": {"lazy": 0.3},
    "contradicting": {"contradicts": True},
}
_UNSEEN = 400  # pairs
_EMBEDDED = "edges"  # the taste whose policy is also trained with embeddings of the captured pictures (4.8)
_TRAINED_ON = "10 % wrong"
_UPDATES = {True: 30, False: 80}  # of PPO
_POOL = {True: 60, False: 120}  # reconstructions; a third of them is kept for unseen pairs


class Preferences(Study):
    name = "preferences"
    title = "What preferences of simulated experts teach (figure 4.6, tables 4.2, 4.3)"

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        rows: list[Row] = []
        captures: list[Row] = []
        verdicts: list[Verdict] = []
        parts = ["# " + self.title, ""]
        store = ResultStore.in_lines(request.out / "trials" / "preferences.jsonl")
        for scene in request.scenes_here(SCENES[request.quick]):
            answered, captured, text = self._of_scene(request, scene, store)
            verdicts += judge_answers(scene, answered) + judge_captures(scene, captured)
            rows += [{"scene": scene, **row} for row in answered]
            captures += [{"scene": scene, **row} for row in captured]
            parts += [f"## {scene}", "", text, "", answer_table(answered), "", capture_table(captured), ""]
        store.close()
        write_csv(request.out / "preferences.csv", rows)
        write_csv(request.out / "preferences-captures.csv", captures)
        write_text(request.out / "preferences-tables.md", "\n".join(parts))
        return verdicts

    def _of_scene(self, request: StudyRequest, scene: str, store: ResultStore) -> tuple[list[Row], list[Row], str]:
        """Rows of answers and of captures of one scene, and what was done."""
        work = QUICK if request.quick else FULL
        stage = open_stage(str(scenario_of(scene).path), work.candidates, work.size, request.folders.data)
        pool = []
        for k in range(_POOL[request.quick]):
            key = content_key(["pool", scene, k, vars(work), source_digest()], 40)
            pool.append(store.get(key, compute=partial(reconstruct, stage, k, work)))
        steps = StepFeatures(stage.candidates)
        features = np.stack([steps.trajectory(item["order"]) for item in pool])
        scores = {taste: np.array([item[taste] for item in pool]) for taste in TASTES}
        seeds = request.repeats(6, 12)
        rows = [
            row
            for taste in TASTES
            for habit in HABITS
            for seed in seeds
            for row in question(features, scores[taste], taste, habit, seed)
        ]
        captures, curves = self._policies(request, scene, stage, work, features, scores, store)
        draw(request.out / f"preferences-{scene}.png", rows, curves)
        lens = stage.candidates.lens
        text = (
            f"Simulated experts only. {len(pool)} reconstructions of {JUDGED} views, {lens.width} x "
            f"{lens.height} pixels; a third of them kept for {_UNSEEN} unseen pairs. {len(seeds)} seeds. "
            "Means with 95 % intervals over seeds."
        )
        return rows, captures, text

    def _policies(
        self,
        request: StudyRequest,
        scene: str,
        stage: Stage,
        work: Workload,
        features: np.ndarray,
        scores: dict[str, np.ndarray],
        store: ResultStore,
    ) -> tuple[list[Row], dict[str, dict[float, dict[int, float | None]]]]:
        """Captures by a policy trained for each taste, and by others, with the same first views; and each
        policy's return against the number of updates (figure 4.6)."""
        captures: list[Row] = []
        curves: dict[str, dict[float, dict[int, float | None]]] = {}
        config = PolicyConfig(views=JUDGED, updates=_UPDATES[request.quick])
        embed, missing = open_embedder(stage.background)
        if missing:
            print(f"  embeddings are left out: {missing}")
        pictures = [stage.take(k).image for k in range(len(stage.candidates))]
        seen = embed(pictures).astype(np.float64) if embed else None

        def taught(taste: str, label: str, embedded: bool, seed: int) -> Row:
            """The returns of a training, what the reward model says, and the policy's capture."""
            expert = SimulatedExpert(taste, scores[taste], np.random.default_rng(seed), wrong=0.1)
            model = ask(expert, features, ASKED[-1])
            policy, returns = train_policy(
                stage.candidates, model.reward, config, seed, seen if embedded else None, embed
            )
            if seed == 0:
                policy.save(request.out / f"policy-{scene}-{label.replace(', ', '-')}.npz")
            # The seed draws the same first view as for the others.
            made = plan_capture(stage.candidates, policy, Budget(views=JUDGED), stage.take, seed=seed)
            says = f"{expert.label}: {model.says()}"
            return {"returns": returns, "says": says, "capture": _measured(stage, made, work, seed)}

        for seed in request.repeats(3, 5):
            for arm in ("random", "coverage", "coverage, short way", "FisherRF"):
                key = content_key([arm, scene, seed, vars(work), source_digest()], 40)
                run = partial(_capture, stage, arm, seed, work)
                captures.append({"arm": arm, "seed": seed, **store.get(key, compute=run)})
            for taste, embedded in [*((t, False) for t in TASTES), *([(_EMBEDDED, True)] if embed else [])]:
                label = f"{taste}, embeddings" if embedded else taste
                about = [label, scene, seed, len(features), vars(work), vars(config), source_digest()]
                run = partial(taught, taste, label, embedded, seed)
                found = store.get(content_key(["policy", *about], 40), compute=run)
                for n in range(0, config.updates, 5):
                    of_seed = curves.setdefault(label, {}).setdefault(float(n), {})
                    of_seed[seed] = float(np.mean(found["returns"][n : n + 5]))
                captures.append({"arm": f"policy, {label}", "seed": seed, **found["capture"]})
                print(f"  seed {seed}, {found['says']}", flush=True)
        return captures, curves


def reconstruct(stage: Stage, k: int, work: Workload) -> Row:
    """A reconstruction of the pool: its views, chosen in various ways, and the score of each taste."""
    made = varied_plan(stage, k, JUDGED)
    return {"order": made.order, **_tastes(stage, stage.fit(made.views, work.steps, k))}


def _tastes(stage: Stage, field: Field) -> Row:
    """The score of each taste."""
    return {taste: taste_score(stage, field, taste) for taste in TASTES}


def _capture(stage: Stage, arm: str, seed: int, work: Workload) -> Row:
    return _measured(stage, plan(stage, arm, seed, JUDGED, work), work, seed)


def _measured(stage: Stage, made: Plan, work: Workload, seed: int) -> Row:
    """Quality on the views held out, path, milliseconds of a choice, and the score of each taste."""
    field = stage.fit(made.views, work.steps, seed)
    score = stage.score(field, Scorer(background=stage.background))
    choice_ms = 1e3 * float(np.mean([stop.seconds for stop in made.stops[1:]]))
    return {
        "psnr_db": score.psnr_db,
        "ssim": score.ssim,
        "path_m": made.path_m,
        "choice_ms": choice_ms,
        **_tastes(stage, field),
    }


def ask(expert: SimulatedExpert, features: np.ndarray, answers: int) -> RewardModel:
    """The reward model after so many answers, each to the pair that tells most."""
    model = fit_reward(features, expert.asked)
    while len(expert.asked) < answers:
        expert.answer(*next_pair(model, features, expert.rng))
        model = fit_reward(features, expert.asked)
    return model


def question(features: np.ndarray, scores: np.ndarray, taste: str, habit: str, seed: int) -> list[Row]:
    """A row for each number of answers: agreement with the expert, and with its taste, on unseen pairs."""
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
    meant = np.array([other.taste_prefers(i, j) for i, j in zip(first, second)])
    rows = []
    for answers in ASKED:
        model = ask(expert, features[asked], answers)
        expects = model.probability(features[unseen], first, second) > 0.5
        rows.append(
            {
                "expert": expert.label,
                "taste": taste,
                "habit": habit,
                "seed": seed,
                "answers": answers,
                "agreement": float((expects == said).mean()),
                "with_taste": float((expects == meant).mean()),
                "with_itself": float((said == again).mean()),
                "odds": model.odds,
                "knows": model.knows,
            }
        )
    return rows


def _of(rows: list[Row], metric: str, **labels: object) -> dict[int, float | None]:
    """seed -> value of the rows with these labels."""
    return {r["seed"]: r[metric] for r in rows if all(r[k] == v for k, v in labels.items())}


def judge_answers(scene: str, rows: list[Row]) -> list[Verdict]:
    """Verdicts on what the reward model learned in a scene."""
    verdicts = []
    for taste in TASTES:
        here = _of(rows, "agreement", taste=taste, habit=_TRAINED_ON, answers=ASKED[-1])
        itself = _of(rows, "with_itself", taste=taste, habit=_TRAINED_ON, answers=ASKED[-1])
        share = interval([a / b for s in here if (a := here[s]) is not None and (b := itself[s])])
        verdicts.append(
            Verdict(
                f"{scene}, simulated expert, {taste}, 10 % wrong",
                f"after {ASKED[-1]} answers at least 90 % of the expert's agreement with itself.",
                f"{share.text(3)} of it, on unseen pairs.",
                share.above(0.9),
                share,
            )
        )
    unsure = [not r["knows"] for r in rows if r["habit"] == "contradicting" and r["answers"] == ASKED[-1]]
    sure = [r["knows"] for r in rows if r["habit"] == "careful" and r["answers"] == ASKED[-1]]
    verdicts.append(
        Verdict(
            f"{scene}, simulated experts, contradicting",
            "the model says that it does not know.",
            f"it says so in {sum(unsure)} of {len(unsure)} cases; of careful experts it says that it knows in "
            f"{sum(sure)} of {len(sure)}.",
            sum(unsure) >= 0.9 * len(unsure),
        )
    )
    return verdicts


def judge_captures(scene: str, captures: list[Row]) -> list[Verdict]:
    """Verdicts on the captures of a scene by trained policies: quality and way."""
    verdicts = []
    for arm in [a for a in dict.fromkeys(c["arm"] for c in captures) if a.startswith("policy")]:
        for other in ("random", "FisherRF"):
            gain = paired(_of(captures, "psnr_db", arm=arm), _of(captures, "psnr_db", arm=other))
            way = paired(_of(captures, "path_m", arm=other), _of(captures, "path_m", arm=arm))
            about = f"{scene}, {arm}, {JUDGED} views"
            verdicts += [
                Verdict(about, f"better than {other} (table 4.3).", f"{gain.text(2)} dB.", gain.above(0.0), gain),
                Verdict(
                    f"{about}, path",
                    f"shorter than {other}'s (table 4.3).",
                    f"{way.text(2)} m shorter.",
                    way.above(0.0),
                    way,
                ),
            ]
    return verdicts


def answer_table(rows: list[Row]) -> str:
    """Agreement on unseen pairs against the number of answers, in Markdown."""
    lines = []
    for expert in dict.fromkeys(r["expert"] for r in rows):
        cells = [interval(list(_of(rows, "agreement", expert=expert, answers=n).values())).text(2) for n in ASKED]
        itself = interval(list(_of(rows, "with_itself", expert=expert, answers=ASKED[-1]).values()))
        knows = list(_of(rows, "knows", expert=expert, answers=ASKED[-1]).values())
        lines.append([expert, *cells, f"{itself.mean:.2f}", f"{sum(map(bool, knows))} of {len(knows)}"])
    head = ["agreement after", *(f"{n} answers" for n in ASKED), "expert with itself", "says it knows"]
    return markdown_table(head, lines)


def capture_table(captures: list[Row]) -> str:
    """Captures of ``JUDGED`` views by arm, in Markdown. Scores of the tastes: of pictures, 0 is the truth."""
    kinds = (("psnr_db", 2), ("ssim", 3), ("path_m", 2), *((taste, 4) for taste in TASTES))
    lines = [
        [
            arm,
            *(interval(list(_of(captures, m, arm=arm).values())).text(d) for m, d in kinds),
            f"{interval(list(_of(captures, 'choice_ms', arm=arm).values())).mean:.0f}",
        ]
        for arm in dict.fromkeys(c["arm"] for c in captures)
    ]
    head = ["views by", "PSNR (dB)", "SSIM", "path (m)", *(f"score, {t}" for t in TASTES), "a choice (ms)"]
    return markdown_table(head, lines)


def draw(path: Path, rows: list[Row], curves: dict[str, dict[float, dict[int, float | None]]]) -> None:
    """Agreement against answers, and the policies' returns against updates (figure 4.6)."""
    with figure(path, 2, height_inch=2.8) as (_, axes):
        for k, expert in enumerate(dict.fromkeys(r["expert"] for r in rows)):
            curve = {float(n): _of(rows, "agreement", expert=expert, answers=n) for n in ASKED}
            draw_curve(axes[0, 0], curve, expert, k)
        label_lines(axes[0, 0], "agreement, unseen pairs", "answers")
        for k, (taste, curve) in enumerate(curves.items()):
            draw_curve(axes[1, 0], curve, f"taught by a simulated expert ({taste})", k)
        label_lines(axes[1, 0], "return of an episode", "updates of PPO")
