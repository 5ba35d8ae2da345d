"""A learned policy that goes on learning while it is used (``edge-server run --learn``), within limits.

Three things keep it from doing harm. A **trust region**: over the states of a batch, an update moves it by at
most its specification's ``target_kl``, and all updates together by at most ``max_kl`` from the loaded policy;
an update that goes further is shortened. A **fixed policy beside it** takes a random share of the decisions,
small until there is a suspicion, so that both are estimated fairly. And a **fallback**: once
``sequential_test`` finds the fixed policy better, that one decides, and the learned one gets the small share,
from which it learns on with softened preferences.

Live rewards differ from those of training, which may have been differences to another action of the same
decision: reward statistics and state values therefore start over. The rewards come from a held-out camera,
later than the decisions; nothing waits for them.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import OrderedDict, deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.scheduler.learned.decision import Decision
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.online.sequential_test import SequentialTest
from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow
from edge_server.scheduler.registry import policy_label

log = logging.getLogger(__name__)

# Decisions kept while their reward may still come; later rewards are dropped.
_MAX_PENDING = 256
# Factor on the logits of a policy that was found worse: a policy that is sure of what was right yesterday
# never tries anything else, and would learn nothing.
_SOFTENING = 0.25
# An update that goes too far is halved this often before it is given up.
_MAX_HALVINGS = 6


@dataclass(frozen=True)
class OnlineSettings:
    """Limits of learning while deciding.

    share: share of the decisions that go to the policy not in charge; half while there is a suspicion.
    batch: number of decisions of one update.
    max_kl: mean KL divergence in nats that learning may not exceed, from the loaded policy or, after a
    fallback, from the softened one.
    explore: uniform share of every action, however sure the policy is.
    warmup: first decisions that do not count in the comparison: a field that starts from nothing improves
    whatever is chosen.
    false_alarm_every: average number of decisions between two unwarranted switches, at least.
    """

    share: float = 0.15
    batch: int = 32
    max_kl: float = 1.0
    explore: float = 0.02
    warmup: int = 30
    false_alarm_every: float = 20_000.0

    def __post_init__(self) -> None:
        if not (0.0 < self.share <= 0.5 and self.batch >= 1 and 0.0 < self.max_kl < math.inf):
            raise ValueError("online: share in (0, 0.5], batch from 1, max_kl positive and finite")
        if not (0.0 <= self.explore < 1.0 and self.warmup >= 0 and 1.0 < self.false_alarm_every < math.inf):
            raise ValueError("online: explore in [0, 1), warmup from 0, false_alarm_every above 1 and finite")


@dataclass(frozen=True)
class ExploringActor(Actor):
    """An actor with a uniform share ``explore`` of every action. The share is part of the logits, so that the
    log-probabilities it returns are those it acts with."""

    explore: float = 0.0

    def logits(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        return d.mix_uniform(np, self.spec.action, super().logits(features), self.explore)


@dataclass(frozen=True)
class _Pending:
    """A decision whose reward may still come. decision: None if the fixed policy took it. probability:
    probability with which the learned policy would be drawn to take it."""

    decision: Decision | None
    probability: float


class OnlinePolicy(Policy):
    """A policy made of two: ``learner``'s, which explores and learns, and ``fixed``.

    learner: owned by this policy from now on.
    fixed: the policy beside it.
    name: name of this policy, as people write it.
    rng: draws which of the two decides, and the actions that explore.
    settings: None takes the defaults.
    Threads: the update loop's calls ``plan`` and ``select``, one other ``learn``, any ``add_reward`` and
    ``status``.
    """

    def __init__(
        self,
        learner: Learner,
        fixed: Policy,
        name: str,
        rng: np.random.Generator,
        settings: OnlineSettings | None = None,
    ) -> None:
        self.name = name
        self.fixed = fixed
        self.settings = settings or OnlineSettings()
        self.updates = 0
        self.shortened = 0
        """Updates that would have left the trust region."""
        self.kl_from_loaded = 0.0
        """KL divergence of the learned policy from the loaded one, over the last batch."""
        self.fallen_back = False
        self.verdict = ""
        """The last result of the comparison, in words."""
        learner.reset_rewards()
        self._learner = learner
        self._loaded = learner.actor
        self._bandit = BanditPolicy(self._exploring(self._loaded), name, rng, explore=True)
        self.embedding = self._bandit.embedding
        self._soften = False
        self._rng = rng
        self._lock = threading.Lock()
        self._first: int | None = None  # number of the first decision
        self._policy: Policy = fixed
        self._probability = 1.0
        self._pending: OrderedDict[int, _Pending] = OrderedDict()
        self._rewarded: deque[tuple[Decision, float]] = deque(maxlen=4 * self.settings.batch)
        self._test = SequentialTest(better=False, false_alarm_every=self.settings.false_alarm_every)

    @property
    def last_decision(self) -> Decision | None:
        """The newest decision of the learned policy; the fixed one may have taken later ones."""
        return self._bandit.last_decision

    # --- deciding -----------------------------------------------------------------------------------

    def plan(self, epoch: Epoch) -> SelectionWindow:
        if self._first is None:
            self._first = epoch.number
        with self._lock:
            share = 0.5 if self._test.is_suspicious else self.settings.share
            self._probability = share if self.fallen_back else 1.0 - share
        learned = bool(self._rng.random() < self._probability)
        self._policy = self._bandit if learned else self.fixed
        return self._policy.plan(epoch)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        cameras = self._policy.select(epoch, window)
        if cameras:
            with self._lock:
                decision = self._bandit.last_decision if self._policy is self._bandit else None
                decision = decision.without_frames() if decision else None
                self._pending[epoch.number] = _Pending(decision, self._probability)
                while len(self._pending) > _MAX_PENDING:
                    self._pending.popitem(last=False)
        return cameras

    # --- learning -----------------------------------------------------------------------------------

    def add_reward(self, number: int, reward: float | None) -> bool:
        """Take the reward of decision ``number``; None: there is none. Returns whether there is now a batch
        to ``learn`` from."""
        with self._lock:
            if number not in self._pending:
                return False
            pending = self._pending.pop(number)
            counts = number - (self._first or 0) >= self.settings.warmup
            if counts and reward is not None and math.isfinite(reward):
                if pending.decision is not None:
                    self._rewarded.append((pending.decision, reward))
                if self._test.update(pending.decision is not None, pending.probability, reward):
                    self._switch()
            return len(self._rewarded) >= self.settings.batch

    def learn(self) -> dict[str, Any] | None:
        """Update from a batch of rewarded decisions, if there is one; returns figures for a log."""
        with self._lock:
            if len(self._rewarded) < self.settings.batch:
                return None
            rewarded = [self._rewarded.popleft() for _ in range(self.settings.batch)]
            soften, self._soften = self._soften, False
        if soften:
            self._loaded = _softened(self._learner.actor)
            self._learner.set_actor(self._loaded)
        batch = self._learner.batch(
            [decision.state for decision, _ in rewarded],
            np.stack([decision.action for decision, _ in rewarded]),
            np.array([decision.logp for decision, _ in rewarded]),
            [reward for _, reward in rewarded],
            explore=self.settings.explore,
        )
        before = self._learner.actor
        diagnostics = self._learner.update(batch)
        actor, shortened = self._within_trust_region(before, self._learner.actor, batch.features)
        if shortened:
            self._learner.set_actor(actor)
        with self._lock:
            self._bandit.actor = self._exploring(actor)
            self.updates += 1
            self.shortened += shortened
            self.kl_from_loaded = mean_kl(self._loaded, actor, batch.features)
        return {
            "update": self.updates,
            "decisions": len(rewarded),
            "reward": diagnostics.reward,
            "kl_from_acted": diagnostics.moved,
            "step_kl": mean_kl(before, actor, batch.features),
            "kl_from_loaded": self.kl_from_loaded,
            "shortened": shortened,
            "fallen_back": self.fallen_back,
        }

    def save(self, path: Path | str) -> None:
        """Write what has been learned, as a checkpoint for ``bandit:FILE``. OSError where it cannot be
        written."""
        self._learner.save(path)

    # --- what people see ----------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """For edge.json and the page."""
        with self._lock:
            learned, other = self._test.estimates
        return {
            "updates": self.updates,
            "shortened": self.shortened,
            "kl_from_loaded": self.kl_from_loaded,
            "kl_bound": self.settings.max_kl,
            "fallen_back": self.fallen_back,
            "fixed": policy_label(self.fixed),
            "verdict": self.verdict,
            "learnt_reward": vars(learned),
            "fixed_reward": vars(other),
        }

    def summary(self) -> str:
        """The status in one line for people."""
        with self._lock:
            learned, other = self._test.estimates
        who = "the learned policy decides"
        if self.fallen_back:
            who = f"fallen back, the learned policy was {self.verdict}"
        return f"learning: {who}; reward {learned}, {policy_label(self.fixed)} {other}; {self.updates} updates"

    # --- inside -------------------------------------------------------------------------------------

    def _switch(self) -> None:
        """Put the other policy in charge; the caller holds the lock."""
        worse = not self._test.better
        learned, other = self._test.estimates
        label = policy_label(self.fixed)
        self.verdict = f"{'worse' if worse else 'better'} than {label} (of late {learned}, {label} {other})"
        self.fallen_back = self._soften = worse
        # A new test: the rewards so far have been used.
        self._test = SequentialTest(better=worse, false_alarm_every=self.settings.false_alarm_every)
        log.info("the learned policy is %s: %s", self.verdict, "fallen back" if worse else "it decides again")

    def _exploring(self, actor: Actor) -> Actor:
        return ExploringActor(actor.spec, actor.weights, self.settings.explore, mean_features=actor.mean_features)

    def _within_trust_region(self, before: Actor, after: Actor, features: NDArray[np.float64]) -> tuple[Actor, bool]:
        """``after``, or the farthest point on the way to it, by repeated halving, that is within the trust
        region; at worst ``before``. And whether the step was shortened."""
        if self._is_trusted(before, after, features):
            return after, False
        part = 1.0
        for _ in range(_MAX_HALVINGS):
            part *= 0.5
            weights = {n: w + part * (after.weights[n] - w) for n, w in before.weights.items()}
            between = replace(after, weights=weights)
            if self._is_trusted(before, between, features):
                return between, True
        return before, True

    def _is_trusted(self, before: Actor, after: Actor, features: NDArray[np.float64]) -> bool:
        """Without the uniform share, which only brings policies closer together."""
        step, total = mean_kl(before, after, features), mean_kl(self._loaded, after, features)
        return step <= after.spec.target_kl and total <= self.settings.max_kl


def mean_kl(reference: Actor, actor: Actor, features: NDArray[np.float64]) -> float:
    """Mean over states of KL(reference || actor) in nats.

    Of the categorical, or summed over the cameras' Bernoullis; the condition K_t >= 1, which hardly ever
    matters, is ignored. features: (B, N, width).
    """
    p, q = reference.logits(features), actor.logits(features)
    if reference.spec.action == "select":
        share = 1.0 / (1.0 + np.exp(-np.clip(p, -500.0, 500.0)))
        # log sigmoid and log (1 - sigmoid) without overflow.
        each = share * (np.logaddexp(0.0, -q) - np.logaddexp(0.0, -p))
        each += (1.0 - share) * (np.logaddexp(0.0, q) - np.logaddexp(0.0, p))
        return float((each * features[..., -1]).sum(axis=1).mean())
    log_p, log_q = (x - np.logaddexp.reduce(x, axis=1, keepdims=True) for x in (p, q))
    return float((np.exp(log_p) * (log_p - log_q)).sum(axis=1).mean())


def _softened(actor: Actor) -> Actor:
    last = {name: _SOFTENING * actor.weights[name] for name in ("out", "out_b")}
    return replace(actor, weights={**actor.weights, **last})
