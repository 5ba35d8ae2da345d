"""What moved a decision: which part of the state, which camera, which region of its picture.

Explained is how firmly the action was preferred, its logit: of an omega log p / (1 - p), of a set the sum of
every camera's own, for or against. It is compared with what the same network says of average cameras
(``Actor.usual``), and the difference is shared out by Shapley values, so that shares sum to it:

* over the parts (semantics, age, pose) exactly, from all 2^3 combinations;
* over the cameras from permutations in pairs, forward and backward, each of which sums to the whole; with
  the standard error of that.

A region's share is how much the logit falls when the region is painted over and the picture embedded again.
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

Embed = Callable[[Sequence[NDArray[np.uint8]]], NDArray[np.float32]]
"""Images uint8 (H, W, 3) to embeddings (n, d)."""

# Pairs of permutations of 18 cameras. What one costs grows with their square: of more there are fewer, and
# the standard error tells.
PAIRS = 16
_CAMERAS = 18
GRID = 8
# Of letterboxes, opaque: what a detector is used to see nothing in.
_PAINT = (114, 114, 114, 255)


@dataclass(frozen=True)
class Explanation:
    """firmness: logit of the action taken; usual: the same of average cameras. parts: share of each part;
    cameras (N,): of each camera, cameras_error (N,) their standard errors. Parts sum to firmness - usual,
    and so do cameras. names: of the cameras, as far as they have names. action: what was done, for people."""

    action: str
    firmness: float
    usual: float
    parts: dict[str, float]
    cameras: NDArray[np.float64]
    cameras_error: NDArray[np.float64]
    names: tuple[str, ...]

    def strongest(self) -> int | None:
        """The camera whose share is largest, either way; None without cameras."""
        return int(np.argmax(np.abs(self.cameras))) if len(self.cameras) else None


def explain(actor: Actor, state: State, action: Any, pairs: int | None = None) -> Explanation:
    """Why ``action`` (as ``Actor.act`` gives it) was taken in ``state``. Same state, same explanation. pairs:
    of permutations; None: so many that it takes some ten milliseconds."""
    if pairs is None:
        pairs = min(PAIRS, max(2, round(PAIRS * (_CAMERAS / max(len(state), 1)) ** 2)))
    features = actor.spec.layout.features(state)
    usual = np.zeros_like(features)
    if actor.usual is not None:
        usual[features[:, -1] > 0] = actor.usual
    usual[:, -1] = features[:, -1]  # as many of them as have reported
    parts = actor.spec.layout.columns
    whole, nothing = firmness(actor, np.stack([features, usual]), action)
    cameras, error = _of_cameras(actor, features, usual, action, pairs)
    names = state.cameras or tuple(str(i) for i in range(len(state)))
    return Explanation(
        action=told(actor, action, names),
        firmness=float(whole),
        usual=float(nothing),
        parts=_of_parts(actor, features, usual, action, parts),
        cameras=cameras,
        cameras_error=error,
        names=names,
    )


def firmness(actor: Actor, features: NDArray[np.float64], action: Any) -> NDArray[np.float64]:
    """(B,) logits of one action in states of features (B, N, width): positive where it is likelier than
    all else together (an omega), or where the cameras' own logits agree with it (a set)."""
    logits = actor.logits(features)
    if actor.spec.action == "select":
        side = np.where(np.asarray(action, bool), 1.0, -1.0)
        return (logits * side * features[..., -1]).sum(axis=1)
    others = np.delete(logits, int(action), axis=1)
    if not others.shape[1]:  # a single omega was never a choice
        return np.zeros(len(logits))
    highest = others.max(axis=1)
    rest = highest + np.log(np.exp(others - highest[:, None]).sum(axis=1))
    return logits[:, int(action)] - rest


def told(actor: Actor, action: Any, names: Sequence[str]) -> str:
    """An action for people."""
    if actor.spec.action == "select":
        used = [name for name, chosen in zip(names, action) if chosen]
        return f"{len(used)} of {len(names)} views"
    verb = "wait" if actor.spec.action == "wait" else "threshold"
    return f"{verb} {actor.spec.omegas_ms[int(action)]:g} ms"


def occlusion(
    actor: Actor,
    state: State,
    action: Any,
    camera: int,
    image: NDArray[np.uint8],
    embed: Embed,
    grid: int = GRID,
) -> NDArray[np.float64]:
    """(grid, grid) fall of the action's logit when that region of ``camera``'s picture is painted grey: what
    is positive spoke for the action. ValueError where the policy looks at no pictures."""
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
    found = []
    for z in embed(painted):
        embeddings = state.embeddings.copy()
        embeddings[camera] = z
        found.append(actor.spec.layout.features(replace(state, embeddings=embeddings)))
    logits = firmness(actor, np.stack(found), action)
    return (logits[0] - logits[1:]).reshape(grid, grid)


def _of_parts(
    actor: Actor,
    features: NDArray[np.float64],
    usual: NDArray[np.float64],
    action: Any,
    parts: dict[str, slice],
) -> dict[str, float]:
    """Shapley values of the parts, from every combination of them."""
    names = tuple(parts)
    sets = list(itertools.product((False, True), repeat=len(names)))
    mixed = np.repeat(usual[None], len(sets), axis=0)
    for row, chosen in zip(mixed, sets):
        for name, there in zip(names, chosen):
            if there:
                row[:, parts[name]] = features[:, parts[name]]
    value = dict(zip(sets, firmness(actor, mixed, action)))
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


def _of_cameras(
    actor: Actor, features: NDArray[np.float64], usual: NDArray[np.float64], action: Any, pairs: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shapley values (N,) of the cameras and their standard errors. One that is silent has a share of zero:
    it is as usual."""
    n = len(features)
    rng = np.random.default_rng(0)
    found = np.zeros((pairs, n))
    for k in range(pairs):
        order = rng.permutation(n)
        for way in (order, order[::-1]):
            mixed = np.repeat(usual[None], n + 1, axis=0)
            for step, camera in enumerate(way):
                mixed[step + 1 :, camera] = features[camera]
            found[k, way] += 0.5 * np.diff(firmness(actor, mixed, action))
    found[:, features[:, -1] == 0.0] = 0.0  # exactly, not but for rounding
    error = found.std(axis=0, ddof=1) / np.sqrt(pairs) if pairs > 1 else np.full(n, np.nan)
    return found.mean(axis=0), error
