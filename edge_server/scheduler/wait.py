"""omega-wait (6.15-6.17): wait omega, then use each newest frame that was generated, or arrived, meanwhile.

The horizon is (t, t + omega] and ages are taken at its end. omega = 0 uses the current buffer (6.34). If no frame
qualifies at the end, the wait continues until the first one does. The thesis has two readings of what qualifies:
frames *generated* in the horizon (6.5: ``wait``), or those that *arrive* in it, however old (6.16 and algorithm 2:
``wait-arrived``).

A frame in transit at the decision blocks a link that serves one frame at a time, though ``wait`` will not use
it. ``wait-flush`` aborts it (6.5: "no packets are considered in transit"), and then both readings are the
same.
"""

from __future__ import annotations

from dataclasses import replace

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow


class Wait(Policy):
    """Wait omega, then use the newest frames that were generated meanwhile (6.5)."""

    name = "wait"
    parameter = "omega_ms"
    value: float = 120.0

    def plan(self, epoch: Epoch) -> SelectionWindow:
        return wait_window(epoch.now_ns, self.value)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return qualified(epoch, window)


class WaitArrived(Wait):
    """Wait omega, then use the newest frames that arrived meanwhile, however old (6.16)."""

    name = "wait-arrived"

    def plan(self, epoch: Epoch) -> SelectionWindow:
        return wait_window(epoch.now_ns, self.value, arrived=True)


class WaitFlush(Wait):
    """``Wait``, after aborting what is in transit at the decision (6.5); virtual time only."""

    name = "wait-flush"

    def plan(self, epoch: Epoch) -> SelectionWindow:
        window = super().plan(epoch)
        return replace(window, flush=window.generated_after_ns is not None)


def wait_window(now_ns: int, omega_ms: float, arrived: bool = False) -> SelectionWindow:
    """The horizon (now, now + omega]; omega = 0 admits the current buffer at once. arrived: whether frames that
    arrive in it are admitted, rather than those generated in it."""
    if omega_ms == 0.0:
        return SelectionWindow(omega_ms=0.0)
    until_ns = now_ns + round(omega_ms * 1e6)
    if arrived:
        return SelectionWindow(omega_ms, until_ns, received_after_ns=now_ns)
    return SelectionWindow(omega_ms, until_ns, generated_after_ns=now_ns)


def qualified(epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
    """Cameras whose newest frame falls into the window; all if it admits all."""
    if (after := window.received_after_ns) is not None:
        return tuple(c for c, received in epoch.received_ns.items() if received > after)
    after = window.generated_after_ns
    return tuple(c for c, generated in epoch.generated_ns.items() if after is None or generated > after)
