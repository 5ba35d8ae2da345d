"""Reward model of pairwise preferences: Bradley-Terry (4.11-4.13), linear, with Laplace's approximation.

The reward of a step is w . phi(s, a), so that a trajectory's is w . x with x = sum_t phi (4.12). The weights
have a normal prior, whose width the answers themselves choose (evidence); the posterior is normal about the
best weights. From it follow how sure a prediction is, which pair to ask next, and whether the answers say
anything at all: whether they are likelier under the model than under a coin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.settings import LEAST_ODDS, WIDTHS

Array = NDArray[np.float64]

_NEWTON_STEPS = 50
_UNBIASED = 3
_NODES, _NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
_NODE_WEIGHTS = _NODE_WEIGHTS / _NODE_WEIGHTS.sum()


@dataclass(frozen=True)
class Answer:
    """One comparison: whether trajectory ``first`` is preferred to ``second``, y_ij of (4.11). None: neither
    is, half a vote for each, y = 1/2 in (4.13), which draws their rewards together and lowers the odds."""

    first: int
    second: int
    prefers_first: bool | None


@dataclass(frozen=True)
class RewardModel:
    """The posterior after some answers.

    scale: (d,) by which features are divided.
    mean, covariance: (d,) and (d, d), of the weights of scaled features.
    odds: how much likelier the answers are under the model than by a coin.
    answers: number of answers.
    """

    scale: Array
    mean: Array
    covariance: Array
    odds: float
    answers: int

    @property
    def knows(self) -> bool:
        """Whether the answers are informative: ``odds`` reaches LEAST_ODDS."""
        return self.odds >= LEAST_ODDS

    def says(self) -> str:
        """One line for people."""
        if self.answers == 0:
            return "no answers yet: it knows nothing"
        if self.knows:
            return f"{self.answers} answers, {self.odds:.3g} times likelier than by a coin"
        return (
            f"it does not know: {self.answers} answers are hardly likelier under any preference it can "
            f"express than by a coin (odds {self.odds:.2g}, {LEAST_ODDS:g} needed): too few, or they "
            "contradict each other"
        )

    def reward(self, features: Array) -> Array:
        """(...) the mean reward of features (..., d): of steps, or of whole trajectories."""
        return (features / self.scale) @ self.mean

    def probability(self, features: Array, first: NDArray[np.int64], second: NDArray[np.int64]) -> Array:
        """(M,) probability that each first trajectory is preferred, averaged over the posterior.

        features: (N, d) of the trajectories. first, second: (M,) their numbers.
        """
        return _expected(*self._difference(features, first, second))[0]

    def information(self, features: Array, first: NDArray[np.int64], second: NDArray[np.int64]) -> Array:
        """(M,) nats that the answer to each pair is expected to give about the weights: the entropy of the
        answer less what would remain if the weights were known. Arguments as in ``probability``."""
        mean, entropy = _expected(*self._difference(features, first, second))
        return _entropy(mean) - entropy

    def _difference(self, features: Array, first: NDArray[np.int64], second: NDArray[np.int64]) -> tuple[Array, Array]:
        """Mean and variance (M,) of the differences of rewards."""
        x = (features[first] - features[second]) / self.scale
        return x @ self.mean, np.einsum("md,de,me->m", x, self.covariance, x)


def fit_reward(features: Array, answers: list[Answer]) -> RewardModel:
    """The posterior of the weights. features: (N, d), one row per trajectory, by the numbers in ``answers``.
    Raises ViewpointError for features that are not finite or answers about unknown trajectories."""
    features = np.asarray(features, np.float64)
    if features.ndim != 2 or len(features) < 2 or not np.isfinite(features).all():
        raise ViewpointError("a reward model needs finite features of at least two trajectories")
    if any(not 0 <= k < len(features) for a in answers for k in (a.first, a.second)):
        raise ViewpointError(f"an answer names a trajectory that is not one of the {len(features)}")
    spread = features.std(axis=0)
    # So that a usual pair differs by about 1 in all features together. What never varies says nothing.
    usual = np.sqrt(2.0 * max(int((spread > 1e-12).sum()), 1))
    scale = np.where(spread > 1e-12, spread * usual, np.inf)
    first = np.array([a.first for a in answers], np.int64)
    second = np.array([a.second for a in answers], np.int64)
    # The share of the vote that is for the first, y of (4.13); the rest is for the second.
    y = np.array([0.5 if a.prefers_first is None else float(a.prefers_first) for a in answers])
    x = (features[first] - features[second]) / scale
    votes = np.concatenate([y, 1.0 - y])
    x, votes = np.concatenate([x, -x])[votes > 0.0], votes[votes > 0.0]
    found = [(*_laplace(x, votes, width), width) for width in WIDTHS]
    evidence = np.array([log_evidence for _, _, log_evidence, _ in found])
    mean, covariance, _, _ = found[int(np.argmax(evidence))]
    # The widths are equally likely beforehand: the odds are those of their average.
    highest = evidence.max()
    log_odds = highest + np.log(np.mean(np.exp(evidence - highest))) + len(answers) * np.log(2.0)
    return RewardModel(scale, mean, covariance, float(np.exp(min(log_odds, 700.0))), len(answers))


def next_pair(model: RewardModel, features: Array, rng: np.random.Generator, pairs: int = 500) -> tuple[int, int]:
    """The most informative of ``pairs`` random pairs of trajectories. Every ``_UNBIASED``-th question takes a
    random pair instead: on doubtful pairs alone, honest answers look like contradictions."""
    first = rng.integers(len(features), size=1 if model.answers % _UNBIASED == 0 else pairs)
    second = (first + 1 + rng.integers(len(features) - 1, size=len(first))) % len(features)
    best = int(np.argmax(model.information(features, first, second)))
    return int(first[best]), int(second[best])


def _laplace(x: Array, votes: Array, width: float) -> tuple[Array, Array, float]:
    """Best weights (d,), their covariance (d, d), and the log evidence of answers that all prefer what
    ``x`` (M, d) says, with ``votes`` (M,)."""
    count = x.shape[1]
    precision = np.eye(count) / width**2
    w = np.zeros(count)

    def cost(w: Array) -> float:  # (4.13), and the prior
        return float(votes @ np.logaddexp(0.0, -x @ w) + 0.5 * w @ w / width**2)

    now = cost(w)
    for _ in range(_NEWTON_STEPS):
        p = 0.5 * (1.0 + np.tanh(0.5 * (x @ w)))
        gradient = x.T @ (votes * (p - 1.0)) + w / width**2
        hessian = precision + (x * (votes * p * (1.0 - p))[:, None]).T @ x
        step, share = np.linalg.solve(hessian, gradient), 1.0
        while (then := cost(w - share * step)) > now and share > 1e-6:
            share *= 0.5
        w, change, now = w - share * step, now - then, then
        if change < 1e-10:
            break
    p = 0.5 * (1.0 + np.tanh(0.5 * (x @ w)))
    hessian = precision + (x * (votes * p * (1.0 - p))[:, None]).T @ x
    log_det = float(np.linalg.slogdet(hessian)[1])
    covariance = np.asarray(np.linalg.inv(hessian), np.float64)
    return w, covariance, -now - 0.5 * log_det - count * float(np.log(width))


def _expected(mean: Array, variance: Array) -> tuple[Array, Array]:
    """The means (M,), over a normal, of the logistic function and of its entropy, by quadrature."""
    at = mean[:, None] + np.sqrt(np.maximum(variance, 0.0))[:, None] * _NODES
    p = 0.5 * (1.0 + np.tanh(0.5 * at))
    return p @ _NODE_WEIGHTS, _entropy(p) @ _NODE_WEIGHTS


def _entropy(p: Array) -> Array:
    """Nats."""
    q = np.clip(p, 1e-12, 1.0 - 1e-12)
    return -(q * np.log(q) + (1.0 - q) * np.log1p(-q))
