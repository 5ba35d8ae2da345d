"""How a deployment runs in virtual time: the pace of its updates, what they cost, and what is scored."""

from __future__ import annotations

from dataclasses import dataclass

from edge_server.live.live_constants import LEAST_TAKEN
from edge_server.settings import ComputeConfig

_FREE = ComputeConfig()


@dataclass(frozen=True)
class RunSettings:
    """How a deployment runs in virtual time.

    steps: optimizer steps of an update.
    compute: cost of an update in virtual time.
    epoch_ms: least time between two decisions.
    grace_ms: how long the first update waits for cameras that have not reported.
    score_every_ms: least time between two scored publications; None scores none.
    shown_every_ms: the image shown is scored at one seeded random instant in each such period; None: never.
    first_ms: instant of the first decision; later ones are whole numbers of epochs after it, so that policies
        that take different times decide at the same instants, with an epoch_ms. None: as soon as possible.
    scratch: every update starts with an empty field, as in the thesis.
    """

    steps: int
    compute: ComputeConfig = _FREE
    epoch_ms: float = 0.0
    grace_ms: float = 3000.0
    score_every_ms: float | None = 0.0
    shown_every_ms: float | None = None
    first_ms: float | None = None
    scratch: bool = False

    @property
    def most_new(self) -> int | None:
        """Largest number of frames that an update takes in, such that it lasts at most two epochs (but at
        least LEAST_TAKEN); None, if frames are not charged: all."""
        if not (self.epoch_ms and self.compute.ms_per_view):
            return None
        left_ms = 2.0 * self.epoch_ms - self.compute.ms_per_update - self.compute.ms_per_step * self.steps
        return max(int(left_ms / self.compute.ms_per_view), LEAST_TAKEN)

    def next_ns(self, decided_ns: int, done_ns: int, origin_ns: int) -> int:
        """Instant of the next decision, after one at ``decided_ns`` whose update is done at ``done_ns``.

        origin_ns: start of the run.
        """
        epoch_ns = round(self.epoch_ms * 1e6)
        if self.first_ms is None:
            return decided_ns + epoch_ns
        first_ns = origin_ns + round(self.first_ms * 1e6)
        # At least one epoch later, and not in the past.
        passed = max(decided_ns + 1, done_ns) - first_ns
        return first_ns + -(-passed // epoch_ns) * epoch_ns
