"""Age-driven: select what minimizes the mean age of the admitted set (6.35), nothing else.

The mean is smallest for the single youngest view (K_t >= 1), so the set is that view and every one of the
same age. The comparison shows how many views a purely age-optimal scheduler gives up.
"""

from __future__ import annotations

import numpy as np

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow


class AgeDriven(Policy):
    name = "age-driven"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del value, rng  # no parameter, no randomness

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        if not epoch.generated_ns:
            return ()
        youngest = max(epoch.generated_ns.values())
        return tuple(c for c, generated in epoch.generated_ns.items() if generated == youngest)
