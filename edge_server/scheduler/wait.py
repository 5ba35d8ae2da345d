"""omega-wait (6.15-6.17): wait omega, then use the newest frame of each camera *generated* meanwhile.

The horizon is (t, t + omega] and ages are taken at its end. omega = 0 uses the buffer as it is (6.34). If
nothing qualifies at the end, the wait goes on until the first frame that does.

What is on its way at the decision blocks a link that serves one frame at a time, though it will not be used.
``wait-flush`` has it broken off: the thesis's reading (6.5: "no packets are considered in transit").
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_server.scheduler import Epoch, Plan, non_negative

DEFAULT_OMEGA_MS = 120.0


class Wait:
    name = "wait"
    parameter = "omega_ms"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self.value = non_negative(value, DEFAULT_OMEGA_MS, "omega_ms")

    def plan(self, epoch: Epoch) -> Plan:
        if self.value == 0:
            return Plan(epoch.now_ns, omega_ms=0.0)
        until = epoch.now_ns + round(self.value * 1e6)
        return Plan(epoch.now_ns, self.value, wait_until_ns=until, generated_after_ns=epoch.now_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        after = plan.generated_after_ns
        return tuple(c for c, g in epoch.generated_ns.items() if after is None or g > after)


class WaitFlush(Wait):
    name = "wait-flush"

    def plan(self, epoch: Epoch) -> Plan:
        plan = super().plan(epoch)
        return replace(plan, flush=plan.generated_after_ns is not None)
