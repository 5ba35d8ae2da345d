"""Attributes a decision to the parts of the state, the cameras, and the regions of a camera's image.

The explained quantity is the logit of the action: for an omega log p / (1 - p), for a set the sum of the cameras'
logits, negated for those left out.

* A part's (semantics, age, pose) is its Shapley value, from all 2^3 combinations, of the difference to the logit for
  average cameras (``Actor.mean_features``), so that the shares of the parts sum to it.
* A camera's share is the drop of the logit when that camera is replaced by an average one.
* A region's share is the drop of the logit when the region is painted over and the image embedded again.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned import learning_constants as tuned
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.state import State

EmbedImages = Callable[[Sequence[NDArray[np.uint8]]], NDArray[np.float32]]
"""Images uint8 (H, W, 3) to embeddings (n, d)."""

# The gray of letterboxes, opaque: detectors are trained to find nothing in it.
_PAINT = (114, 114, 114, 255)


@dataclass(frozen=True)
class Explanation:
    """Shares of a decision's logit.

    action: the action in words.
    logit: logit of the action taken. baseline_logit: the same for average cameras.
    parts: share of each part of the state.
    cameras: (N,), share of each camera. names: names of the cameras.
    Parts sum to logit - baseline_logit.
    """

    action: str
    logit: float
    baseline_logit: float
    parts: dict[str, float]
    cameras: NDArray[np.float64]
    names: tuple[str, ...]


def explain(actor: Actor, state: State, action: Any) -> Explanation:
    """Explain ``action`` (as ``Actor.act`` gives it) in ``state``; repeatable."""
    features = actor.spec.layout.features(state)
    baseline = np.zeros_like(features)
    if actor.mean_features is not None:
        baseline[features[:, -1] > 0] = actor.mean_features
    baseline[:, -1] = features[:, -1]  # as many cameras as have reported
    each = np.eye(len(features), dtype=bool)[..., None]  # (N, N, 1), one camera an average one
    logits = action_logit(actor, np.stack([features, baseline, *np.where(each, baseline, features)]), action)
    names = state.cameras or tuple(str(i) for i in range(len(state)))
    return Explanation(
        action=describe_action(actor, action, names),
        logit=float(logits[0]),
        baseline_logit=float(logits[1]),
        parts=_part_shares(actor, features, baseline, action),
        # A camera that has not reported is average already, but equal states of a batch may round differently.
        cameras=np.where(features[:, -1] > 0, logits[0] - logits[2:], 0.0),
        names=names,
    )


def action_logit(actor: Actor, features: NDArray[np.float64], action: Any) -> NDArray[np.float64]:
    """(B,) logits of one action in states of features (B, N, width): positive where an omega is more probable
    than all others together, or where the cameras' own logits agree with a set."""
    logits = actor.logits(features)
    if actor.spec.action == "select":
        side = np.where(np.asarray(action, bool), 1.0, -1.0)
        return (logits * side * features[..., -1]).sum(axis=1)
    others = np.delete(logits, int(action), axis=1)
    if not others.shape[1]:  # a single omega leaves no choice
        return np.zeros(len(logits))
    highest = others.max(axis=1)
    rest = highest + np.log(np.exp(others - highest[:, None]).sum(axis=1))
    return logits[:, int(action)] - rest


def describe_action(actor: Actor, action: Any, names: Sequence[str]) -> str:
    """An action in words."""
    if actor.spec.action == "select":
        used = [name for name, chosen in zip(names, action) if chosen]
        return f"{len(used)} of {len(names)} views"
    return f"{actor.spec.action} {actor.spec.omegas_ms[int(action)]:g} ms"


def occlusion_map(
    actor: Actor, state: State, action: Any, camera: int, image: NDArray[np.uint8], embed: EmbedImages
) -> NDArray[np.float64]:
    """(REGIONS_A_SIDE, REGIONS_A_SIDE) drop of the action's logit when a region of ``camera``'s image is painted gray:
    positive regions favored the action. Raises ValueError if the policy does not use images."""
    if "semantics" not in actor.spec.layout.parts or state.embeddings is None:
        raise ValueError("this policy does not use images, so no image region can have influenced it")
    height, width = image.shape[:2]
    rows = np.linspace(0, height, tuned.REGIONS_A_SIDE + 1).astype(int)
    columns = np.linspace(0, width, tuned.REGIONS_A_SIDE + 1).astype(int)
    painted = [image]
    for i, j in itertools.product(range(tuned.REGIONS_A_SIDE), repeat=2):
        copy = image.copy()
        copy[rows[i] : rows[i + 1], columns[j] : columns[j + 1]] = _PAINT[: image.shape[2]]
        painted.append(copy)
    features = []
    for z in embed(painted):
        embeddings = state.embeddings.copy()
        embeddings[camera] = z
        features.append(actor.spec.layout.features(replace(state, embeddings=embeddings)))
    logits = action_logit(actor, np.stack(features), action)
    return (logits[0] - logits[1:]).reshape(tuned.REGIONS_A_SIDE, tuned.REGIONS_A_SIDE)


def _part_shares(
    actor: Actor, features: NDArray[np.float64], baseline: NDArray[np.float64], action: Any
) -> dict[str, float]:
    """Shapley values of the parts, from every combination of them."""
    columns = actor.spec.layout.columns
    names = tuple(columns)
    sets = list(itertools.product((False, True), repeat=len(names)))
    mixed = np.repeat(baseline[None], len(sets), axis=0)
    for row, chosen in zip(mixed, sets):
        for name, there in zip(names, chosen):
            if there:
                row[:, columns[name]] = features[:, columns[name]]
    value = dict(zip(sets, action_logit(actor, mixed, action)))
    n = len(names)
    out = {}
    for i, name in enumerate(names):
        share = 0.0
        for chosen in sets:
            if not chosen[i]:
                size = sum(chosen)
                weight = math.factorial(size) * math.factorial(n - size - 1) / math.factorial(n)
                share += weight * (value[(*chosen[:i], True, *chosen[i + 1 :])] - value[chosen])
        out[name] = float(share)
    return out
