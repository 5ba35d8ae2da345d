"""Which of two policies that take turns earns more: a verdict that may be asked for after every reward.

Two means with intervals of 95 % that are compared a thousand times are sooner or later apart by chance. Here
nothing is assumed of the rewards, not even that they are independent in time: the one thing that is known is
how who decides was drawn, anew for each decision. With A = 1 where the learnt policy decided, p the
probability of that and c what the reward was above the usual one, (A - p) c is worth nothing on average while
neither policy is better, whatever c did before. So a gambler who bets on it cannot expect to win:

    M_n = max(1, M_(n-1)) (1 + b (A_n - p_n) c_n)

is a product of fair bets that is begun anew whenever it has lost (Waudby-Smith and Ramdas, Estimating means
of bounded random variables by betting, 2023; Shin, Ramdas and Rinaldo, E-detectors, 2023). While the
suspicion is wrong, M reaches a bound of k in n decisions with a probability of n / k at most, and at least k
decisions pass on average before it does; a difference that is there, new or old, makes it grow exponentially.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

# Rewards that the estimates and the usual reward are of: what was long ago was another channel.
WINDOW = 120
# Nothing is bet before it is known what is usual; no interval of fewer.
LEAST = 10
# A reward further from the median counts as this many quartile distances: three spreads of a normal one.
_REACH = 2.2
# Log of what has been won, from which on the two should take turns evenly.
_SUSPICION = 1.0
# The stakes, all of them at once: low ones find small differences, high ones large differences soon.
_STAKES = np.array((0.25, 0.5, 0.95))


@dataclass(frozen=True)
class Estimate:
    """Mean reward with the half width of its 95 % interval (None for fewer than ``LEAST``), for people: the
    interval takes rewards as independent."""

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

    def __str__(self) -> str:
        if self.mean is None:
            return "not known yet"
        return f"{self.mean:.3f}" + (f" +- {self.half:.3f}" if self.half is not None else "")


class Judge:
    """Looks for one thing: that the learnt policy is better (``better``), or that it is worse. false_every:
    decisions between two verdicts that are wrong, at least, on average."""

    def __init__(self, better: bool, false_every: float) -> None:
        self.better = better
        self._sign = 1.0 if better else -1.0
        self._bound = math.log(false_every)
        self._won = np.zeros(len(_STAKES))  # log M of each stake
        self._rewards: deque[tuple[bool, float]] = deque(maxlen=WINDOW)

    def saw(self, learnt: bool, probability: float, reward: float) -> bool:
        """A decision was rewarded that the learnt policy took (``learnt``), as it did with ``probability``.
        Whether it is now beyond doubt."""
        unusual = self._unusual(reward)  # by those before, or it would depend on who decided
        self._rewards.append((learnt, reward))
        bet = self._sign * (learnt - probability) * unusual / max(probability, 1.0 - probability)
        self._won = np.maximum(self._won, 0.0) + np.log1p(_STAKES * bet)
        return self._evidence >= self._bound

    @property
    def suspects(self) -> bool:
        """Whether it would be worth knowing: with even turns a verdict comes in half of the time."""
        return self._evidence >= _SUSPICION

    @property
    def _evidence(self) -> float:
        """Log of the mean M."""
        return float(np.logaddexp.reduce(self._won)) - math.log(len(_STAKES))

    @property
    def estimates(self) -> tuple[Estimate, Estimate]:
        """Of the learnt policy and of the other one, over the same last ``WINDOW`` decisions: if one were
        judged by what was and the other not, a change of the channel would look like a difference."""
        mine, other = ([r for learnt, r in self._rewards if learnt is which] for which in (True, False))
        return Estimate.of(mine), Estimate.of(other)

    def _unusual(self, reward: float) -> float:
        """How far above the usual, within -1 and 1."""
        n = len(self._rewards)
        if n < LEAST:
            return 0.0
        before = sorted(r for _, r in self._rewards)
        above = reward - before[n // 2]
        reach = _REACH * (before[3 * n // 4] - before[n // 4])
        return max(-1.0, min(1.0, above / reach)) if reach > 0.0 else float(np.sign(above))
