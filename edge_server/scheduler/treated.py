"""A policy whose chosen views are treated before they supervise: ``threshold+mask``, ``wait+freshen``.

The part before the + decides as it always does; the part after it is one of ``edge_server.treatments``.
"""

from __future__ import annotations

from edge_server.scheduler import Epoch, Plan, Policy
from edge_server.treatments import Treatment


class Treated:
    """``policy`` as it is, with a treatment for the views that it selects. name: as it was asked for."""

    def __init__(self, name: str, policy: Policy, treatment: Treatment) -> None:
        self.name = name
        self.policy = policy
        self.treatment = treatment

    @property
    def parameter(self) -> str | None:
        return self.policy.parameter

    @property
    def value(self) -> float | None:
        return self.policy.value

    def plan(self, epoch: Epoch) -> Plan:
        return self.policy.plan(epoch)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        return self.policy.select(epoch, plan)
