"""A trained actor, in numpy: a decision takes a fraction of a millisecond and no torch."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned import learning_constants as tuned
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import State

KIND = "scheduler"
"""Kind of file that a learner's checkpoint declares."""


@dataclass(frozen=True)
class Actor:
    """A policy pi(a | s) of ``spec`` with these weights. mean_features: (width,) of the average camera in
    training, the baseline of explanations; None: nothing was learned yet."""

    spec: Spec
    weights: dict[str, NDArray[np.float64]]
    mean_features: NDArray[np.float64] | None = field(default=None, kw_only=True)

    @property
    def digest(self) -> str:
        """Hash of the specification and the weights (hex)."""
        found = hashlib.sha256(json.dumps(self.spec.as_json(), sort_keys=True).encode())
        for name, weights in sorted(self.weights.items()):
            found.update(name.encode() + weights.tobytes())
        return found.hexdigest()[:24]

    def logits(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Features (B, N, width) to logits: (B, N) of cameras, or (B, K) of omegas."""
        return networks.logits(np, self.spec, self.weights, features)

    def act(
        self, states: Sequence[State], rng: np.random.Generator | None = None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Actions and their log-probabilities (B,).

        Actions are sets (B, N) bool, empty only where no camera has reported, or indices (B,) of omegas. With
        ``rng`` they are sampled; without it they are the most probable ones.
        """
        features = self.spec.layout.batch(states)
        logits = self.logits(features)
        if self.spec.action == "select":
            mask = features[..., -1]
            chosen = d.most_probable_set(logits, mask) if rng is None else d.sample_sets(logits, mask, rng)
            return chosen, d.set_log_probability(np, logits, mask, chosen)
        indices = np.argmax(logits, axis=1) if rng is None else d.sample_omegas(logits, rng)
        return indices, d.omega_log_probabilities(np, logits)[np.arange(len(indices)), indices]

    def save(self, path: Path | str) -> None:
        """Write what ``load`` needs; learning cannot resume from it. Raises OSError if it cannot be written."""
        arrays = {f"actor.{name}": w for name, w in self.weights.items()}
        mean = np.zeros(self.spec.layout.width) if self.mean_features is None else self.mean_features
        checkpoint.save(path, {**arrays, "usual": mean}, {"spec": self.spec.as_json()}, kind=KIND)

    @staticmethod
    def load(path: Path | str) -> Actor:
        """The actor of a learner's checkpoint. checkpoint.CheckpointError (a ValueError) for any other
        file."""
        arrays, about = checkpoint.load(path, kind=KIND, most_bytes=tuned.MAX_LEARNER_BYTES)
        spec = read_spec(path, about)
        expected = networks.init_actor(spec, np.random.default_rng(0))
        found: dict[str, NDArray[np.float64]] = {}
        for name, like in {**expected, "usual": np.zeros(spec.layout.width)}.items():
            w = arrays.get("usual" if name == "usual" else f"actor.{name}")
            if w is None or (w.shape, w.dtype) != (like.shape, like.dtype) or not np.isfinite(w).all():
                raise checkpoint.CheckpointError(f"{path}: damaged: the actor's {name} is not whole")
            found[name] = w
        return Actor(spec, found, mean_features=found.pop("usual"))


@dataclass(frozen=True)
class Decision:
    """A learned policy's decision: number and time of its epoch, the state it saw, its action ((N,) bool, or
    an index of the omegas), the action's log-probability, and the actor that took it."""

    number: int
    now_ns: int
    state: State
    action: NDArray[Any]
    logp: float
    actor: Actor


def read_spec(path: Path | str, about: dict[str, Any]) -> Spec:
    """The specification in a checkpoint's metadata."""
    try:
        return Spec.from_json(about["spec"])
    except (KeyError, TypeError, ValueError) as error:
        raise checkpoint.CheckpointError(f"{path}: its policy cannot be used: {error}") from None
