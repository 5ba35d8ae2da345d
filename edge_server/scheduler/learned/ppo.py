"""Single-step PPO (5.23, algorithm 1) and contextual-bandit PPO (6.42, algorithm 2): one learner.

An episode is one decision, so that Q is the reward itself and the advantage (5.24) is r - V(s): nothing is
discounted and nothing bootstrapped. What differs between the two algorithms is the distribution (Bernoulli a
camera, categorical over omega), and that is the specification's.

    learner = Learner(Spec("select", StateLayout(("age",))), seed=1)
    actions, logps = learner.act(states)
    rewards = [...]                                  # from fields that were really fitted
    learner.update(learner.batch(states, actions, logps, rewards))

Same seed and same rewards, same weights bit for bit: torch runs on one thread here (the networks are too
small for more), random numbers are numpy's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.actor import KIND, MOST_BYTES, Actor, read_spec
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import State

# exp of more is no probability ratio any more; the clip has long since said what it has to say.
_MAX_LOG_RATIO = 20.0
# Advantages that differ by less than this share of the rewards' own spread are the value's error, not news:
# they are not blown up to one.
_LEAST_ADVANTAGE = 0.05
# Rewards that vary by less than this share of their size, or of all rewards' spread, are constant.
_CONSTANT = 1e-9
# A reward further from the mean than so many spreads is an accident: it counts as this far. The spread itself
# may grow by as much in one batch, so that a real change of scale is followed.
_OUTLIER = 10.0
# So many decisions count in the running spread: it follows a scene or a channel that changes.
_MEMORY = 4096
# Nothing that is measured is as large; its square would overflow.
_ABSURD = 1e100
_STREAMS = ("weights", "actions", "order")


@dataclass(frozen=True)
class Batch:
    """Decisions and what came of them. features (B, N, width); actions (B, N) bool or (B,) index of an
    omega; logps (B,) when they were drawn; rewards (B,), NaN where none came of it. explore: share of chance
    in how they were drawn, which is then part of the policy that is compared with it."""

    features: NDArray[np.float64]
    actions: NDArray[Any]
    logps: NDArray[np.float64]
    rewards: NDArray[np.float64]
    explore: float = 0.0

    def __len__(self) -> int:
        return len(self.rewards)


@dataclass(frozen=True)
class Diagnostics:
    """How an update went, in its last pass over the batch. reward: mean of those that were finite; dropped:
    decisions whose reward or probability was no number. moved: estimate of the KL divergence from the policy
    that acted; clipped: share of ratios outside the clip. explained: share of the rewards' variance that V
    explained before the update (None where they do not vary). steps: in all; skipped: steps left out because
    a gradient was not finite."""

    reward: float | None
    dropped: int
    policy_loss: float
    value_loss: float
    entropy: float
    moved: float
    clipped: float
    gradient: float
    explained: float | None
    steps: int
    skipped: int


class Learner:
    """Learns ``spec`` from batches. Two of the same seed do the same."""

    def __init__(self, spec: Spec, seed: int = 0) -> None:
        self.spec = spec
        self.seed = seed
        self.taught_by: dict[str, Any] | None = None
        """The reward that it was trained by, as the fields of ``rewards.Reward``; None: nobody said."""
        self.updates = 0
        self.decisions = 0
        streams = np.random.SeedSequence(seed).spawn(len(_STREAMS))
        self._rng = {name: np.random.default_rng(s) for name, s in zip(_STREAMS, streams)}
        actor = networks.new_actor(spec, self._rng["weights"])
        value = networks.new_value(spec, self._rng["weights"])
        self._actor = {name: torch.tensor(w, requires_grad=True) for name, w in actor.items()}
        self._value = {name: torch.tensor(w, requires_grad=True) for name, w in value.items()}
        self._parameters = [*self._actor.values(), *self._value.values()]
        self._adam = torch.optim.Adam(self._parameters, lr=spec.learning_rate)
        self._rewards = _Spread()
        # Of all cameras that were decided on, as if they were one.
        self._usual, self._cameras_seen = np.zeros(spec.layout.width), 0

    # --- deciding -----------------------------------------------------------------------------------

    @property
    def actor(self) -> Actor:
        """What decides, as it is now: a copy in numpy that later updates do not change."""
        weights = {name: w.detach().numpy().copy() for name, w in self._actor.items()}
        return Actor(self.spec, weights, usual=self._usual.copy())

    def take(self, actor: Actor) -> None:
        """Go on from ``actor``'s weights, such as those of an update that was shortened. ValueError where
        they are not of this specification."""
        if actor.weights.keys() != self._actor.keys():
            raise ValueError("the weights are of another network")
        with torch.no_grad():
            for name, w in self._actor.items():
                w.copy_(_as_expected(actor.weights[name], w))

    def forget_rewards(self) -> None:
        """From now on rewards are of another kind: their size, and what is expected of a state, are learnt
        anew. The policy stays as it is."""
        self._rewards = _Spread()
        anew = networks.new_value(self.spec, self._rng["weights"])
        with torch.no_grad():
            for name, w in self._value.items():
                w.copy_(torch.tensor(anew[name]))
                self._adam.state.pop(w, None)

    def act(self, states: Sequence[State], explore: bool = True) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Actions, (B, N) bool or (B,) indices of omegas, and their log-probabilities (B,). explore False:
        the likeliest ones."""
        return self.actor.act(states, self._rng["actions"] if explore else None)

    def greedy(self, state: State) -> NDArray[Any]:
        """The likeliest action: (N,) bool, or an index of the omegas as an array of no dimension."""
        return np.asarray(self.actor.act([state], None)[0][0])

    def value(self, states: Sequence[State]) -> NDArray[np.float64]:
        """V (B,), in units of the reward."""
        weights = {name: w.detach().numpy() for name, w in self._value.items()}
        found = networks.value(np, self.spec, weights, self.spec.layout.batch(states))
        return self._rewards.mean + self._rewards.scale * found

    def batch(
        self,
        states: Sequence[State],
        actions: NDArray[Any],
        logps: NDArray[np.float64],
        rewards: Sequence[float | None] | NDArray[np.float64],
        explore: float = 0.0,
    ) -> Batch:
        """What ``update`` learns from; a reward of None is one that could not be had. explore: as in
        ``Batch``."""
        found = np.array([np.nan if r is None else r for r in rewards], np.float64)
        return Batch(self.spec.layout.batch(states), np.asarray(actions), np.asarray(logps), found, explore)

    # --- learning -----------------------------------------------------------------------------------

    def update(self, batch: Batch) -> Diagnostics:
        """Improve the policy by one batch. Decisions whose reward is no number are left out; a batch of
        nothing else changes nothing."""
        # NaN compares as False.
        usable = (np.abs(batch.rewards) < _ABSURD) & np.isfinite(batch.logps)
        dropped = int((~usable).sum())
        if not usable.any():
            return Diagnostics(None, dropped, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, None, 0, 0)
        rewards = batch.rewards[usable]
        mean = float(rewards.mean())
        rewards = self._rewards.bounded(rewards)
        self._rewards.add(rewards)
        self.updates += 1
        self.decisions += len(rewards)
        cameras = batch.features[usable][batch.features[usable][..., -1] > 0]
        if len(cameras):
            self._cameras_seen += len(cameras)
            self._usual += (cameras - self._usual).sum(axis=0) / self._cameras_seen
        with _one_thread():
            done = self._passes(
                torch.tensor(batch.features[usable]),
                torch.tensor(batch.actions[usable]),
                torch.tensor(batch.logps[usable]),
                torch.tensor(self._rewards.standardised(rewards)),
                batch.explore,
            )
        return Diagnostics(mean, dropped, **done)

    def _passes(
        self,
        features: torch.Tensor,
        actions: torch.Tensor,
        logps: torch.Tensor,
        rewards: torch.Tensor,
        explore: float,
    ) -> dict[str, Any]:
        """Passes over the batch in minibatches, until the policy has moved far enough."""
        spec = self.spec
        with torch.no_grad():
            expected = networks.value(torch, spec, self._value, features)
        spread = rewards.std(correction=0).item()
        left = (rewards - expected).std(correction=0).item()
        varies = spread > _CONSTANT
        explained = 1.0 - (left / spread) ** 2 if varies else None
        # Where nothing that was done made a difference, what is left is the value's error.
        advantages = self._advantages(rewards - expected) if varies else torch.zeros_like(rewards)
        steps, skipped = 0, 0
        seen: list[tuple[float, ...]] = []
        for _ in range(spec.passes):
            seen = []
            order = torch.tensor(self._rng["order"].permutation(len(rewards)))
            for some in order.split(spec.minibatch):
                loss, figures = self._loss(
                    features[some], actions[some], logps[some], advantages[some], rewards[some], explore
                )
                self._adam.zero_grad()
                loss.backward()
                gradient = torch.nn.utils.clip_grad_norm_(self._parameters, spec.max_gradient)
                if torch.isfinite(gradient):
                    self._adam.step()
                    steps += 1
                else:
                    skipped += 1
                seen.append((*figures, gradient.item()))
            if np.mean([figures[3] for figures in seen]) > spec.target_kl:
                break
        policy, value, entropy, moved, clipped, gradient_norm = np.mean(seen, axis=0).tolist()
        return {
            "policy_loss": policy, "value_loss": value, "entropy": entropy, "moved": moved,
            "clipped": clipped, "gradient": gradient_norm, "explained": explained, "steps": steps,
            "skipped": skipped,
        }  # fmt: skip

    def _advantages(self, raw: torch.Tensor) -> torch.Tensor:
        """(B,) with mean 0 and, unless they are next to nothing, spread 1. ``raw`` is in units of the
        rewards' spread."""
        centred = raw - raw.mean()
        return centred / torch.clamp(centred.std(correction=0), min=_LEAST_ADVANTAGE)

    def _loss(
        self,
        features: torch.Tensor,
        actions: torch.Tensor,
        logps: torch.Tensor,
        advantages: torch.Tensor,
        rewards: torch.Tensor,
        explore: float,
    ) -> tuple[torch.Tensor, tuple[float, ...]]:
        """The negative of (5.23), (6.42) with the value's error and the entropy, and figures to report."""
        spec = self.spec
        logits = networks.logits(torch, spec, self._actor, features)
        logits = d.with_chance(torch, spec.action, logits, explore)
        now, entropy = log_probability(spec, logits, features, actions)
        log_ratio = torch.clamp(now - logps, -_MAX_LOG_RATIO, _MAX_LOG_RATIO)
        ratio = torch.exp(log_ratio)
        clipped = torch.clamp(ratio, 1.0 - spec.clip, 1.0 + spec.clip)
        policy_loss = -torch.minimum(ratio * advantages, clipped * advantages).mean()
        error = networks.value(torch, spec, self._value, features) - rewards
        value_loss = (error * error).mean()
        loss = policy_loss + spec.value * value_loss - spec.entropy * entropy.mean()
        # Never negative, and of less variance than -log ratio.
        moved = (torch.expm1(log_ratio) - log_ratio).mean()
        outside = ((ratio - 1.0).abs() > spec.clip).double().mean()
        figures = (policy_loss, value_loss, entropy.mean(), moved, outside)
        return loss, tuple(figure.item() for figure in figures)

    # --- keeping ------------------------------------------------------------------------------------

    def save(self, path: Path | str) -> None:
        """Everything, so that a learner loaded from ``path`` goes on bit for bit. Atomic; OSError where it
        cannot be written."""
        arrays = {f"actor.{name}": w.detach().numpy() for name, w in self._actor.items()}
        arrays["usual"] = self._usual
        arrays |= {f"value.{name}": w.detach().numpy() for name, w in self._value.items()}
        for i, parameter in enumerate(self._parameters):
            for name, kept in self._adam.state.get(parameter, {}).items():
                arrays[f"adam.{i}.{name}"] = kept.detach().numpy()
        about = {
            "spec": self.spec.as_json(),
            "seed": self.seed,
            "taught_by": self.taught_by,
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
        arrays, about = checkpoint.load(path, kind=KIND, most_bytes=MOST_BYTES)
        spec = read_spec(path, about)
        if "seed" not in about:
            raise checkpoint.CheckpointError(
                f"{path}: a policy and nothing that it could go on learning with: take the policy.npz of "
                "edge-server train-scheduler, or the learnt.npz of a run that learnt"
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
                    w.copy_(_as_expected(arrays[f"{part}.{name}"], w))
        for i, parameter in enumerate(self._parameters):
            if f"adam.{i}.step" in arrays:  # before the first update Adam remembers nothing
                step = np.asarray(arrays[f"adam.{i}.step"], np.float32)
                mean, square = (
                    _as_expected(arrays[f"adam.{i}.{n}"], parameter) for n in ("exp_avg", "exp_avg_sq")
                )
                if step.shape != () or not 1.0 <= step < np.inf or (square < 0.0).any():
                    raise ValueError("what Adam remembers is not what it can have written")
                self._adam.state[parameter] = {
                    "step": torch.tensor(step), "exp_avg": mean, "exp_avg_sq": square
                }  # fmt: skip
        self.taught_by = about.get("taught_by")
        self._usual = _as_expected(arrays["usual"], torch.tensor(self._usual)).numpy()
        self._cameras_seen = int(about["cameras_seen"])
        self.updates, self.decisions = int(about["updates"]), int(about["decisions"])
        self._rewards = _Spread.from_json(about["rewards"])
        for name, rng in self._rng.items():
            rng.bit_generator.state = json.loads(about["streams"][name])


def log_probability(
    spec: Spec, logits: torch.Tensor, features: torch.Tensor, actions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probabilities (B,) of actions, and the entropies (B,) of what they were drawn from."""
    if spec.action == "select":
        mask = features[..., -1]
        chosen = actions.to(logits.dtype)
        return d.set_log_probability(torch, logits, mask, chosen), d.set_entropy(torch, logits, mask)
    logps = d.omega_log_probabilities(torch, logits)
    return logps[torch.arange(len(actions)), actions], d.omega_entropy(torch, logits)


def _as_expected(array: NDArray[Any], like: torch.Tensor) -> torch.Tensor:
    if array.shape != tuple(like.shape) or array.dtype != np.float64 or not np.isfinite(array).all():
        raise ValueError(f"weights of shape {array.shape} where finite ones of {tuple(like.shape)} belong")
    return torch.tensor(array)


class _Spread:
    """Running mean and variance of the last some thousand rewards (Chan's update): V learns rewards in these
    units, whatever the weights of the reward are."""

    def __init__(self, count: int = 0, mean: float = 0.0, variance: float = 0.0) -> None:
        self.count, self.mean, self.variance = count, mean, variance

    def add(self, values: NDArray[np.float64]) -> None:
        n, mean = len(values), float(values.mean())
        new, gap = n / (self.count + n), mean - self.mean
        self.variance = (1 - new) * self.variance + new * float(values.var()) + new * (1 - new) * gap * gap
        self.mean += new * gap
        self.count = min(self.count + n, _MEMORY)

    @property
    def scale(self) -> float:
        """Standard deviation; 1 where nothing has varied yet."""
        spread = float(np.sqrt(self.variance))
        return spread if spread > _CONSTANT * abs(self.mean) else 1.0

    def bounded(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """``values`` without accidents, as far as can be told from those before; of the first ones, from
        their median and its quartiles."""
        middle, spread = self.mean, self.scale
        if not self.count:
            low, middle, high = np.percentile(values, (25, 50, 75))
            spread = float(high - low)
        if spread <= _CONSTANT * abs(middle) or (self.count and self.variance == 0.0):
            return values
        return np.clip(values, middle - _OUTLIER * spread, middle + _OUTLIER * spread)

    def standardised(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return (values - self.mean) / self.scale

    @staticmethod
    def from_json(data: dict[str, Any]) -> _Spread:
        """ValueError for what ``as_json`` cannot have written."""
        count, mean, variance = int(data["count"]), float(data["mean"]), float(data["variance"])
        if not (0 <= count <= _MEMORY and math.isfinite(mean) and 0.0 <= variance < math.inf):
            raise ValueError(f"rewards of mean {mean} and variance {variance}, {count} of them")
        return _Spread(count, mean, variance)

    def as_json(self) -> dict[str, Any]:
        return {"count": self.count, "mean": self.mean, "variance": self.variance}


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums in one order, whatever the machine; and no threads that compete with the field's."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
