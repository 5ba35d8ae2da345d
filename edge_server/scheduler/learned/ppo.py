"""Single-step PPO (5.23, algorithm 1) and contextual-bandit PPO (6.42, algorithm 2): one learner.

An episode is one decision, so Q is the reward itself and the advantage (5.24) is r - V(s), without discount or
bootstrapping. The two algorithms differ only in the action distribution (Bernoulli per camera, categorical over
omega), which the specification sets.

    learner = Learner(Spec("select", StateLayout(("age",))), seed=1)
    actions, logps = learner.actor.act(states, rng)
    rewards = [...]                                  # from fields that were actually fitted
    learner.update(Batch(learner.spec.layout.batch(states), actions, logps, rewards))

Same seed and same rewards give the same weights bit for bit: torch runs on one thread (the networks are too
small for more), and random numbers are numpy's.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned import learning_constants as tuned
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.actor import KIND, Actor, read_spec
from edge_server.scheduler.learned.clipped_update import Acted, UpdateFigures, clipped_update
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.torch_threads import one_torch_thread

# Rewards that vary by less than this share of their size, or of all rewards' standard deviation, are
# constant.
_CONSTANT = 1e-9
# No measured reward is larger; its square would overflow.
_MAX_REWARD = 1e100
# Random streams. "actions" is unused, but removing it would change the others of a seed.
_STREAMS = ("weights", "actions", "order")


@dataclass(frozen=True)
class Batch:
    """Decisions and their rewards.

    features: (B, N, width). actions: (B, N) bool, or (B,) index of an omega. logps: (B,) log-probabilities
    under the policy that acted. rewards: (B,), NaN if missing.
    """

    features: NDArray[np.float64]
    actions: NDArray[Any]
    logps: NDArray[np.float64]
    rewards: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.rewards)


@dataclass(frozen=True)
class Diagnostics(UpdateFigures):
    """Figures of an update; all 0 for a batch without a usable decision.

    reward: mean of the finite ones. dropped: decisions whose reward or log-probability was not finite.
    """

    reward: float | None
    dropped: int


class Learner:
    """Learns ``spec`` from batches, repeatably: ``seed`` determines weights, exploration and minibatches."""

    def __init__(self, spec: Spec, seed: int = 0) -> None:
        self.spec = spec
        self.seed = seed
        self.updates = 0
        self.decisions = 0
        streams = np.random.SeedSequence(seed).spawn(len(_STREAMS))
        self._rng = {name: np.random.default_rng(s) for name, s in zip(_STREAMS, streams)}
        actor = networks.init_actor(spec, self._rng["weights"])
        value = networks.init_value(spec, self._rng["weights"])
        self._actor = {name: torch.tensor(w, requires_grad=True) for name, w in actor.items()}
        self._value = {name: torch.tensor(w, requires_grad=True) for name, w in value.items()}
        self._parameters = [*self._actor.values(), *self._value.values()]
        self._adam = torch.optim.Adam(self._parameters, lr=spec.learning_rate)
        self._rewards = _RunningMeanStd()
        # Over all cameras of all decisions.
        self._mean_features, self._cameras_seen = np.zeros(spec.layout.width), 0

    # --- deciding -----------------------------------------------------------------------------------

    @property
    def actor(self) -> Actor:
        """The current actor, a copy in numpy that later updates do not change."""
        weights = {name: w.detach().numpy().copy() for name, w in self._actor.items()}
        return Actor(self.spec, weights, mean_features=self._mean_features.copy())

    # --- learning -----------------------------------------------------------------------------------

    def update(self, batch: Batch) -> Diagnostics:
        """Improve the policy by one batch. Decisions without a finite reward are dropped; a batch of only
        such decisions changes nothing."""
        # NaN compares as False.
        usable = (np.abs(batch.rewards) < _MAX_REWARD) & np.isfinite(batch.logps)
        dropped = int((~usable).sum())
        if not usable.any():
            return Diagnostics(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, None, dropped)
        rewards = batch.rewards[usable]
        mean = float(rewards.mean())
        self._rewards.add(rewards)
        self.updates += 1
        self.decisions += len(rewards)
        cameras = batch.features[usable][batch.features[usable][..., -1] > 0]
        if len(cameras):
            self._cameras_seen += len(cameras)
            self._mean_features += (cameras - self._mean_features).sum(axis=0) / self._cameras_seen
        with one_torch_thread():
            figures = self._improve(
                torch.tensor(batch.features[usable]),
                torch.tensor(batch.actions[usable]),
                torch.tensor(batch.logps[usable]),
                torch.tensor(self._rewards.standardized(rewards)),
            )
        return Diagnostics(**asdict(figures), reward=mean, dropped=dropped)

    def _improve(
        self, features: torch.Tensor, actions: torch.Tensor, logps: torch.Tensor, rewards: torch.Tensor
    ) -> UpdateFigures:
        """``clipped_update`` with normalized advantages."""
        spec = self.spec
        with torch.no_grad():
            baseline = networks.value(torch, self._value, features)
        spread = rewards.std(correction=0).item()
        # A single reward counts as varying: it was standardized by the earlier ones.
        varies = spread > _CONSTANT or (len(rewards) == 1 and self._rewards.variance > 0.0)
        # If no action made a difference, only errors of V remain.
        advantages = self._normalized_advantages(rewards - baseline) if varies else torch.zeros_like(rewards)

        def evaluate(some: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
            logits = networks.logits(torch, spec, self._actor, features[some])
            now, entropy = log_probability(spec, logits, features[some], actions[some])
            return now, entropy, networks.value(torch, self._value, features[some])

        acted = Acted(logps, advantages, rewards)
        return clipped_update(spec, evaluate, acted, self._parameters, self._adam, self._rng["order"])

    @staticmethod
    def _normalized_advantages(raw: torch.Tensor) -> torch.Tensor:
        """(B,) with mean 0 and, unless nearly constant, standard deviation 1; a single one as it is, since V
        alone is its baseline (5.24; algorithms 1 and 2 update after every slot). ``raw`` is in units of the
        rewards' standard deviation."""
        if len(raw) == 1:
            return raw
        centered = raw - raw.mean()
        return centered / torch.clamp(centered.std(correction=0), min=tuned.MIN_ADVANTAGE_STD)

    # --- keeping ------------------------------------------------------------------------------------

    def save(self, path: Path | str) -> None:
        """Write everything, so that a learner loaded from ``path`` continues bit for bit. Atomic. Raises OSError if
        it cannot be written."""
        arrays = {f"actor.{name}": w.detach().numpy() for name, w in self._actor.items()}
        arrays["usual"] = self._mean_features
        arrays |= {f"value.{name}": w.detach().numpy() for name, w in self._value.items()}
        for i, parameter in enumerate(self._parameters):
            for name, kept in self._adam.state.get(parameter, {}).items():
                arrays[f"adam.{i}.{name}"] = kept.detach().numpy()
        about = {
            "spec": self.spec.as_json(),
            "seed": self.seed,
            "updates": self.updates,
            "decisions": self.decisions,
            "cameras_seen": self._cameras_seen,
            "rewards": self._rewards.as_json(),
            "streams": {name: json.dumps(rng.bit_generator.state) for name, rng in self._rng.items()},
        }
        checkpoint.save(path, arrays, about, kind=KIND)

    @staticmethod
    def load(path: Path | str) -> Learner:
        """A learner as ``save`` left it. checkpoint.CheckpointError (a ValueError) for anything else."""
        arrays, about = checkpoint.load(path, kind=KIND, most_bytes=tuned.MAX_LEARNER_BYTES)
        spec = read_spec(path, about)
        if "seed" not in about:
            raise checkpoint.CheckpointError(
                f"{path}: holds only a policy, and learning cannot resume from it: take the policy.npz of "
                "edge-server train-scheduler"
            )
        try:
            learner = Learner(spec, int(about["seed"]))
            learner._restore(arrays, about)
        except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise checkpoint.CheckpointError(f"{path}: damaged: {error}") from None
        return learner

    def _restore(self, arrays: dict[str, NDArray[Any]], about: dict[str, Any]) -> None:
        with torch.no_grad():
            for part, weights in (("actor", self._actor), ("value", self._value)):
                for name, w in weights.items():
                    w.copy_(_checked_tensor(arrays[f"{part}.{name}"], w))
        for i, parameter in enumerate(self._parameters):
            if f"adam.{i}.step" in arrays:  # before the first update Adam has no moments
                step = np.asarray(arrays[f"adam.{i}.step"], np.float32)
                mean, square = (_checked_tensor(arrays[f"adam.{i}.{n}"], parameter) for n in ("exp_avg", "exp_avg_sq"))
                if step.shape != () or not 1.0 <= step < np.inf or (square < 0.0).any():
                    raise ValueError("Adam's moments are invalid")
                self._adam.state[parameter] = {"step": torch.tensor(step), "exp_avg": mean, "exp_avg_sq": square}
        self._mean_features = _checked_tensor(arrays["usual"], torch.tensor(self._mean_features)).numpy()
        self._cameras_seen = int(about["cameras_seen"])
        self.updates, self.decisions = int(about["updates"]), int(about["decisions"])
        self._rewards = _RunningMeanStd.from_json(about["rewards"])
        for name, rng in self._rng.items():
            rng.bit_generator.state = json.loads(about["streams"][name])


def log_probability(
    spec: Spec, logits: torch.Tensor, features: torch.Tensor, actions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probabilities (B,) of actions, and the entropies (B,) of their distributions."""
    if spec.action == "select":
        mask = features[..., -1]
        chosen = actions.to(logits.dtype)
        return d.set_log_probability(torch, logits, mask, chosen), d.set_entropy(torch, logits, mask)
    logps = d.omega_log_probabilities(torch, logits)
    return logps[torch.arange(len(actions)), actions], d.omega_entropy(torch, logits)


def _checked_tensor(array: NDArray[Any], like: torch.Tensor) -> torch.Tensor:
    if array.shape != tuple(like.shape) or array.dtype != np.float64 or not np.isfinite(array).all():
        raise ValueError(f"weights of shape {array.shape}, expected finite ones of {tuple(like.shape)}")
    return torch.tensor(array)


class _RunningMeanStd:
    """Running mean and variance of the last few thousand rewards (Chan's update). V learns rewards in these
    units, whatever the weights of the reward."""

    def __init__(self, count: int = 0, mean: float = 0.0, variance: float = 0.0) -> None:
        self.count, self.mean, self.variance = count, mean, variance

    def add(self, values: NDArray[np.float64]) -> None:
        n, mean = len(values), float(values.mean())
        new, gap = n / (self.count + n), mean - self.mean
        self.variance = (1 - new) * self.variance + new * float(values.var()) + new * (1 - new) * gap * gap
        self.mean += new * gap
        self.count = min(self.count + n, tuned.REMEMBERED_DECISIONS)

    @property
    def scale(self) -> float:
        """Standard deviation; 1 while nothing has varied."""
        spread = float(np.sqrt(self.variance))
        return spread if spread > _CONSTANT * abs(self.mean) else 1.0

    def standardized(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return (values - self.mean) / self.scale

    @staticmethod
    def from_json(data: dict[str, Any]) -> _RunningMeanStd:
        """ValueError for what ``as_json`` cannot have written."""
        count, mean, variance = int(data["count"]), float(data["mean"]), float(data["variance"])
        if not (0 <= count <= tuned.REMEMBERED_DECISIONS and math.isfinite(mean) and 0.0 <= variance < math.inf):
            raise ValueError(f"rewards of mean {mean} and variance {variance}, {count} of them")
        return _RunningMeanStd(count, mean, variance)

    def as_json(self) -> dict[str, Any]:
        return {"count": self.count, "mean": self.mean, "variance": self.variance}
