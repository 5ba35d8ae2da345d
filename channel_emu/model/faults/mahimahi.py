"""A line that sends packets at recorded instants: Mahimahi's traces (Netravali et al., USENIX ATC 2015)."""

from __future__ import annotations

from bisect import bisect_left
from typing import Annotated

from channel_emu.model.link import Fault, Transit
from freshfield.settings import Settings, about

PACKET_BYTES = 1500


class Params(Settings, frozen=True):
    """At each instant PACKET_BYTES may be sent. The trace repeats after the last."""

    opportunities_ms: Annotated[list[int], about("ascending instants")]

    def __post_init__(self) -> None:
        times = self.opportunities_ms
        if not times or times[0] < 0 or times[-1] <= 0 or sorted(times) != times:
            raise ValueError("opportunities_ms: expected ascending instants, the last of them above 0")


class Mahimahi(Fault):
    """A frame is delivered with the last packet that it needs. Unused bytes of an opportunity are lost, and a
    preempted frame does not give its opportunities back."""

    by_size = True

    def __init__(self, params: Params, seed: int, camera: str) -> None:
        self.times_ns = [at * 10**6 for at in params.opportunities_ms]
        self._next = 0
        """Number of the first unused opportunity, counted over all repetitions of the trace."""

    def extra_ns(self, transit: Transit) -> int:
        start = transit.started_ns
        assert start is not None
        period, count = self.times_ns[-1], len(self.times_ns)
        rounds, within = divmod(start, period)
        first = max(self._next, rounds * count + bisect_left(self.times_ns, within))
        # The end of a period is the beginning of the next one.
        if within == 0 and rounds:
            first = max(self._next, rounds * count - self.times_ns.count(period))
        self._next = first + max(1, -(-transit.size_bytes // PACKET_BYTES))
        rounds, place = divmod(self._next - 1, count)
        return rounds * period + self.times_ns[place] - start
