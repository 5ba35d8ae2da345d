"""Distributions over actions, computed from logits so that they are exact for probabilities near 0 and 1.

A set of cameras is drawn as one Bernoulli variable per camera (5.20), and empty sets are redrawn (K_t >= 1). The
probability of a set is therefore conditioned on not being empty, p(a) / (1 - prod (1 - p_i)); in logits l

    log p(a | not empty) = sum_{i in a} l_i - log(prod_i (1 + exp l_i) - 1),

which holds where every p_i underflows: then one camera is drawn, in proportion to its odds. Cameras that have
not reported (mask 0) cannot be drawn; where none has, the set is empty with probability one.

``xp`` is numpy or torch; logits, masks and actions are float64 (B, N) or, of omegas, (B, K).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below it, exp(s) - 1 with s = sum log(1 + exp l) equals the sum of the odds to the last digit.
_TINY = 1e-12


def set_log_probability(xp: Any, logits: Any, mask: Any, chosen: Any) -> Any:
    """(B,) log-probability of the sets ``chosen`` (B, N), 1 or 0 per camera, given that they are not empty."""
    return (logits * chosen * mask).sum(axis=-1) - _log_odds_of_any(xp, logits, mask)


def set_entropy(xp: Any, logits: Any, mask: Any) -> Any:
    """(B,) sum of the cameras' entropies. As the exploration bonus it may ignore the condition, which couples
    the cameras only where nearly nothing is drawn."""
    softplus = _softplus(xp, logits)
    return ((softplus - logits * xp.exp(logits - softplus)) * mask).sum(axis=-1)


def omega_log_probabilities(xp: Any, logits: Any) -> Any:
    """(B, K) log-probabilities of the categorical (6.39)."""
    highest = xp.amax(logits, axis=-1)[..., None]
    return logits - highest - xp.log(xp.exp(logits - highest).sum(axis=-1))[..., None]


def omega_entropy(xp: Any, logits: Any) -> Any:
    """(B,) entropy of the categorical."""
    logps = omega_log_probabilities(xp, logits)
    return -(xp.exp(logps) * logps).sum(axis=-1)


def sample_sets(logits: Array, mask: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(B, N) sets from the conditioned distribution.

    Draws camera by camera, each given that this or a later one must be drawn if none was. This is the
    distribution of redrawing until the set is not empty, without endless redrawing where all probabilities
    are tiny.
    """
    batch, cameras = logits.shape
    softplus = _softplus(np, logits) * mask
    # Sums over camera i and all later ones.
    s = np.cumsum(softplus[:, ::-1], axis=1)[:, ::-1]
    odds = np.logaddexp.accumulate(np.where(mask > 0, logits, -np.inf)[:, ::-1], axis=1)[:, ::-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_any = np.where(s > _TINY, s + np.log(-np.expm1(-s)), odds)
        first = np.exp(logits + (s - softplus) - log_any)
    later = np.exp(logits - _softplus(np, logits))
    uniform = rng.random((batch, cameras))
    chosen = np.zeros((batch, cameras), bool)
    none = np.ones(batch, bool)
    for i in range(cameras):
        chosen[:, i] = (mask[:, i] > 0) & (uniform[:, i] < np.where(none, first[:, i], later[:, i]))
        none &= ~chosen[:, i]
    # The last camera's probability is 1 except for rounding.
    empty = np.flatnonzero(none & (mask > 0).any(axis=1))
    last = cameras - 1 - np.argmax(mask[empty][:, ::-1] > 0, axis=1)
    chosen[empty, last] = True
    return chosen


def most_probable_set(logits: Array, mask: Array) -> NDArray[np.bool_]:
    """(B, N) the most probable non-empty sets: all cameras with p > 1/2, else the most probable one."""
    chosen = (logits > 0) & (mask > 0)
    empty = np.flatnonzero(~chosen.any(axis=1) & (mask > 0).any(axis=1))
    best = np.argmax(np.where(mask[empty] > 0, logits[empty], -np.inf), axis=1)
    chosen[empty, best] = True
    return chosen


def sample_omegas(logits: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """(B,) indices from the categorical; one uniform number each."""
    below = np.cumsum(np.exp(omega_log_probabilities(np, logits)), axis=1)
    uniform = rng.random((len(logits), 1)) * below[:, -1:]
    return np.minimum((uniform >= below).sum(axis=1), logits.shape[1] - 1)


def _softplus(xp: Any, x: Any) -> Any:
    return xp.logaddexp(xp.zeros_like(x), x)


def _log_odds_of_any(xp: Any, logits: Any, mask: Any) -> Any:
    """(B,) log(prod (1 + exp l) - 1) over the cameras that have reported; 0 where none has."""
    some = xp.amax(mask, axis=-1)
    s = (_softplus(xp, logits) * mask).sum(axis=-1)
    # Every branch stays finite: torch would multiply an infinite gradient by the zero of the branch not
    # taken.
    large = s > _TINY
    enough = xp.where(large, s, 1.0 + 0.0 * s)
    exact = enough + xp.log(-xp.expm1(-enough))
    highest = xp.amax(xp.where(mask > 0, logits, -1e300 + 0.0 * logits), axis=-1)
    highest = xp.where(some > 0, highest, 0.0 * s)
    below = xp.where(mask > 0, logits - highest[..., None], 0.0 * logits)
    odds = highest + xp.log((xp.exp(below) * mask).sum(axis=-1) + (1.0 - some))
    return xp.where(large, exact, odds) * some
