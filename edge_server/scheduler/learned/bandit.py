"""A learner's checkpoint as a policy: ``bandit:FILE``, live and in virtual time.

It decides as the checkpoint was trained to: a set of cameras at the instant of selection, a threshold, or a
wait; by default the likeliest action, with ``explore`` one that is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler import Epoch, Plan, freshest
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.state import State


@dataclass(frozen=True)
class Decided:
    """What a decision saw and did, and what decided. action: (N,) bool, or an index of the omegas; logp: its
    log-probability under the policy that took it."""

    number: int
    now_ns: int
    state: State
    action: NDArray[Any]
    logp: float
    actor: Actor

    def without_frames(self) -> Decided:
        """The same for who keeps many: frames are large, and only explanations look at them."""
        return replace(self, state=replace(self.state, frames={}))


class Bandit:
    """``actor`` as a policy. ``last`` is its newest decision, for who learns from it or explains it."""

    parameter = None
    value: float | None = None

    def __init__(self, actor: Actor, name: str, rng: np.random.Generator, explore: bool = False) -> None:
        self.actor = actor
        self.name = name
        self.explore = explore
        self.last: Decided | None = None
        self._rng = rng

    @staticmethod
    def from_file(path: Path | str, rng: np.random.Generator) -> Bandit:
        """ValueError, in one line, where ``path`` is no checkpoint of a learner."""
        return Bandit(Actor.load(path), f"bandit:{path}", rng)

    @property
    def embedding(self) -> tuple[int, str]:
        """Width of the embeddings that it looks at, 0 without, and whose they are."""
        return self.actor.spec.layout.dim, self.actor.spec.layout.embedding

    def plan(self, epoch: Epoch) -> Plan:
        action = self.actor.spec.action
        if action == "select":  # at once, of what is there
            return Plan(epoch.now_ns)
        omega_ms = self.actor.spec.omegas_ms[int(self._decide(epoch))]
        if action == "threshold" or omega_ms == 0.0:
            return Plan(epoch.now_ns, omega_ms=omega_ms)
        until = epoch.now_ns + round(omega_ms * 1e6)
        return Plan(epoch.now_ns, omega_ms, wait_until_ns=until, generated_after_ns=epoch.now_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        if not epoch.generated_ns:
            return ()
        if self.actor.spec.action == "wait":
            after = plan.generated_after_ns
            return tuple(c for c, g in epoch.generated_ns.items() if after is None or g > after)
        if self.actor.spec.action == "threshold":
            assert plan.omega_ms is not None  # this policy's own plan
            young = tuple(c for c in epoch.generated_ns if epoch.age_ms(c) <= plan.omega_ms)
            return young or freshest(epoch, 1)
        chosen = self._decide(epoch)
        assert self.last is not None
        return tuple(c for c, used in zip(self.last.state.cameras, chosen) if used)

    def _decide(self, epoch: Epoch) -> NDArray[Any]:
        if epoch.state is None:
            raise ValueError(f"{self.name} needs to see more than ages, which is not offered here")
        actor = self.actor  # one that learns is replaced while it decides
        state = epoch.state(actor.spec.layout.parts)
        actions, logps = actor.act([state], self._rng if self.explore else None)
        action = np.asarray(actions[0])
        self.last = Decided(epoch.number, epoch.now_ns, state, action, float(logps[0]), actor)
        return action
