"""omega-wait (6.15-6.17): wait omega, then use each newest frame that was generated, or arrived, meanwhile.

The horizon is (t, t + omega] and ages are taken at its end. omega = 0 uses the buffer as it is (6.34). If
nothing qualifies at the end, the wait goes on until the first frame that does. The thesis has two readings of
what qualifies: frames *generated* in the horizon (6.5: ``wait``), or those that *arrive* in it, however old
(6.16 and algorithm 2: ``wait-arrived``).

A frame in transit at the decision blocks a link that serves one frame at a time, though ``wait`` will not use it; the
thesis considers none in transit (6.5).
"""

from __future__ import annotations

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow


class Wait(Policy):
    """Wait omega, then use the newest frames that were generated meanwhile (6.5)."""

    name = "wait"
    parameter = "omega_ms"
    value: float = 120.0
    arrived = False

    def plan(self, epoch: Epoch) -> SelectionWindow:
        return wait_window(epoch.now_ns, self.value, self.arrived)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return qualified(epoch, window)


class WaitArrived(Wait):
    """Wait omega, then use the newest frames that arrived meanwhile, however old (6.16)."""

    name = "wait-arrived"
    arrived = True


def wait_window(now_ns: int, omega_ms: float, arrived: bool = False) -> SelectionWindow:
    """The horizon (now, now + omega]; omega = 0 admits the buffer as it is, at once. arrived: whether frames
    that arrive in it are admitted, rather than those generated in it."""
    if omega_ms == 0.0:
        return SelectionWindow(omega_ms=0.0)
    until_ns = now_ns + round(omega_ms * 1e6)
    if arrived:
        return SelectionWindow(omega_ms, until_ns, received_after_ns=now_ns)
    return SelectionWindow(omega_ms, until_ns, generated_after_ns=now_ns)


def qualified(epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
    """Cameras whose newest frame falls into the window; all where it admits all."""
    if (after := window.received_after_ns) is not None:
        return tuple(c for c, received in epoch.received_ns.items() if received > after)
    after = window.generated_after_ns
    return tuple(c for c, generated in epoch.generated_ns.items() if after is None or generated > after)
