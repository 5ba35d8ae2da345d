"""Actor and value networks as functions of weights, written once for numpy (deciding) and torch (learning).

All cameras share one encoder, with the mean and the maximum over the cameras that have reported as context. It takes
any number of cameras, in any order, whereas the thesis has a layer over all cameras (5.5). The first argument ``xp``
is the module, numpy or torch. All arrays are float64: the networks are tiny, and probabilities near 0 and 1 keep
their precision. Activations are tanh, so that no feature can make a logit overflow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned.learner_spec import Spec

Weights = dict[str, Any]
"""Name -> numpy array or torch tensor."""

# Scale of the number of cameras that have reported.
_COUNT_SCALE = np.log1p(200.0)


def init_actor(spec: Spec, rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """Initial weights of an actor without preferences: its last layer is small, as is common for PPO."""
    weights = _init_trunk(spec, rng)
    outputs = len(spec.omegas_ms) or 1
    if spec.action == "select":
        weights["own"] = _orthogonal(rng, spec.hidden, spec.hidden, 1.0)
    weights["out"] = _orthogonal(rng, spec.hidden, outputs, 0.01)
    weights["out_b"] = np.zeros(outputs)
    return weights


def init_value(spec: Spec, rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """Initial weights of the state value V (5.24), which shares no layer with the actor."""
    return {**_init_trunk(spec, rng), "out": _orthogonal(rng, spec.hidden, 1, 0.1), "out_b": np.zeros(1)}


def logits(xp: Any, spec: Spec, weights: Weights, features: Any) -> Any:
    """Features (B, N, width) to logits: (B, N) of Bernoullis for ``select``, else (B, K) over the omegas."""
    if spec.action != "select":
        return _hidden(xp, weights, features)[0] @ weights["out"] + weights["out_b"]
    context, own = _hidden(xp, weights, features, activated=False)
    each = xp.tanh(own @ weights["own"] + context[:, None, :])
    return (each @ weights["out"] + weights["out_b"])[..., 0]


def value(xp: Any, weights: Weights, features: Any) -> Any:
    """Features (B, N, width) to state values (B,), in units of the rewards' standard deviation."""
    return (_hidden(xp, weights, features)[0] @ weights["out"] + weights["out_b"])[..., 0]


def _hidden(xp: Any, weights: Weights, features: Any, activated: bool = True) -> tuple[Any, Any]:
    """The last hidden layer (B, hidden) and the encoding of each camera (B, N, hidden)."""
    own = xp.tanh(features @ weights["in"] + weights["in_b"])
    own = xp.tanh(own @ weights["enc"] + weights["enc_b"])
    pooled = _pooled(xp, own, features[..., -1:])
    context = pooled @ weights["mid"] + weights["mid_b"]
    return (xp.tanh(context) if activated else context), own


def _pooled(xp: Any, own: Any, mask: Any) -> Any:
    """(B, 2 hidden + 1): mean and maximum over the cameras that have reported, and their number. Zeros if none
    has."""
    count = mask.sum(axis=1)
    mean = (own * mask).sum(axis=1) / xp.clip(count, 1.0, None)
    # A tanh is above -1, so that a camera that has not reported is never the maximum.
    highest = xp.amax(xp.where(mask > 0, own, -1.0 + 0.0 * own), axis=1)
    highest = xp.where(count > 0, highest, 0.0 * highest)
    return xp.concatenate((mean, highest, xp.log1p(count) / _COUNT_SCALE), axis=1)


def _init_trunk(spec: Spec, rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    hidden, width = spec.hidden, spec.layout.width
    gain = 5.0 / 3.0  # for tanh
    zeros = np.zeros(hidden)
    return {
        "in": _orthogonal(rng, width, hidden, gain),
        "in_b": zeros.copy(),
        "enc": _orthogonal(rng, hidden, hidden, gain),
        "enc_b": zeros.copy(),
        "mid": _orthogonal(rng, 2 * hidden + 1, hidden, 1.0),
        "mid_b": zeros.copy(),
    }


def _orthogonal(rng: np.random.Generator, rows: int, columns: int, gain: float) -> NDArray[np.float64]:
    """(rows, columns) with orthonormal rows or columns, whichever are fewer, times ``gain``."""
    tall = rng.standard_normal((max(rows, columns), min(rows, columns)))
    q, r = np.linalg.qr(tall)
    q *= np.sign(np.diag(r))  # otherwise the signs depend on the decomposition
    return np.ascontiguousarray(gain * (q if rows >= columns else q.T))
