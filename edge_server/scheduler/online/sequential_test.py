"""Sequential test of which of two policies earns more, valid after every reward.

Two means whose 95 % intervals are compared a thousand times will differ sooner or later by chance. This test
assumes nothing about the rewards, not even independence in time; it uses only that the policy of each
decision was drawn at random. With A = 1 where the learned policy decided, p the probability of that, and c
how far the reward was above its usual value, (A - p) c has mean zero while neither policy is better, whatever
c was before. A gambler who bets on it cannot expect to win:

    M_n = max(1, M_(n-1)) (1 + b (A_n - p_n) c_n)

is a product of fair bets that restarts whenever it has lost (Waudby-Smith and Ramdas, Estimating means of
bounded random variables by betting, 2023; Shin, Ramdas and Rinaldo, E-detectors, 2023). Under the null
hypothesis M reaches a bound of k within n decisions with a probability of at most n / k, and at least k
decisions pass on average before it does; a difference, old or new, makes it grow exponentially.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

# Number of latest rewards that estimates and the usual reward are computed from: the channel changes.
WINDOW = 120
# With fewer rewards there is no interval and no usual reward, and nothing is bet.
MIN_REWARDS = 10
# Rewards are clipped at this many quartile distances from the median: three standard deviations of a normal
# one.
_CLIP = 2.2
# Log of the winnings from which on the two policies should decide equally often.
_SUSPICION = 1.0
# Stakes b, all bet at once: low ones find small differences, high ones find large differences soon.
_STAKES = np.array((0.25, 0.5, 0.95))


@dataclass(frozen=True)
class Estimate:
    """Mean reward and half width of its 95 % interval (None for fewer than ``MIN_REWARDS``). For people: the
    interval assumes independent rewards."""

    mean: float | None
    half: float | None
    count: int

    @staticmethod
    def of(values: Sequence[float]) -> Estimate:
        if not values:
            return Estimate(None, None, 0)
        found, n = np.array(values), len(values)
        t = float(stats.t.ppf(0.975, n - 1)) if n >= MIN_REWARDS else 0.0
        half = t * float(found.std(ddof=1)) / math.sqrt(n) if n >= MIN_REWARDS else None
        return Estimate(float(found.mean()), half, len(found))

    def __str__(self) -> str:
        if self.mean is None:
            return "not known yet"
        return f"{self.mean:.3f}" + (f" +- {self.half:.3f}" if self.half is not None else "")


class SequentialTest:
    """One-sided: detects that the learned policy is better (``better``), or that it is worse.
    false_alarm_every: average number of decisions between two false detections, at least."""

    def __init__(self, better: bool, false_alarm_every: float) -> None:
        self.better = better
        self._sign = 1.0 if better else -1.0
        self._bound = math.log(false_alarm_every)
        self._log_wealth = np.zeros(len(_STAKES))  # log M of each stake
        self._rewards: deque[tuple[bool, float]] = deque(maxlen=WINDOW)

    def update(self, learned: bool, probability: float, reward: float) -> bool:
        """Take the reward of a decision; returns whether the difference is now detected.

        learned: whether the learned policy took the decision.
        probability: the probability with which the learned policy would be drawn to take it.
        """
        above = self._above_usual(reward)  # judged by earlier rewards, or it would depend on who decided
        self._rewards.append((learned, reward))
        bet = self._sign * (learned - probability) * above / max(probability, 1.0 - probability)
        self._log_wealth = np.maximum(self._log_wealth, 0.0) + np.log1p(_STAKES * bet)
        return self._evidence >= self._bound

    @property
    def is_suspicious(self) -> bool:
        """Whether the policies should decide equally often: detection then takes half of the time."""
        return self._evidence >= _SUSPICION

    @property
    def _evidence(self) -> float:
        """Log of the mean M."""
        return float(np.logaddexp.reduce(self._log_wealth)) - math.log(len(_STAKES))

    @property
    def estimates(self) -> tuple[Estimate, Estimate]:
        """Of the learned policy and of the fixed one, both over the last ``WINDOW`` decisions: otherwise a
        change of the channel would look like a difference."""
        learned, other = ([r for who, r in self._rewards if who is which] for which in (True, False))
        return Estimate.of(learned), Estimate.of(other)

    def _above_usual(self, reward: float) -> float:
        """How far a reward is above the median, in [-1, 1]."""
        n = len(self._rewards)
        if n < MIN_REWARDS:
            return 0.0
        before = sorted(r for _, r in self._rewards)
        above = reward - before[n // 2]
        reach = _CLIP * (before[3 * n // 4] - before[n // 4])
        return max(-1.0, min(1.0, above / reach)) if reach > 0.0 else float(np.sign(above))
