"""A policy whose selected views are treated before they supervise: ``threshold+mask``, ``wait+freshen``.

The part before the + decides as it always does; the part after it is one of ``edge_server.treatments``.
"""

from __future__ import annotations

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow
from edge_server.treatments import Treatment


class Treated(Policy):
    """``policy`` with a treatment for the views that it selects. name: as the user wrote it."""

    def __init__(self, name: str, policy: Policy, treatment: Treatment) -> None:
        self.name, self.policy, self.treatment = name, policy, treatment
        self.parameter, self.value = policy.parameter, policy.value

    def plan(self, epoch: Epoch) -> SelectionWindow:
        return self.policy.plan(epoch)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return self.policy.select(epoch, window)
