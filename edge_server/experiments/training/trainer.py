"""Trains a learner: roll out episodes with drawn actions, reward their outcomes, update the weights.

Several samples are taken of every decision. The baseline of a sample is the mean reward of the others of its decision
(``sibling_advantages``): an estimate of V(s) (5.24) for this scene and channel, which a function of the state cannot
know. It reduces the variance of the policy gradient without a bias.

The seed determines everything: episodes by their numbers, actions by the episode and the number of the sample, rewards
by the field fits. The learner is the only state between two batches, so a stopped run continues bit for bit from its
last checkpoint, on the same kind of processor.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common import tables
from edge_server.experiments.common.folders import Folders
from edge_server.experiments.engine import Engine
from edge_server.experiments.engine.content_key import processor
from edge_server.experiments.rollouts.episode import Outcome, mean_outcome
from edge_server.experiments.rollouts.rollout import Run, embeddings_seen, run_rollouts
from edge_server.experiments.rollouts.setting import Setting, seeds
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.rewards import Reward, RewardTerms
from freshfield.files import write_json, write_text

if TYPE_CHECKING:
    from edge_server.scheduler.learned.ppo import Learner

Row = dict[str, Any]
Say = Callable[[str], None]


class TrainingError(ValueError):
    """A training that cannot be run as asked; the message says what to change."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a learner is trained.

    spec: specification of the learner.
    reward: the reward of an outcome.
    episodes: total number of episodes.
    batch: number of episodes of one update of the weights.
    samples: actions that are tried at every decision.
    seed: seed of the episodes and of the learner.
    Raises TrainingError for values out of range.
    """

    spec: Spec
    reward: Reward
    episodes: int = tuned.EPISODES
    batch: int = tuned.EPISODES_A_BATCH
    samples: int = tuned.ACTION_SAMPLES
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.episodes, self.batch, self.samples) < 1:
            raise TrainingError("episodes, batch and samples: expected at least 1")

    @property
    def batches(self) -> int:
        return -(-self.episodes // self.batch)

    def seeds(self, number: int) -> range:
        """Seeds of the episodes of a batch."""
        first = number * self.batch
        return seeds(self.seed, "train", min(self.batch, self.episodes - first), first)


def train(
    setting: Setting, config: TrainingConfig, folders: Folders, jobs: int, out: Path, say: Say, ray: str | None = None
) -> Learner:
    """Train for all episodes; a training with the same settings in ``out`` is continued.

    Writes OUT/training.jsonl (a line per batch), OUT/training.json and, at the end, OUT/policy.npz. After
    KeyboardInterrupt the checkpoint of the last batch is there.

    setting: the setting that decisions are drawn from.
    jobs, ray: as in ``Engine``.
    say: called with lines of progress.

    Returns the trained learner. Raises TrainingError if ``out`` holds a training with other settings, or if the first
    batch has no reward.
    """
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = _Checkpoint(out, _settings_key(setting, config))
    learner, rows = checkpoint.load()
    began, first = time.monotonic(), len(rows)
    if first and first < config.batches:
        say(f"going on after {first} of {config.batches} batches")
    if learner is None:
        (out / "policy.npz").unlink(missing_ok=True)  # of an earlier training
        learner = _new_learner(setting, config, folders, jobs, ray)
    for number in range(first, config.batches):
        batch_began = time.monotonic()
        engine = Engine(jobs=jobs, ray=ray, threads=1, say=None)
        row = _train_batch(setting, config, folders, engine, learner, number)
        rows.append({**row, "seconds": round(time.monotonic() - batch_began, 3)})
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
    setting: Setting, config: TrainingConfig, folders: Folders, engine: Engine, learner: Learner, number: int
) -> Row:
    """Do one update of the weights; returns its row of the log. After the first, a batch without a
    reward changes no weights. Raises TrainingError if the first batch has no reward."""
    from edge_server.scheduler.learned.ppo import Batch

    episode_seeds = config.seeds(number)
    found = run_rollouts(
        engine,
        setting,
        folders,
        episode_seeds,
        {"learner": learner.actor},
        explore=True,
        name=f"batch {number + 1}",
        samples=config.samples,
    )["learner"]
    samples = [of[0] for of in found.values()]
    decided = [d for runs in samples for run in runs for d in run.decided]
    outcomes = [mean_outcome(list(d.outcomes.values())) for d in decided]
    terms = [config.reward.of(outcome) for outcome in outcomes]
    if number == 0 and not any(t.complete for t in terms):
        raise TrainingError(_missing_reward_reason(outcomes, terms))
    row = _row(config, episode_seeds, terms, outcomes, [d.action for d in decided])
    row |= {"decisions": sum(len(runs[0].decided) for runs in samples), "fits": len(decided)}
    update = learner.update(
        Batch(
            np.array([d.features for d in decided]),
            np.array([d.action for d in decided]),
            np.array([d.logp for d in decided]),
            np.concatenate([sibling_advantages(runs, config.reward).ravel() for runs in samples]),
        )
    )
    return row | {k: v for k, v in dataclasses.asdict(update).items() if k != "reward"}


def sibling_advantages(runs: Sequence[Run], reward: Reward) -> NDArray[np.float64]:
    """For each sample of an episode, and each of its decisions, the reward minus the mean of the other samples'
    (leave-one-out baseline); NaN for a missing reward, or if no other sample has one there. With a single sample its
    rewards."""
    rewards = np.array(
        [[_complete(reward.of(mean_outcome(list(d.outcomes.values())))) for d in run.decided] for run in runs]
    )
    if len(runs) == 1:
        return rewards
    others = [np.delete(rewards, k, axis=0) for k in range(len(runs))]
    with np.errstate(invalid="ignore"):  # none of the others has one
        return rewards - np.stack([np.nansum(of, axis=0) / np.isfinite(of).sum(axis=0) for of in others])


def _row(
    config: TrainingConfig,
    episode_seeds: range,
    found: Sequence[RewardTerms],
    outcomes: Sequence[Outcome],
    actions: Sequence[Any],
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


def _complete(found: RewardTerms) -> float:
    """A reward that lacks a term cannot be compared with others: NaN."""
    return float("nan") if found.total is None or not found.complete else found.total


def _missing_reward_reason(outcomes: list[Outcome], found: list[RewardTerms]) -> str:
    """Why none of these outcomes has a reward, and what to change."""
    if not any(outcome.views for outcome in outcomes):
        return "nothing had arrived at any decision of the first batch: look at the scenario's channel"
    missing = dict.fromkeys(name for r in found for name in r.missing)
    return (
        f"no decision of the first batch has a reward, it lacks {', '.join(missing)} (lpips: see --lpips, or leave it "
        "out with edge.lpips: none; psnr_moving: nothing moves where the held-out cameras look: --on whole)"
    )


def _new_learner(setting: Setting, config: TrainingConfig, folders: Folders, jobs: int, ray: str | None) -> Learner:
    from edge_server.scheduler.learned.ppo import Learner

    spec = config.spec
    if "semantics" in spec.layout.parts and not spec.layout.center:
        work = partial(embeddings_seen, setting=setting, folders=folders)
        rows = Engine(jobs=jobs, ray=ray, threads=1, say=None).run(work, list(config.seeds(0)))
        seen = np.array([z for of in rows for z in of], np.float64).reshape(-1, spec.layout.dim)
        spec = dataclasses.replace(spec, layout=spec.layout.standardized(seen))
    return Learner(spec, config.seed)


@dataclass(frozen=True)
class _Checkpoint:
    """Checkpoint of a training. The weights are written first, under a new name, then the file that names them, so
    the checkpoint is complete whenever the process is stopped."""

    out: Path
    key: str

    def load(self) -> tuple[Learner | None, list[Row]]:
        """The learner and the rows of its log; (None, []) if there is no training here. Raises TrainingError."""
        from edge_server.scheduler.learned.ppo import Learner

        path = self.out / "training.json"
        if not path.exists():
            return None, []
        try:
            found = json.loads(path.read_text())
            if found["key"] != self.key:
                raise ValueError("it is a training with other settings or of another kind of processor")
            batches = int(found["batches"])
            lines = (self.out / "training.jsonl").read_text().splitlines()[:batches]
            if len(lines) < batches:
                raise ValueError(f"training.jsonl has {len(lines)} of {batches} batches")
            return Learner.load(self.out / str(found["weights"])), [json.loads(line) for line in lines]
        except (OSError, ValueError, KeyError, TypeError) as error:
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
    parts = [processor(), setting.key, dataclasses.asdict(config)]
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:24]


def _progress_text(config: TrainingConfig, row: Row) -> str:
    omega = f", omega {row['omega_ms']:.0f} ms" if row.get("omega_ms") is not None else ""
    reward, views = tables.number(row["reward"], 4), tables.number(row["views"], 1)
    return f"{row['episodes']}/{config.episodes} episodes: reward {reward}, {views} views{omega}"


def _mean(values: Any) -> float | None:
    known = [float(v) for v in values if v is not None and np.isfinite(v)]
    return float(np.mean(known)) if known else None
