"""Age-driven: what minimises the mean age of the admitted set (6.35), nothing else.

The mean is smallest for the single youngest view (K_t >= 1), so the set is that view and every one of the
same age: what a purely age-optimal scheduler gives up in views is the point of the comparison.
"""

from __future__ import annotations

import numpy as np

from edge_server.scheduler import Epoch, Plan


class AgeDriven:
    name = "age-driven"
    parameter = None
    value: float | None = None

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del value, rng

    def plan(self, epoch: Epoch) -> Plan:
        return Plan(epoch.now_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        if not epoch.generated_ns:
            return ()
        youngest = max(epoch.generated_ns.values())
        return tuple(c for c, generated in epoch.generated_ns.items() if generated == youngest)
