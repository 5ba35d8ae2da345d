"""A learnt policy that goes on learning while it is used (``edge-server run --learn``), on a leash.

Three things keep it from doing harm. A **trust region**: an update moves it by no more than its
specification's ``target_kl``, and all updates together by no more than ``bound`` from the policy that was
loaded; what would go further is shortened. A **fixed policy beside it** takes a random small share of the
decisions, so that there is a fair running estimate of both, with an interval. And a **fall-back**: while the
estimate says that the fixed policy is better beyond doubt, it is the one that decides, and the learnt one
gets the small share, from which it learns on, less sure of itself than it was.

The rewards come from a held-out camera, later than the decisions; nothing waits for them.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from edge_server.scheduler import BANDIT, Epoch, Plan, Policy
from edge_server.scheduler.learned.bandit import Bandit, Decided
from edge_server.scheduler.learned.decide import Actor
from edge_server.scheduler.learned.ppo import Learner

log = logging.getLogger(__name__)

# Decisions whose reward may still come; a score that comes later than this is of no use.
_OPEN = 256
# Decisions that the estimates are of, the same for both policies: what was long ago was another channel, and
# if one were judged by it and the other not, a change would look like a difference.
WINDOW = 120
# No verdict on fewer of either.
LEAST = 10
# What is left of a policy's preferences (its logits) when it has been found wanting: one that is sure of what
# was right yesterday never tries anything else, and would learn nothing.
_SOFTENED = 0.25
# So often an update that goes too far is halved before it is given up.
_HALVINGS = 6


@dataclass(frozen=True)
class Leash:
    """share: of the decisions that goes to whoever does not decide. batch: decisions of one update. bound:
    mean KL divergence in nats, from the policy that was loaded (or, after a fall-back, from what it was
    softened to), that learning may not exceed. explore: share of chance in every action, however sure the
    policy is. settle: first decisions that nobody is judged by: whatever is chosen, a field that begins with
    nothing becomes better."""

    share: float = 0.15
    batch: int = 32
    bound: float = 1.0
    explore: float = 0.02
    settle: int = 30

    def __post_init__(self) -> None:
        if not (0.0 < self.share <= 0.5 and self.batch >= 1 and 0.0 < self.bound < math.inf):
            raise ValueError("leash: share in (0, 0.5], batch from 1, bound positive and finite")
        if not (0.0 <= self.explore < 1.0 and self.settle >= 0):
            raise ValueError("leash: explore from 0, below 1, settle from 0")


@dataclass(frozen=True)
class Exploring(Actor):
    """An actor whose every action has a share ``explore`` of chance: as logits, so that the probability it
    tells is the one that it acts with."""

    explore: float = 0.0

    def logits(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        own = super().logits(features)
        if self.explore == 0.0:
            return own
        if self.spec.action == "select":
            share = (1.0 - self.explore) / (1.0 + np.exp(-np.clip(own, -500.0, 500.0))) + 0.5 * self.explore
            return np.log(share) - np.log1p(-share)
        share = np.exp(own - np.logaddexp.reduce(own, axis=1, keepdims=True))
        return np.log((1.0 - self.explore) * share + self.explore / own.shape[1])


@dataclass(frozen=True)
class Estimate:
    """Mean reward with the half width of its 95 % interval (None for fewer than ``LEAST``)."""

    mean: float | None
    half: float | None
    count: int

    @staticmethod
    def of(values: Sequence[float]) -> Estimate:
        if not values:
            return Estimate(None, None, 0)
        found, n = np.array(values), len(values)
        t = float(stats.t.ppf(0.975, n - 1)) if n >= LEAST else 0.0
        half = t * float(found.std(ddof=1)) / math.sqrt(n) if n >= LEAST else None
        return Estimate(float(found.mean()), half, len(found))


class Apprentice:
    """A policy (``scheduler.Policy``) made of two: ``learner``'s, which explores and learns, and ``fixed``.

    rng: of who decides and of exploration. ``plan`` and ``select`` belong to the loop's thread, ``learn`` to
    one other, ``scored`` and ``status`` to any.
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
        self._open: OrderedDict[int, Decided | None] = OrderedDict()
        self._ready: deque[tuple[Decided, float]] = deque(maxlen=4 * self.leash.batch)
        self._rewards: deque[tuple[bool, float]] = deque(maxlen=WINDOW)

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
        seldom = bool(self._rng.random() < self.leash.share)
        learnt = seldom if self.fallen_back else not seldom
        self._policy = self._bandit if learnt else self.fixed
        return self._policy.plan(epoch)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        cameras = self._policy.select(epoch, plan)
        if cameras:
            with self._lock:
                decided = self._bandit.last if self._policy is self._bandit else None
                self._open[epoch.number] = decided.without_frames() if decided else None
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
            decided = self._open.pop(number)
            settled = number - (self._first or 0) >= self.leash.settle
            if settled and reward is not None and math.isfinite(reward):
                self._rewards.append((decided is not None, reward))
                if decided is not None:
                    self._ready.append((decided, reward))
            self._judge()
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
            "update": self.updates, "decisions": len(ready), "reward": told.reward, "step_kl": told.moved,
            "kl_from_loaded": self.moved, "shortened": shortened, "fallen_back": self.fallen_back,
        }  # fmt: skip

    def save(self, path: Path | str) -> None:
        """What has been learnt, as a checkpoint for ``bandit:FILE``. OSError where it cannot be written."""
        self._learner.save(path)

    # --- what people see ----------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """For edge.json and the page."""
        with self._lock:
            mine, other = self._estimates()
        return {
            "updates": self.updates, "shortened": self.shortened, "kl_from_loaded": self.moved,
            "kl_bound": self.leash.bound, "fallen_back": self.fallen_back, "fixed": name_of(self.fixed),
            "verdict": self.verdict,
            "learnt_reward": vars(mine), "fixed_reward": vars(other),
        }  # fmt: skip

    def told(self) -> str:
        """One line for people."""
        with self._lock:
            mine, other = self._estimates()
        who = "the learnt policy decides"
        if self.fallen_back:
            who = f"fallen back, the learnt policy was {self.verdict}"
        return (
            f"learning: {who}; reward {_shown(mine)}, {name_of(self.fixed)} {_shown(other)}; "
            f"{self.updates} updates"
        )

    # --- inside -------------------------------------------------------------------------------------

    def _estimates(self) -> tuple[Estimate, Estimate]:
        """Of the learnt policy and of the fixed one; the caller holds the lock."""
        mine, other = ([r for learnt, r in self._rewards if learnt is which] for which in (True, False))
        return Estimate.of(mine), Estimate.of(other)

    def _judge(self) -> None:
        """Who is to decide: changed only beyond doubt, so that it does not flutter."""
        mine, other = self._estimates()
        if mine.half is None or other.half is None:
            return
        assert mine.mean is not None and other.mean is not None
        gap, half = mine.mean - other.mean, math.hypot(mine.half, other.half)
        worse, better = gap + half < 0.0, gap - half > 0.0
        if (worse and not self.fallen_back) or (better and self.fallen_back):
            self.fallen_back = self._soften = worse
            # Both start anew: what they earned until now has been judged.
            self._rewards.clear()
            self.verdict = (
                f"{'worse' if worse else 'better'} than {name_of(self.fixed)} by {abs(gap):.4f} +- {half:.4f}"
            )
            log.info(
                "the learnt policy is %s: %s", self.verdict, "fallen back" if worse else "it decides again"
            )

    def _exploring(self, actor: Actor) -> Actor:
        return Exploring(actor.spec, actor.weights, self.leash.explore, usual=actor.usual)

    def _held_back(self, before: Actor, after: Actor, features: NDArray[np.float64]) -> tuple[Actor, bool]:
        """``after`` if it is within the bound, else the farthest of a few points on the way to it that is,
        else ``before``."""
        if divergence(self._loaded, after, features) <= self.leash.bound:
            return after, False
        part = 1.0
        for _ in range(_HALVINGS):
            part *= 0.5
            weights = {n: w + part * (after.weights[n] - w) for n, w in before.weights.items()}
            between = replace(after, weights=weights)
            if divergence(self._loaded, between, features) <= self.leash.bound:
                return between, True
        return before, True


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


def _shown(estimate: Estimate) -> str:
    if estimate.mean is None:
        return "not known yet"
    return f"{estimate.mean:.3f}" + (f" +- {estimate.half:.3f}" if estimate.half is not None else "")
