"""A learnt policy that goes on learning while it is used (``edge-server run --learn``), on a leash.

Three things keep it from doing harm. A **trust region**: an update moves it by no more than its
specification's ``target_kl``, and all updates together by no more than ``bound`` from the policy that was
loaded, over the states of the batch; what would go further is shortened. A **fixed policy beside it** takes a
random share of the decisions, a small one until there is a suspicion, so that both are estimated fairly. And
a **fall-back**: once the fixed policy is better beyond doubt (``verdict``), it is the one that decides, and
the learnt one gets the small share, from which it learns on, less sure of itself than it was.

What a reward is live is not what it was in training, where it may have been the difference to another action
of the same decision: what the learner knew of rewards' size, and what it expected of a state, begins anew.

The rewards come from a held-out camera, later than the decisions; nothing waits for them.
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

from edge_server.scheduler import BANDIT, Epoch, Plan, Policy
from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.bandit import Bandit, Decided
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.online.sequential_test import Judge

log = logging.getLogger(__name__)

# Decisions whose reward may still come; a score that comes later than this is of no use.
_OPEN = 256
# What is left of a policy's preferences (its logits) when it has been found wanting: one that is sure of what
# was right yesterday never tries anything else, and would learn nothing.
_SOFTENED = 0.25
# So often an update that goes too far is halved before it is given up.
_HALVINGS = 6


@dataclass(frozen=True)
class Leash:
    """share: of the decisions that goes to whoever does not decide; half while there is a suspicion. batch:
    decisions of one update. bound: mean KL divergence in nats, from the policy that was loaded (or, after a
    fall-back, from what it was softened to), that learning may not exceed. explore: share of chance in every
    action, however sure the policy is. settle: first decisions that nobody is judged by: whatever is chosen,
    a field that begins with nothing becomes better. false_every: decisions between two changes of who decides
    that were not called for, at least, on average."""

    share: float = 0.15
    batch: int = 32
    bound: float = 1.0
    explore: float = 0.02
    settle: int = 30
    false_every: float = 20_000.0

    def __post_init__(self) -> None:
        if not (0.0 < self.share <= 0.5 and self.batch >= 1 and 0.0 < self.bound < math.inf):
            raise ValueError("leash: share in (0, 0.5], batch from 1, bound positive and finite")
        if not (0.0 <= self.explore < 1.0 and self.settle >= 0 and 1.0 < self.false_every < math.inf):
            raise ValueError("leash: explore from 0, below 1, settle from 0, false_every above 1 and finite")


@dataclass(frozen=True)
class Exploring(Actor):
    """An actor whose every action has a share ``explore`` of chance: as logits, so that the probability it
    tells is the one that it acts with."""

    explore: float = 0.0

    def logits(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        return d.with_chance(np, self.spec.action, super().logits(features), self.explore)


@dataclass(frozen=True)
class _Waiting:
    """A decision whose reward may still come. decided: None where the fixed policy took it. probability: with
    which it would have gone to the learnt one."""

    decided: Decided | None
    probability: float


class Apprentice:
    """A policy (``scheduler.Policy``) made of two: ``learner``'s, which explores and learns, and ``fixed``.

    learner becomes its own. rng: of who decides and of exploration. ``plan`` and ``select`` belong to the
    loop's thread, ``learn`` to one other, ``scored`` and ``status`` to any.
    """

    parameter = None
    value: float | None = None

    def __init__(
        self, learner: Learner, fixed: Policy, name: str, rng: np.random.Generator, leash: Leash | None = None
    ) -> None:
        self.name = name
        self.fixed = fixed
        self.leash = leash or Leash()
        self.updates = 0
        self.shortened = 0
        """Updates that would have left the trust region."""
        self.moved = 0.0
        """KL divergence of what has been learnt from what was loaded, over the last batch."""
        self.fallen_back = False
        learner.forget_rewards()
        self._learner = learner
        self._loaded = learner.actor
        self._bandit = Bandit(self._exploring(self._loaded), name, rng, explore=True)
        self._soften = False
        self._rng = rng
        self._lock = threading.Lock()
        self._first: int | None = None  # number of the first decision
        self.verdict = ""
        """What was last found of the two, for people."""
        self._policy: Policy = fixed
        self._probability = 1.0
        self._open: OrderedDict[int, _Waiting] = OrderedDict()
        self._ready: deque[tuple[Decided, float]] = deque(maxlen=4 * self.leash.batch)
        self._judge = Judge(better=False, false_every=self.leash.false_every)

    @property
    def embedding(self) -> tuple[int, str]:
        """Width of the embeddings that it looks at, 0 without, and whose they are."""
        return self._bandit.embedding

    @property
    def last(self) -> Decided | None:
        """The newest decision that the learnt policy took; later ones may have been the fixed one's."""
        return self._bandit.last

    # --- deciding -----------------------------------------------------------------------------------

    def plan(self, epoch: Epoch) -> Plan:
        if self._first is None:
            self._first = epoch.number
        with self._lock:
            share = 0.5 if self._judge.suspects else self.leash.share
            self._probability = share if self.fallen_back else 1.0 - share
        learnt = bool(self._rng.random() < self._probability)
        self._policy = self._bandit if learnt else self.fixed
        return self._policy.plan(epoch)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        cameras = self._policy.select(epoch, plan)
        if cameras:
            with self._lock:
                decided = self._bandit.last if self._policy is self._bandit else None
                decided = decided.without_frames() if decided else None
                self._open[epoch.number] = _Waiting(decided, self._probability)
                while len(self._open) > _OPEN:
                    self._open.popitem(last=False)
        return cameras

    # --- learning -----------------------------------------------------------------------------------

    def scored(self, number: int, reward: float | None) -> bool:
        """The update of decision ``number`` was rewarded, or cannot be (None). Whether there is now enough
        to ``learn`` from."""
        with self._lock:
            if number not in self._open:
                return False
            found = self._open.pop(number)
            settled = number - (self._first or 0) >= self.leash.settle
            if settled and reward is not None and math.isfinite(reward):
                if found.decided is not None:
                    self._ready.append((found.decided, reward))
                if self._judge.saw(found.decided is not None, found.probability, reward):
                    self._change_over()
            return len(self._ready) >= self.leash.batch

    def learn(self) -> dict[str, Any] | None:
        """Update from what has been rewarded, if that is a batch; what came of it, for a log."""
        with self._lock:
            if len(self._ready) < self.leash.batch:
                return None
            ready = [self._ready.popleft() for _ in range(self.leash.batch)]
            soften, self._soften = self._soften, False
        if soften:
            self._loaded = _softened(self._learner.actor)
            self._learner.take(self._loaded)
        states = [decided.state for decided, _ in ready]
        batch = self._learner.batch(
            states,
            np.stack([decided.action for decided, _ in ready]),
            np.array([decided.logp for decided, _ in ready]),
            [reward for _, reward in ready],
            explore=self.leash.explore,
        )
        before = self._learner.actor
        told = self._learner.update(batch)
        actor, shortened = self._held_back(before, self._learner.actor, batch.features)
        if shortened:
            self._learner.take(actor)
        with self._lock:
            self._bandit.actor = self._exploring(actor)
            self.updates += 1
            self.shortened += shortened
            self.moved = divergence(self._loaded, actor, batch.features)
        return {
            "update": self.updates, "decisions": len(ready), "reward": told.reward,
            "kl_from_acted": told.moved, "step_kl": divergence(before, actor, batch.features),
            "kl_from_loaded": self.moved, "shortened": shortened, "fallen_back": self.fallen_back,
        }  # fmt: skip

    def save(self, path: Path | str) -> None:
        """What has been learnt, as a checkpoint for ``bandit:FILE``. OSError where it cannot be written."""
        self._learner.save(path)

    # --- what people see ----------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """For edge.json and the page."""
        with self._lock:
            mine, other = self._judge.estimates
        return {
            "updates": self.updates, "shortened": self.shortened, "kl_from_loaded": self.moved,
            "kl_bound": self.leash.bound, "fallen_back": self.fallen_back, "fixed": name_of(self.fixed),
            "verdict": self.verdict,
            "learnt_reward": vars(mine), "fixed_reward": vars(other),
        }  # fmt: skip

    def told(self) -> str:
        """One line for people."""
        with self._lock:
            mine, other = self._judge.estimates
        who = "the learnt policy decides"
        if self.fallen_back:
            who = f"fallen back, the learnt policy was {self.verdict}"
        return f"learning: {who}; reward {mine}, {name_of(self.fixed)} {other}; {self.updates} updates"

    # --- inside -------------------------------------------------------------------------------------

    def _change_over(self) -> None:
        """The other one decides from now on; the caller holds the lock."""
        worse = not self._judge.better
        mine, other = self._judge.estimates
        found = "worse" if worse else "better"
        self.verdict = f"{found} than {name_of(self.fixed)} (of late {mine}, {name_of(self.fixed)} {other})"
        self.fallen_back = self._soften = worse
        # What they have earned until now has been judged.
        self._judge = Judge(better=worse, false_every=self.leash.false_every)
        log.info("the learnt policy is %s: %s", self.verdict, "fallen back" if worse else "it decides again")

    def _exploring(self, actor: Actor) -> Actor:
        return Exploring(actor.spec, actor.weights, self.leash.explore, usual=actor.usual)

    def _held_back(self, before: Actor, after: Actor, features: NDArray[np.float64]) -> tuple[Actor, bool]:
        """``after`` if it is in the trust region, else the farthest of a few points on the way to it that is,
        else ``before``."""
        if self._trusted(before, after, features):
            return after, False
        part = 1.0
        for _ in range(_HALVINGS):
            part *= 0.5
            weights = {n: w + part * (after.weights[n] - w) for n, w in before.weights.items()}
            between = replace(after, weights=weights)
            if self._trusted(before, between, features):
                return between, True
        return before, True

    def _trusted(self, before: Actor, after: Actor, features: NDArray[np.float64]) -> bool:
        """Of the policies without their share of chance, which makes what acts differ less, never more."""
        step, whole = divergence(before, after, features), divergence(self._loaded, after, features)
        return step <= after.spec.target_kl and whole <= self.leash.bound


def divergence(reference: Actor, actor: Actor, features: NDArray[np.float64]) -> float:
    """Mean KL divergence KL(reference || actor) over states, in nats: of the categorical, or summed over the
    cameras' Bernoullis (the condition K_t >= 1 aside, which hardly ever decides)."""
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
    last = {name: _SOFTENED * actor.weights[name] for name in ("out", "out_b")}
    return replace(actor, weights={**actor.weights, **last})


def name_of(policy: Policy) -> str:
    """As people type it."""
    if policy.name.startswith(BANDIT) or policy.value is None:
        return policy.name
    return f"{policy.name}:{policy.value:g}"
