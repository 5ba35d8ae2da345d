"""The interface of policies: at each decision epoch, a policy selects the views of the next update.

A decision has two halves, because a policy may wait in between: ``plan`` runs at the decision epoch and sets how long
to wait, ``select`` then picks cameras from the buffer. Live and virtual time share them: both use only their
arguments, the policy's seeded random stream, and what the policy remembers of earlier calls. A run makes one
instance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from edge_server.edge_constants import LONGEST_MS
from edge_server.scheduler.learned.state import STATE_PARTS, State

if TYPE_CHECKING:  # loaded only by the policies that need them
    from edge_server.scheduler.learned.actor import Decision


class Observer(Protocol):
    """Computes the state of all cameras when it is called, and only the ``parts`` asked for."""

    def __call__(self, parts: Sequence[str] = STATE_PARTS) -> State: ...


@dataclass(frozen=True)
class Epoch:
    """The information available to a policy.

    now_ns: time of the decision on the edge's clock.
    number: counts the epochs; at the edge it is the number of the update to decide on.
    generated_ns, received_ns: when the newest frame of each camera was generated, and when it arrived;
    cameras that have not reported are missing.
    state: computes the state of all cameras, with poses and embeddings, for policies that use more than ages;
    None if it is not available.
    """

    now_ns: int
    number: int
    generated_ns: Mapping[str, int]
    state: Observer | None = None
    received_ns: Mapping[str, int] = field(default_factory=dict)

    def age_ms(self, camera: str) -> float:
        return (self.now_ns - self.generated_ns[camera]) / 1e6


@dataclass(frozen=True)
class SelectionWindow:
    """The first half of a decision: when to select, and which frames qualify.

    omega_ms: for display; None for policies without one.
    wait_until_ns: earliest instant of selection; there is no latest.
    generated_after_ns, received_after_ns: only frames generated, or arrived, later qualify (omega-wait); None
    admits all. Only ``select`` enforces this.
    flush: abort what is in transit at the decision (virtual time only).
    """

    omega_ms: float | None = None
    wait_until_ns: int = 0
    generated_after_ns: int | None = None
    received_after_ns: int | None = None
    flush: bool = False


class Policy:
    """Base of all policies. A subclass sets ``name`` and implements ``select``; the rest are defaults.

    parameter: name and unit of the one value a user may set, such as ``omega_ms`` or the count ``k``; None if
    there is none.
    value: that value.
    embedding: width of the embeddings it decides by (0: it needs none) and the name of their embedder (empty:
    any).
    """

    name: str
    parameter: str | None = None
    value: float | None = None
    embedding: tuple[int, str] = (0, "")

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        """value: value of ``parameter``; None keeps the default. rng: for policies that draw. Raises
        ValueError for a value out of range."""
        self._rng = rng
        if self.parameter is None or value is None:
            return
        if self.parameter == "k":
            if value < 1 or value % 1:  # of NaN and infinity the remainder is NaN
                raise ValueError(f"k: expected a whole number from 1, got {value:g}")
            self.value = int(value)
        else:
            if not 0 <= value <= LONGEST_MS:
                raise ValueError(f"{self.parameter}: expected 0 to {LONGEST_MS:.0f}, got {value:g}")
            self.value = float(value)

    @property
    def last_decision(self) -> Decision | None:
        """The newest decision of a learned policy; None before the first, and for all other policies."""
        return None

    def plan(self, epoch: Epoch) -> SelectionWindow:
        """By default, select at once from everything in the buffer."""
        return SelectionWindow()

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        """Cameras to use, at least one if any qualifies (K_t >= 1). Empty: keep waiting; ``select`` is called again
        when the next frame arrives.

        epoch: of this instant. window: as planned.
        """
        raise NotImplementedError
