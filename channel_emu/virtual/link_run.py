"""The simulated frames of one camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from channel_emu.model import ages
from channel_emu.model.link import EventKind

OUTCOMES = (
    "in_flight",
    *map(
        str,
        (
            EventKind.DELIVERED,
            EventKind.DROPPED_BUSY,
            EventKind.SUPERSEDED,
            EventKind.SKIPPED,
            EventKind.LOST,
            EventKind.BROKEN,
        ),
    ),
)
OUTCOME_CODES = {name: code for code, name in enumerate(OUTCOMES)}


@dataclass(frozen=True)
class LinkRun:
    """The simulated frames of one camera.

    offered_ns, started_ns, due_ns: int64 (n,); -1 if it did not happen.
    outcome: (n,), index into OUTCOMES.
    end_ns: end of the run.
    state_share: share of time in each state of the chain.
    duplicated: number of frames delivered twice.
    """

    camera: str
    offered_ns: NDArray[np.int64]
    outcome: NDArray[np.int8]
    started_ns: NDArray[np.int64]
    due_ns: NDArray[np.int64]
    end_ns: int
    state_share: list[float]
    duplicated: int = 0

    def count(self, outcome: str) -> int:
        """Number of frames with an outcome, one of OUTCOMES."""
        return int((self.outcome == OUTCOME_CODES[outcome]).sum())

    def sawtooth(self) -> ages.Sawtooth:
        """The age over time, counted from the capture, which in virtual time is the offer."""
        delivered = self.outcome == OUTCOME_CODES["delivered"]
        return ages.sawtooth(self.due_ns[delivered], self.offered_ns[delivered], self.end_ns)

    def delays_ms(self) -> NDArray[np.float64]:
        """The drawn delay of every frame that started and was due within the run."""
        done = (self.started_ns >= 0) & (self.due_ns <= self.end_ns)
        return (self.due_ns - self.started_ns)[done] / 1e6
