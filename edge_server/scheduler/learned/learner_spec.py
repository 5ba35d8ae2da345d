"""Everything that defines a learner, as data: a checkpoint carries it, a study varies it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal

from edge_server.scheduler.learned.state import StateLayout, whole

Action = Literal["select", "wait", "threshold"]
ACTIONS: tuple[Action, ...] = ("select", "wait", "threshold")
# A specification may come from a file of a stranger's: no network is allocated that is larger than these lead
# to (with both networks and what Adam remembers, half a gigabyte), which is far beyond what a decision needs.
MOST_HIDDEN = 1024
MOST_OMEGAS = 4096
MOST_CAMERAS = 4096
MOST_FIRST_WEIGHTS = 2**22


@dataclass(frozen=True)
class Spec:
    """action: ``select`` chooses a set of cameras, Bernoulli each (5.18-5.20); ``wait`` and ``threshold``
    choose one of ``omegas_ms`` (6.34, 6.39). network: ``pooled`` is one encoder for every camera and takes
    any number of them; ``flat`` is the thesis's, one layer over ``cameras`` cameras in their order.

    hidden: width of all layers. start: probability of every camera before anything is learnt. The rest is
    PPO's: clip is epsilon of (5.23); entropy and value weigh their terms; passes over a batch end early when
    the policy has moved by ``target_kl``.
    """

    action: Action
    layout: StateLayout = field(default_factory=lambda: StateLayout(("age",)))
    omegas_ms: tuple[float, ...] = ()
    network: Literal["pooled", "flat"] = "pooled"
    cameras: int | None = None
    hidden: int = 64
    start: float = 0.5
    learning_rate: float = 3e-3
    clip: float = 0.2
    passes: int = 10
    minibatch: int = 64
    entropy: float = 0.003
    value: float = 0.5
    max_gradient: float = 0.5
    target_kl: float = 0.05

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise ValueError(f"action {self.action!r} is not known; choose one of {', '.join(ACTIONS)}")
        if (self.action == "select") != (not self.omegas_ms):
            raise ValueError(f"action {self.action}: omegas_ms belong to wait and threshold, and only there")
        if len(self.omegas_ms) > MOST_OMEGAS:
            raise ValueError(f"omegas_ms: expected at most {MOST_OMEGAS}, got {len(self.omegas_ms)}")
        rising = all(a < b for a, b in zip(self.omegas_ms, self.omegas_ms[1:]))
        if not rising or not all(math.isfinite(o) and o >= 0 for o in self.omegas_ms):
            raise ValueError(f"omegas_ms: expected finite values from 0, rising, got {self.omegas_ms}")
        if self.network not in ("pooled", "flat"):
            raise ValueError(f"network {self.network!r} is not known; choose pooled or flat")
        if (self.network == "flat") != (self.cameras is not None):
            raise ValueError("cameras: a flat network has a fixed number of them, a pooled one takes any")
        if self.cameras is not None:
            whole("cameras", self.cameras, 1, MOST_CAMERAS)
        whole("hidden", self.hidden, 1, MOST_HIDDEN)
        whole("passes", self.passes, 1, 10_000)
        whole("minibatch", self.minibatch, 1, 2**31)
        first = self.layout.width * (self.cameras or 1) * self.hidden
        if first > MOST_FIRST_WEIGHTS:
            raise ValueError(
                f"a first layer of {first} weights is larger than any that is trained here: fewer cameras, a "
                "smaller dim or hidden"
            )
        if not 0.0 < self.start < 1.0:
            raise ValueError(f"start: expected a probability between 0 and 1, got {self.start:g}")
        positive = (self.learning_rate, self.clip, self.max_gradient, self.target_kl)
        if not all(0.0 < p < math.inf for p in positive):
            raise ValueError("learning_rate, clip, max_gradient and target_kl must be positive and finite")
        if not all(0.0 <= p < math.inf for p in (self.entropy, self.value)):
            raise ValueError("entropy and value must be finite and not negative")

    def as_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(data: dict[str, Any]) -> Spec:
        """ValueError for what ``as_json`` cannot have written."""
        try:
            values = dict(data)
            layout = dict(values.pop("layout"))
            for name in ("parts", "centre", "spread"):
                layout[name] = tuple(layout[name])
            values["omegas_ms"] = tuple(values["omegas_ms"])
            return Spec(layout=StateLayout(**layout), **values)
        except (TypeError, KeyError) as error:
            raise ValueError(f"not a learner's specification ({error})") from None
