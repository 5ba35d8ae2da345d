"""An actor that has been learnt, deciding: numpy and weights, a fraction of a millisecond, no torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import State

KIND = "scheduler"
"""What the checkpoints of learners say they are."""
# Of a learner's checkpoint, unpacked: both networks and what Adam remembers of them, at their largest.
MOST_BYTES = 2**29


@dataclass(frozen=True)
class Actor:
    """A policy pi(a | s): what ``spec`` says, with these weights. usual (width,): features of the average
    camera of the training, which explanations compare with; None: nothing was learnt yet."""

    spec: Spec
    weights: dict[str, NDArray[np.float64]]
    usual: NDArray[np.float64] | None = field(default=None, kw_only=True)

    def logits(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Features (B, N, width) to logits: (B, N) of cameras, or (B, K) of omegas."""
        return networks.logits(np, self.spec, self.weights, features)

    def act(
        self, states: Sequence[State], rng: np.random.Generator | None = None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Actions and their log-probabilities (B,): drawn with ``rng``, without it the likeliest. Actions
        are sets (B, N) bool, empty only where no camera has reported, or indices (B,) of omegas."""
        features = self.spec.layout.batch(states)
        logits = self.logits(features)
        if self.spec.action == "select":
            mask = features[..., -1]
            chosen = d.likeliest_set(logits, mask) if rng is None else d.draw_sets(logits, mask, rng)
            return chosen, d.set_log_probability(np, logits, mask, chosen)
        indices = np.argmax(logits, axis=1) if rng is None else d.draw_omegas(logits, rng)
        return indices, d.omega_log_probabilities(np, logits)[np.arange(len(indices)), indices]

    def save(self, path: Path | str) -> None:
        """What ``load`` needs and no more: nothing goes on learning from it. OSError where it cannot be
        written."""
        arrays = {f"actor.{name}": w for name, w in self.weights.items()}
        usual = np.zeros(self.spec.layout.width) if self.usual is None else self.usual
        checkpoint.save(path, {**arrays, "usual": usual}, {"spec": self.spec.as_json()}, kind=KIND)

    @staticmethod
    def load(path: Path | str) -> Actor:
        """The actor of a learner's checkpoint. checkpoint.CheckpointError (a ValueError) for anything
        else."""
        arrays, about = checkpoint.load(path, kind=KIND, most_bytes=MOST_BYTES)
        spec = read_spec(path, about)
        expected = networks.new_actor(spec, np.random.default_rng(0))
        usual = np.zeros(spec.layout.width)
        found: dict[str, NDArray[np.float64]] = {}
        for name, like in {**expected, "usual": usual}.items():
            w = arrays.get("usual" if name == "usual" else f"actor.{name}")
            if w is None or (w.shape, w.dtype) != (like.shape, like.dtype) or not np.isfinite(w).all():
                raise checkpoint.CheckpointError(f"{path}: damaged: the actor's {name} is not whole")
            found[name] = w
        return Actor(spec, found, usual=found.pop("usual"))


def read_spec(path: Path | str, about: dict[str, Any]) -> Spec:
    """The specification in a checkpoint's facts."""
    try:
        return Spec.from_json(about["spec"])
    except (KeyError, TypeError, ValueError) as error:
        raise checkpoint.CheckpointError(f"{path}: its policy cannot be used: {error}") from None
