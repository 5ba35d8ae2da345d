"""Attributes a decision to the parts of the state, the cameras, and the regions of a camera's image.

The explained quantity is the logit of the action: of an omega log p / (1 - p), of a set the sum of all
cameras' own logits, for or against. It is compared with the logit for average cameras
(``Actor.mean_features``), and the difference is attributed by Shapley values, so that the shares sum to it:

* to the parts (semantics, age, pose) exactly, from all 2^3 combinations;
* to the cameras from pairs of permutations, forward and backward, with the standard error of the estimate.

A region's share is how much the logit falls when the region is painted over and the image embedded again.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.state import State

EmbedImages = Callable[[Sequence[NDArray[np.uint8]]], NDArray[np.float32]]
"""Images uint8 (H, W, 3) to embeddings (n, d)."""

# Pairs of permutations for 18 cameras. A pair's cost grows with the square of the cameras: more cameras get
# fewer pairs, and the standard error shows it.
PAIRS = 16
_CAMERAS = 18
GRID = 8
# The gray of letterboxes, opaque: detectors are used to seeing nothing in it.
_PAINT = (114, 114, 114, 255)


@dataclass(frozen=True)
class Explanation:
    """Shares of a decision's logit.

    action: the action in words.
    logit: logit of the action taken. baseline_logit: the same for average cameras.
    parts: share of each part of the state.
    cameras, cameras_error: (N,), share of each camera, and its standard error.
    names: names of the cameras.
    Parts sum to logit - baseline_logit, and so do cameras.
    """

    action: str
    logit: float
    baseline_logit: float
    parts: dict[str, float]
    cameras: NDArray[np.float64]
    cameras_error: NDArray[np.float64]
    names: tuple[str, ...]


def explain(actor: Actor, state: State, action: Any, pairs: int | None = None) -> Explanation:
    """Explain why ``actor`` took ``action`` (as ``Actor.act`` gives it) in ``state``; repeatable. pairs:
    number of pairs of permutations; None: as many as take some ten milliseconds."""
    if pairs is None:
        pairs = min(PAIRS, max(2, round(PAIRS * (_CAMERAS / max(len(state), 1)) ** 2)))
    features = actor.spec.layout.features(state)
    baseline = np.zeros_like(features)
    if actor.mean_features is not None:
        baseline[features[:, -1] > 0] = actor.mean_features
    baseline[:, -1] = features[:, -1]  # as many cameras as have reported
    both = action_logit(actor, np.stack([features, baseline]), action)
    cameras, error = _camera_shares(actor, features, baseline, action, pairs)
    names = state.cameras or tuple(str(i) for i in range(len(state)))
    return Explanation(
        action=describe_action(actor, action, names),
        logit=float(both[0]),
        baseline_logit=float(both[1]),
        parts=_part_shares(actor, features, baseline, action),
        cameras=cameras,
        cameras_error=error,
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
    actor: Actor, state: State, action: Any, camera: int, image: NDArray[np.uint8], embed: EmbedImages, grid: int = GRID
) -> NDArray[np.float64]:
    """(grid, grid) fall of the action's logit when a region of ``camera``'s image is painted gray: positive
    regions spoke for the action. ValueError where the policy does not look at images."""
    if "semantics" not in actor.spec.layout.parts or state.embeddings is None:
        raise ValueError("this policy looks at no pictures: no region of one can have moved it")
    height, width = image.shape[:2]
    rows = np.linspace(0, height, grid + 1).astype(int)
    columns = np.linspace(0, width, grid + 1).astype(int)
    painted = [image]
    for i, j in itertools.product(range(grid), repeat=2):
        copy = image.copy()
        copy[rows[i] : rows[i + 1], columns[j] : columns[j + 1]] = _PAINT[: image.shape[2]]
        painted.append(copy)
    features = []
    for z in embed(painted):
        embeddings = state.embeddings.copy()
        embeddings[camera] = z
        features.append(actor.spec.layout.features(replace(state, embeddings=embeddings)))
    logits = action_logit(actor, np.stack(features), action)
    return (logits[0] - logits[1:]).reshape(grid, grid)


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


def _camera_shares(
    actor: Actor, features: NDArray[np.float64], baseline: NDArray[np.float64], action: Any, pairs: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shapley values (N,) of the cameras and their standard errors; zero for a camera that has not
    reported."""
    n = len(features)
    rng = np.random.default_rng(0)
    found = np.zeros((pairs, n))
    for k in range(pairs):
        order = rng.permutation(n)
        for way in (order, order[::-1]):
            mixed = np.repeat(baseline[None], n + 1, axis=0)
            for step, camera in enumerate(way):
                mixed[step + 1 :, camera] = features[camera]
            found[k, way] += 0.5 * np.diff(action_logit(actor, mixed, action))
    found[:, features[:, -1] == 0.0] = 0.0  # exactly, without rounding
    error = found.std(axis=0, ddof=1) / np.sqrt(pairs) if pairs > 1 else np.full(n, np.nan)
    return found.mean(axis=0), error
