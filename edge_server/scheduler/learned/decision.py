"""What a learned policy decided, and what it saw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.state import State


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
