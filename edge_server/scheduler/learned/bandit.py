"""A learner's checkpoint as a policy: ``bandit:FILE``, live and in virtual time.

It decides as the checkpoint was trained to: a set of cameras at the instant of selection, a threshold, or a
wait; by default the most probable action, with ``explore`` a sampled one. Where its specification says so
(``hold_ms``), a decision serves several updates, and only the first of them looks at the state.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.fixed import within_threshold
from edge_server.scheduler.learned.actor import Actor, Decision
from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow
from edge_server.scheduler.wait import qualified, wait_window


class BanditPolicy(Policy):
    """``actor`` as a policy. last_decision: the newest one, to learn from or to explain."""

    last_decision: Decision | None = None

    def __init__(self, actor: Actor, name: str, rng: np.random.Generator, explore: bool = False) -> None:
        self.actor = actor
        self.name = name
        self.explore = explore
        self.embedding = actor.spec.layout.dim, actor.spec.layout.embedding
        self._rng = rng

    @staticmethod
    def from_file(path: Path | str, rng: np.random.Generator) -> BanditPolicy:
        """Load a learner's checkpoint. ValueError: ``path`` is not one."""
        return BanditPolicy(Actor.load(path), f"bandit:{path}", rng)

    def plan(self, epoch: Epoch) -> SelectionWindow:
        action = self.actor.spec.action
        if action == "select":
            return SelectionWindow()
        omega_ms = self.actor.spec.omegas_ms[int(self._decide(epoch))]
        if action == "threshold":
            return SelectionWindow(omega_ms)
        return wait_window(epoch.now_ns, omega_ms, arrived=action == "wait-arrived")

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        if not epoch.generated_ns:
            return ()
        if self.actor.spec.action.startswith("wait"):
            return qualified(epoch, window)
        if self.actor.spec.action == "threshold":
            assert window.omega_ms is not None  # this policy's own window
            return within_threshold(epoch, window.omega_ms)
        chosen = self._decide(epoch)
        assert self.last_decision is not None
        return tuple(c for c, used in zip(self.last_decision.state.cameras, chosen) if used)

    def _decide(self, epoch: Epoch) -> NDArray[Any]:
        if epoch.state is None:
            raise ValueError(f"{self.name} needs more than the ages, and only these are available here")
        actor, last = self.actor, self.last_decision  # the online trainer may replace the actor meanwhile
        hold_ns = round(actor.spec.hold_ms * 1e6)
        if hold_ns and last is not None and last.now_ns // hold_ns == epoch.now_ns // hold_ns:
            return last.action
        state = epoch.state(actor.spec.layout.parts)
        actions, logps = actor.act([state], self._rng if self.explore else None)
        action = np.asarray(actions[0])
        self.last_decision = Decision(epoch.number, epoch.now_ns, state, action, float(logps[0]), actor)
        return action
