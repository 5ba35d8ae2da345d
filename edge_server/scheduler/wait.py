"""omega-wait (6.15-6.17): wait omega, then use the newest frame of each camera *generated* meanwhile.

The horizon is (t, t + omega] and ages are taken at its end. omega = 0 uses the buffer as it is (6.34). If
nothing qualifies at the end, the wait goes on until the first frame that does.

A frame in transit at the decision blocks a link that serves one frame at a time, though it will not be used.
``wait-flush`` aborts it: the thesis's reading (6.5: "no packets are considered in transit").
"""

from __future__ import annotations

from dataclasses import replace

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow


class Wait(Policy):
    name = "wait"
    parameter = "omega_ms"
    value: float = 120.0

    def plan(self, epoch: Epoch) -> SelectionWindow:
        return wait_window(epoch.now_ns, self.value)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return generated_in(epoch, window)


class WaitFlush(Wait):
    name = "wait-flush"

    def plan(self, epoch: Epoch) -> SelectionWindow:
        window = super().plan(epoch)
        return replace(window, flush=window.generated_after_ns is not None)


def wait_window(now_ns: int, omega_ms: float) -> SelectionWindow:
    """The horizon (now, now + omega]; omega = 0 admits the buffer as it is, at once."""
    if omega_ms == 0.0:
        return SelectionWindow(omega_ms=0.0)
    return SelectionWindow(omega_ms, wait_until_ns=now_ns + round(omega_ms * 1e6), generated_after_ns=now_ns)


def generated_in(epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
    """Cameras whose newest frame was generated after the window opened; all where it admits all."""
    after = window.generated_after_ns
    return tuple(c for c, generated in epoch.generated_ns.items() if after is None or generated > after)
