"""The specification of a learner, as data: checkpoints store it, studies vary it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal

from edge_server.edge_constants import LONGEST_MS
from edge_server.scheduler.learned import learning_constants as tuned
from edge_server.scheduler.learned.state import StateLayout, require_int

Action = Literal["select", "wait", "wait-arrived", "threshold"]
ACTIONS: tuple[Action, ...] = ("select", "wait", "wait-arrived", "threshold")
# Keys of earlier versions that had several values, and the only one still supported.
_GONE = {"network": "pooled", "cameras": None, "start": 0.5}


@dataclass(frozen=True)
class Spec:
    """Actions, state, network and hyperparameters of a learner.

    action: ``select`` chooses a set of cameras, Bernoulli each (5.18-5.20); ``wait``, ``wait-arrived`` and
    ``threshold`` choose one of ``omegas_ms`` (6.34, 6.39).
    layout: the features of a state.
    hidden: width of all layers.
    hold_ms: a decision holds until the next multiple of it; 0: every update has its own decision.
    learning_rate, minibatch: of Adam's steps. max_gradient: bound of the gradient's norm (clipping).
    clip: epsilon of (5.23).
    passes: over a batch; they end early once the policy has moved by ``target_kl`` (nats).
    entropy, value: weights of these terms of the loss.
    """

    action: Action
    layout: StateLayout = field(default_factory=lambda: StateLayout(("age",)))
    omegas_ms: tuple[float, ...] = ()
    hidden: int = tuned.HIDDEN
    hold_ms: float = 0.0
    learning_rate: float = tuned.LEARNING_RATE
    clip: float = tuned.CLIP
    passes: int = tuned.PASSES
    minibatch: int = tuned.MINIBATCH
    entropy: float = tuned.ENTROPY
    value: float = tuned.VALUE
    max_gradient: float = tuned.MAX_GRADIENT
    target_kl: float = tuned.TARGET_KL

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise ValueError(f"action {self.action!r} is not known; choose one of {', '.join(ACTIONS)}")
        if (self.action == "select") != (not self.omegas_ms):
            raise ValueError(f"action {self.action}: all but select need omegas_ms, and select takes none")
        if len(self.omegas_ms) > tuned.MAX_OMEGAS:
            raise ValueError(f"omegas_ms: expected at most {tuned.MAX_OMEGAS}, got {len(self.omegas_ms)}")
        rising = all(a < b for a, b in zip(self.omegas_ms, self.omegas_ms[1:]))
        if not rising or not all(0 <= o <= LONGEST_MS for o in self.omegas_ms):
            raise ValueError(f"omegas_ms: expected values from 0 to {LONGEST_MS:.0f}, rising, got {self.omegas_ms}")
        require_int("hidden", self.hidden, 1, tuned.MAX_HIDDEN)
        require_int("passes", self.passes, 1, 10_000)
        require_int("minibatch", self.minibatch, 1, 2**31)
        first = self.layout.width * self.hidden
        if first > tuned.MAX_FIRST_WEIGHTS:
            raise ValueError(
                f"a first layer of {first} weights is larger than any that is trained here: reduce dim or hidden"
            )
        if not 0.0 <= self.hold_ms < 1e9:
            raise ValueError(f"hold_ms: expected milliseconds from 0, got {self.hold_ms:g}")
        positive = (self.learning_rate, self.clip, self.max_gradient, self.target_kl)
        if not all(0.0 < p < math.inf for p in positive):
            raise ValueError("learning_rate, clip, max_gradient and target_kl must be positive and finite")
        if not all(0.0 <= p < math.inf for p in (self.entropy, self.value)):
            raise ValueError("entropy and value must be finite and not negative")

    def as_json(self) -> dict[str, Any]:
        """The specification as JSON values, for ``from_json``."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(data: dict[str, Any]) -> Spec:
        """Inverse of ``as_json``. Raises ValueError for data that it cannot have written."""
        try:
            values = dict(data)
            for name, only in _GONE.items():
                if values.pop(name, only) != only:
                    raise ValueError(f"{name}: only {only} is supported; train a new policy")
            layout = dict(values.pop("layout"))
            for name in ("parts", "center", "spread"):
                layout[name] = tuple(layout[name])
            values["omegas_ms"] = tuple(values["omegas_ms"])
            return Spec(layout=StateLayout(**layout), **values)
        except (TypeError, KeyError, OverflowError) as error:
            raise ValueError(f"not a learner's specification ({error})") from None
