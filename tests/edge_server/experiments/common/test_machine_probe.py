"""What the limits are measured with: that each probe does the arithmetic it is credited with."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.experiments.common.machine_probe import CHAINED, CHAINS, TASKS, arithmetic
from edge_server.fields.common.threads.thread_pool import CallerPool


@pytest.mark.parametrize("n", range(len(CHAINS)))
def test_a_probe_ends_where_its_chains_lead(n: int) -> None:
    lanes, multiply_adds, additions = CHAINS[n]
    out = np.zeros(1, np.float32)
    CallerPool().run(arithmetic[n], out)
    begun = np.arange(multiply_adds + additions) + 2.0
    ends = np.where(np.arange(begun.size) < multiply_adds, 1.0, begun + 0.5 * CHAINED)
    assert out[0] == pytest.approx(TASKS * lanes * ends.sum(), rel=1e-3)
