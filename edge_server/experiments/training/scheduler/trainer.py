"""Trains a learner: draw decisions, draw actions, evaluate them by field fits, update the weights.

Several actions are tried at every decision. The baseline of a try is the mean reward of the other tries of
its decision (``subtract_sibling_baseline``), which reduces the variance of the policy gradient.

The seed determines everything: episodes by their numbers, actions by the learner's random stream, rewards by
the field fits. The learner is the only state between two batches, so a stopped run continues bit for bit from
its last checkpoint, on the same kind of processor.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.common import tables
from edge_server.experiments.common.result_store import content_key
from edge_server.experiments.training.scheduler.choices import choice_of_action
from edge_server.experiments.training.scheduler.deployed import Decided, sibling_advantages
from edge_server.experiments.training.scheduler.episode import Outcome
from edge_server.experiments.training.scheduler.setting import Setting, seeds
from edge_server.experiments.training.scheduler.workers import Progress, WorkerPool
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.rewards import Reward, RewardTerms
from freshfield.files import write_json, write_text

if TYPE_CHECKING:
    from edge_server.scheduler.learned.ppo import Learner

Row = dict[str, Any]
_PROGRESS_EVERY_S = 5.0
# Files that train-scheduler writes after a training.
REPORTS = ("summary.json", "evaluation.csv")


class TrainingError(ValueError):
    """A training that cannot be run as asked; the message says what to change."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a learner is trained.

    spec: specification of the learner.
    reward: the reward of an outcome.
    episodes: total number of episodes.
    batch: number of episodes of one update of the weights.
    tries: actions that are evaluated at every decision. With more than one, the baseline of each is the mean
        reward of the others: an estimate of V(s) (5.24) for this scene and channel, which a function of the
        state cannot know.
    seed: seed of the episodes and of the learner.
    checkpoint_every: number of batches between checkpoints.
    Raises TrainingError for values out of range.
    """

    spec: Spec
    reward: Reward
    episodes: int = 600
    batch: int = 10
    tries: int = 2
    seed: int = 0
    checkpoint_every: int = 5

    def __post_init__(self) -> None:
        if min(self.episodes, self.batch, self.tries, self.checkpoint_every) < 1:
            raise TrainingError("episodes, batch, tries and checkpoint_every: expected at least 1")

    @property
    def batches(self) -> int:
        return -(-self.episodes // self.batch)

    def seeds(self, number: int) -> range:
        """Seeds of the episodes of a batch."""
        first = number * self.batch
        return seeds(self.seed, "train", min(self.batch, self.episodes - first), first)


def train(setting: Setting, config: TrainingConfig, pool: WorkerPool, out: Path, say: Callable[[str], None]) -> Learner:
    """Train for all episodes; a training with the same settings in ``out`` is continued.

    Writes OUT/training.jsonl (a line per batch), OUT/training.json and, at the end, OUT/policy.npz. After
    KeyboardInterrupt the last checkpoint is there.

    setting: the setting that decisions are drawn from.
    pool: draws and evaluates them.
    say: called with lines of progress.

    Returns the trained learner. Raises TrainingError if ``out`` holds a training with other settings, or if
    the first batch has no reward.
    """
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = _Checkpoint(out, _settings_key(setting, config))
    learner, rows = checkpoint.load()
    began, first = time.monotonic(), len(rows)
    if first and first < config.batches:
        say(f"going on after {first} of {config.batches} batches")
    if learner is None:
        # The policy and reports of an earlier training must not be taken for those of this one.
        for name in ("policy.npz", *REPORTS):
            (out / name).unlink(missing_ok=True)
        learner = _new_learner(setting, config, pool)
    learner.reward_fields = dataclasses.asdict(config.reward)
    for number in range(first, config.batches):
        batch_began = time.monotonic()
        row = _train_batch(setting, config, pool, learner, number, say)
        rows.append({**row, "seconds": round(time.monotonic() - batch_began, 3)})
        if (number + 1) % config.checkpoint_every == 0 or number + 1 == config.batches:
            checkpoint.save(learner, rows)
        spent = time.monotonic() - began
        left = spent / (number + 1 - first) * (config.batches - number - 1)
        say(f"{_progress_text(config, row)}; {left:.0f} s left")
    learner.save(out / "policy.npz")
    return learner


def read_log(out: Path) -> list[Row]:
    """The log of a training so far, one row per batch."""
    return [json.loads(line) for line in (out / "training.jsonl").read_text().splitlines()]


def _train_batch(
    setting: Setting,
    config: TrainingConfig,
    pool: WorkerPool,
    learner: Learner,
    number: int,
    say: Callable[[str], None],
) -> Row:
    """Do one update of the weights; returns its row of the log. Raises TrainingError if the first batch has
    no reward."""
    episode_seeds = config.seeds(number)
    if config.spec.hold_ms:
        return _train_deployed_batch(setting, config, pool, learner, number)
    moments = [m for episode in pool.draw(setting, episode_seeds) for m in episode]
    pool.forget(setting, episode_seeds)
    # The tries of one decision are adjacent.
    each = [m for m in moments for _ in range(config.tries)]
    states = [m.state for m in each]
    actions, logps = learner.act(states)
    requests = [(m.seed, m.number, choice_of_action(config.spec, a, m)) for m, a in zip(each, actions)]
    before = pool.evaluated
    outcomes = pool.evaluate(setting, requests, periodic_progress(say, f"fits of batch {number + 1}"))
    found = [config.reward.of(outcome) for outcome in outcomes]
    # Rewards that lack a term cannot be compared with others.
    rewards = np.array([_complete(r) for r in found])
    if number == 0 and not np.isfinite(rewards).any():
        raise TrainingError(_missing_reward_reason(outcomes, found))
    advantages = subtract_sibling_baseline(rewards, config.tries)
    update = learner.update(learner.batch(states, actions, logps, advantages))
    row = _row(config, episode_seeds, found, outcomes, actions) | {
        "decisions": len(moments),
        "fits": len(each),
        "carried_out": pool.evaluated - before,
        "processor_seconds": pool.cost_s(setting, requests),
    }
    return row | {k: v for k, v in dataclasses.asdict(update).items() if k != "reward"}


def _row(
    config: TrainingConfig,
    episode_seeds: range,
    found: Sequence[RewardTerms],
    outcomes: Sequence[Outcome],
    actions: Iterable[Any],
) -> Row:
    """The part of a batch's row of the log that describes its decisions."""
    first = config.seeds(0)[0]
    row: Row = {
        "batch": (episode_seeds[0] - first) // config.batch,
        "episodes": episode_seeds[-1] + 1 - first,
        "reward": _mean([_complete(r) for r in found]),
    }
    terms = found[0].terms if found else ()
    row |= {f"term_{name}": _mean([r.terms[name] for r in found]) for name in terms}
    row |= {f.name: _mean([getattr(o, f.name) for o in outcomes]) for f in dataclasses.fields(Outcome)}
    if config.spec.action != "select":
        row["omega_ms"] = _mean([config.spec.omegas_ms[int(a)] for a in actions])
    return row


def _train_deployed_batch(
    setting: Setting, config: TrainingConfig, pool: WorkerPool, learner: Learner, number: int
) -> Row:
    """``_train_batch`` for a learner that decides in the running deployment (``deployed``). After the first,
    a batch without a decision or a reward changes no weights."""
    episode_seeds = config.seeds(number)
    each: list[Decided] = []
    advantages: list[NDArray[np.float64]] = []
    for tries in pool.play(setting, episode_seeds, learner.actor, config.tries):
        rewards = [[_complete(config.reward.of(d.outcome)) for d in one] for one in tries]
        advantages += sibling_advantages(tries, config.spec.hold_ms, rewards)
        each += [d for one in tries for d in one]
    found = [config.reward.of(d.outcome) for d in each]
    if number == 0 and not any(r.complete for r in found):
        raise TrainingError(_missing_reward_reason([d.outcome for d in each], found))
    decisions = [d.decision for d in each]
    row = _row(config, episode_seeds, found, [d.outcome for d in each], [d.action for d in decisions])
    if not each:  # nothing arrived in any of its episodes
        return row | {"decisions": 0}
    batch = learner.batch(
        [d.state for d in decisions],
        np.array([d.action for d in decisions]),
        np.array([d.logp for d in decisions]),
        np.concatenate(advantages),
    )
    update = dataclasses.asdict(learner.update(batch))
    return row | {"decisions": len(each)} | {k: v for k, v in update.items() if k != "reward"}


def _complete(found: RewardTerms) -> float:
    return float("nan") if found.total is None or not found.complete else found.total


def periodic_progress(say: Callable[[str], None], what: str) -> Progress:
    """Progress of evaluations that prints a line every few seconds."""
    last_s = time.monotonic()

    def progress(done: int, count: int) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= _PROGRESS_EVERY_S:
            last_s = time.monotonic()
            say(f"{done}/{count} {what}")

    return progress


def _missing_reward_reason(outcomes: list[Outcome], found: list[RewardTerms]) -> str:
    """Why none of these outcomes has a reward, and what to change."""
    if not any(outcome.views for outcome in outcomes):
        return "nothing had arrived at any decision of the first batch: look at the scenario's channel"
    missing = list(dict.fromkeys(name for r in found for name in r.missing))
    hints = {
        "lpips": "lpips: see edge.lpips and --lpips, or leave it out with --distance none",
        "perceptual": "perceptual: see edge.metrics, or leave it out with --distance none",
        "psnr_moving": "psnr_moving: nothing moves where the held-out cameras look; --on whole",
    }
    return "no decision of the first batch has a reward, it lacks " + "; ".join(
        hints.get(name, name) for name in missing
    )


def subtract_sibling_baseline(rewards: NDArray[np.float64], tries: int) -> NDArray[np.float64]:
    """Subtract from each reward the mean reward of its siblings, the other tries of the same decision
    (leave-one-out baseline), which reduces the variance of the gradient without a bias.

    rewards: (B,), the tries of one decision next to each other; NaN for a missing reward.
    tries: number of tries of a decision; with one there are no siblings and the rewards are returned.

    Returns (B,); NaN if the reward or those of all siblings are NaN.
    """
    if tries == 1:
        return rewards
    table = rewards.reshape(-1, tries)
    known = np.isfinite(table)
    filled = np.where(known, table, 0.0)
    count = known.sum(axis=1, keepdims=True) - known
    with np.errstate(divide="ignore", invalid="ignore"):
        others = (filled.sum(axis=1, keepdims=True) - filled) / count
    return np.where(known, table - others, np.nan).reshape(-1)


def _new_learner(setting: Setting, config: TrainingConfig, pool: WorkerPool) -> Learner:
    from edge_server.scheduler.learned.ppo import Learner

    spec = config.spec
    if "semantics" in spec.layout.parts and not spec.layout.centre:
        if spec.hold_ms:
            untrained = Learner(spec, config.seed).actor
            played = pool.play(setting, config.seeds(0), untrained, 1)
            states = [d.decision.state for tries in played for one in tries for d in one]
        else:
            states = [m.state for e in pool.draw(setting, config.seeds(0)) for m in e]
        spec = dataclasses.replace(spec, layout=spec.layout.standardized(states))
    return Learner(spec, config.seed)


@dataclass(frozen=True)
class _Checkpoint:
    """Checkpoint of a training. The weights are written first, under a new name, then the file that names
    them, so the checkpoint is complete whenever the process is stopped."""

    out: Path
    key: str

    def load(self) -> tuple[Learner | None, list[Row]]:
        """The learner and the rows of its log; (None, []) if there is no training here. Raises
        TrainingError."""
        from edge_server.scheduler.learned.ppo import Learner

        path = self.out / "training.json"
        if not path.exists():
            return None, []
        try:
            found = json.loads(path.read_text())
            key, name, done = found["key"], str(found["weights"]), int(found["batches"])
        except (ValueError, KeyError, TypeError):
            raise TrainingError(f"{path}: damaged: choose another --out, or delete it") from None
        if key != self.key:
            raise TrainingError(
                f"{self.out} holds a training with other settings or of another kind of processor: "
                "choose another --out, or delete it"
            )
        try:
            lines = (self.out / "training.jsonl").read_text().splitlines()[:done]
            return Learner.load(self.out / name), [json.loads(line) for line in lines]
        except (OSError, ValueError) as error:
            raise TrainingError(f"{self.out}: cannot go on: {error}: choose another --out, or delete it") from None

    def save(self, learner: Learner, rows: list[Row]) -> None:
        name = f"weights-{len(rows):05d}.npz"
        learner.save(self.out / name)
        write_text(self.out / "training.jsonl", "".join(json.dumps(row) + "\n" for row in rows))
        write_json(self.out / "training.json", {"key": self.key, "batches": len(rows), "weights": name})
        for old in self.out.glob("weights-*.npz"):
            if old.name != name:
                old.unlink(missing_ok=True)


def _settings_key(setting: Setting, config: TrainingConfig) -> str:
    settings = dataclasses.asdict(config)
    settings.pop("checkpoint_every")  # does not affect what is learned
    return content_key(json.dumps([setting.key, settings], sort_keys=True, default=str), 24)


def _progress_text(config: TrainingConfig, row: Row) -> str:
    omega = f", omega {row['omega_ms']:.0f} ms" if row.get("omega_ms") is not None else ""
    reward, views = tables.number(row["reward"], 4), tables.number(row["views"], 1)
    return f"{row['episodes']}/{config.episodes} episodes: reward {reward}, {views} views{omega}"


def _mean(values: Any) -> float | None:
    known = [float(v) for v in values if v is not None and np.isfinite(v)]
    return float(np.mean(known)) if known else None
