"""Fixed policies that look at the frames in the buffer and at nothing else."""

from __future__ import annotations

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow


class UseAll(Policy):
    """Use all: every camera's newest frame, however old. The most views, and the highest age."""

    name = "all"

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return tuple(epoch.generated_ns)


class FreshestK(Policy):
    """Freshest-k: a fixed number of views, the youngest ones."""

    name = "freshest-k"
    parameter = "k"
    value: int = 6

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return freshest(epoch, self.value)


class RoundRobin(Policy):
    """Round-robin: the next k cameras in turn, whether their frames are fresh or not."""

    name = "round-robin"
    parameter = "k"
    value: int = 6
    _next = 0

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        cameras = tuple(epoch.generated_ns)
        if not cameras:
            return ()
        count = min(self.value, len(cameras))
        chosen = {(self._next + i) % len(cameras) for i in range(count)}
        self._next = (self._next + count) % len(cameras)
        return tuple(c for i, c in enumerate(cameras) if i in chosen)


class RandomSubset(Policy):
    """Random subset: uniform over non-empty subsets or, with a value, over subsets of k cameras. A baseline that
    the thesis's figures lack."""

    name = "random"
    parameter = "k"
    value: int | None = None

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        cameras = tuple(epoch.generated_ns)
        if not cameras:
            return ()
        if self.value is not None:
            count = min(self.value, len(cameras))
            chosen = set(self._rng.choice(len(cameras), size=count, replace=False).tolist())
            return tuple(c for i, c in enumerate(cameras) if i in chosen)
        while True:  # redrawing the empty set keeps the others equally likely
            keep = self._rng.random(len(cameras)) < 0.5
            if keep.any():
                return tuple(c for c, k in zip(cameras, keep) if k)


class AgeDriven(Policy):
    """Age-driven: minimize only the mean age of the admitted set (6.35).

    The mean is smallest for the single youngest view (K_t >= 1), so the set is that view and every one of the
    same age. The comparison shows how many views a purely age-optimal scheduler gives up.
    """

    name = "age-driven"

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        if not epoch.generated_ns:
            return ()
        youngest = max(epoch.generated_ns.values())
        return tuple(c for c, generated in epoch.generated_ns.items() if generated == youngest)


class Threshold(Policy):
    """omega-threshold (6.12-6.14): at every epoch, the newest frame of each camera that is no older than
    omega."""

    name = "threshold"
    parameter = "omega_ms"
    value: float = 120.0

    def plan(self, epoch: Epoch) -> SelectionWindow:
        return SelectionWindow(omega_ms=self.value)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return within_threshold(epoch, self.value)


class Periodic(UseAll):
    """Periodic: use all views, but only at multiples of a period, as most systems do today."""

    name = "periodic"
    parameter = "period_ms"
    value: float = 1000.0

    def plan(self, epoch: Epoch) -> SelectionWindow:
        """Wait for the next multiple of the period. A multiple that passed during the last fit is skipped."""
        period_ns = round(self.value * 1e6)
        if period_ns == 0:
            return SelectionWindow()
        return SelectionWindow(wait_until_ns=-(-epoch.now_ns // period_ns) * period_ns)


def freshest(epoch: Epoch, count: int) -> tuple[str, ...]:
    """The ``count`` cameras with the youngest frames; ties are broken by the cameras' order."""
    order = sorted(epoch.generated_ns, key=lambda c: -epoch.generated_ns[c])
    chosen = set(order[:count])
    return tuple(c for c in epoch.generated_ns if c in chosen)


def within_threshold(epoch: Epoch, omega_ms: float) -> tuple[str, ...]:
    """Cameras whose newest frame is at most ``omega_ms`` old; if there is none, the freshest (K_t >= 1)."""
    young = tuple(c for c in epoch.generated_ns if epoch.age_ms(c) <= omega_ms)
    return young or freshest(epoch, 1)
