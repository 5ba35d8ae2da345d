"""Reward model of pairwise preferences: Bradley-Terry (4.11-4.13), linear, with Laplace's approximation.

The reward of a step is w . phi(s, a), so that a trajectory's is w . x with x = sum_t phi (4.12). The weights
have a normal prior, whose width the answers themselves choose (evidence). From it follows whether the answers say
anything at all: whether they are likelier under the model than under a coin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.viewpoint_constants import LEAST_ODDS, NEWTON_STEPS, WIDTHS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Answer:
    """One comparison: whether trajectory ``first`` is preferred to ``second``, y_ij of (4.11). None: neither
    is, half a vote for each, y = 1/2 in (4.13), which draws their rewards together and lowers the odds."""

    first: int
    second: int
    prefers_first: bool | None


@dataclass(frozen=True)
class RewardModel:
    """The most probable weights after some answers.

    scale: (d,) by which features are divided.
    weights: (d,), of scaled features.
    odds: how much likelier the answers are under the model than by a coin.
    answers: number of answers.
    """

    scale: Array
    weights: Array
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
        """(...) the reward of features (..., d): of steps, or of whole trajectories."""
        return (features / self.scale) @ self.weights


def fit_reward(features: Array, answers: list[Answer]) -> RewardModel:
    """The model after ``answers``. features: (N, d), one row per trajectory, by the numbers in ``answers``.
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
    found = [_laplace(x, votes, width) for width in WIDTHS]
    evidence = np.array([log_evidence for _, log_evidence in found])
    # The widths are equally likely beforehand: the odds are those of their average.
    highest = evidence.max()
    log_odds = highest + np.log(np.mean(np.exp(evidence - highest))) + len(answers) * np.log(2.0)
    best, _ = found[int(np.argmax(evidence))]
    return RewardModel(scale, best, float(np.exp(min(log_odds, 700.0))), len(answers))


def random_pair(count: int, rng: np.random.Generator) -> tuple[int, int]:
    """Two different ones of ``count`` trajectories. Pairs of which the model is least sure teach it no more."""
    first, second = rng.choice(count, 2, replace=False).tolist()
    return first, second


def _laplace(x: Array, votes: Array, width: float) -> tuple[Array, float]:
    """Best weights (d,), and the log evidence of answers that all prefer what ``x`` (M, d) says, with ``votes``
    (M,)."""
    count = x.shape[1]
    precision = np.eye(count) / width**2
    w = np.zeros(count)

    def cost(w: Array) -> float:  # (4.13), and the prior
        return float(votes @ np.logaddexp(0.0, -x @ w) + 0.5 * w @ w / width**2)

    now = cost(w)
    for _ in range(NEWTON_STEPS):
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
    return w, -now - 0.5 * log_det - count * float(np.log(width))
