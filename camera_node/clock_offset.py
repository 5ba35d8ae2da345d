"""Estimates the offset of the peer's clock from one small exchange a second, on the frames' channel."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from dataclasses import dataclass

import grpc
import grpc.aio

from camera_node import node_constants as tuned
from freshfield.clock import Clock
from freshfield.v1 import clock_pb2 as pb
from freshfield.v1 import clock_pb2_grpc as rpc

# 146 years. Real clocks differ at most by the time since 1970, and a frame's header can hold this much.
_MAX_OFFSET_NS = 2**62


@dataclass(frozen=True)
class Offset:
    """Estimate of another clock minus this one.

    uncertainty_ns: bound of the error: half the round trip of the exchange used, plus drift since then.
    """

    offset_ns: int
    uncertainty_ns: int


class OffsetEstimator:
    """NTP's estimate: the offset of the exchange with the smallest error bound among the last ``KEPT_OFFSETS``.

    The bound is half the round trip plus ``drift_ppm`` (parts per million) of the exchange's age, so the
    estimate follows a drifting clock. An exchange that contradicts it discards the earlier ones. Thread-safe.
    """

    def __init__(self, drift_ppm: float = tuned.OFFSET_DRIFT_PPM) -> None:
        self._samples: deque[tuple[int, int, int]] = deque(maxlen=tuned.KEPT_OFFSETS)
        self._drift = drift_ppm * 1e-6
        self._lock = threading.Lock()

    def add(self, sent_ns: int, received_ns: int, replied_ns: int, returned_ns: int) -> None:
        """Add one exchange; impossible ones are ignored.

        sent_ns, returned_ns: request sent and reply received, on this clock.
        received_ns, replied_ns: request received and reply sent, on the other clock.
        """
        round_trip = (returned_ns - sent_ns) - (replied_ns - received_ns)
        if round_trip < 0 or replied_ns < received_ns:
            return
        offset = ((received_ns - sent_ns) + (replied_ns - returned_ns)) // 2
        if abs(offset) > _MAX_OFFSET_NS:
            return
        known = self.estimate(returned_ns)
        with self._lock:
            # Beyond both bounds: one of the clocks was set, or stood still while its machine was suspended.
            if known is not None and abs(offset - known.offset_ns) > known.uncertainty_ns + round_trip // 2 + 1:
                self._samples.clear()
            self._samples.append((returned_ns, offset, round_trip // 2))

    def estimate(self, now_ns: int) -> Offset | None:
        """Best estimate at ``now_ns`` on this clock; None before the first exchange."""
        with self._lock:
            samples = list(self._samples)
        if not samples:
            return None

        def bound(sample: tuple[int, int, int]) -> int:
            return sample[2] + int(max(0, now_ns - sample[0]) * self._drift)

        best = min(samples, key=bound)
        return Offset(best[1], bound(best))


class ClockSync:
    """Measures the peer's clock minus ``clock`` while ``run`` is running.

    channel, metadata: of the calls to the peer.
    """

    def __init__(self, channel: grpc.aio.Channel, metadata: tuple[tuple[str, str], ...], clock: Clock) -> None:
        self._channel = channel
        self._metadata = metadata
        self._clock = clock
        self._estimator = OffsetEstimator()  # the first one is used from its first exchange on

    def offset(self) -> Offset | None:
        """The current estimate; None before the first answer."""
        return self._estimator.estimate(self._clock.now_ns())

    async def run(self) -> None:
        """Exchange times about once a second, until cancelled."""
        fresh, exchanges = self._estimator, 0
        while True:
            # A call made while the connection is being set up would include the set-up in its round trip.
            await self._channel.channel_ready()
            try:
                answered = await exchange(self._channel, self._metadata, self._clock, fresh, tuned.OFFSET_PERIOD_S)
            except (grpc.RpcError, grpc.aio.BaseError):
                answered = False  # the senders log what is wrong with the peer
            if answered:
                exchanges += 1
            else:
                # After a failed exchange the peer may be another process with another clock: start anew, but
                # use the old estimate until the new one has a few exchanges.
                fresh, exchanges = OffsetEstimator(), 0
            if exchanges == tuned.FIRST_OFFSETS:
                self._estimator = fresh
            first = 0 < exchanges < tuned.FIRST_OFFSETS
            await asyncio.sleep(tuned.FIRST_OFFSETS_PERIOD_S if first else tuned.OFFSET_PERIOD_S)


async def exchange(
    channel: grpc.aio.Channel,
    metadata: tuple[tuple[str, str], ...],
    clock: Clock,
    estimator: OffsetEstimator,
    timeout_s: float,
) -> bool:
    """Ask the peer for its time once, and add the exchange to ``estimator``.

    Returns whether the peer answered. Raises grpc.RpcError or grpc.aio.BaseError if the call fails.
    """
    sent = clock.now_ns()
    answer = await rpc.ClockServiceStub(channel).Exchange(
        pb.ExchangeRequest(client_sent_ns=sent), timeout=timeout_s, metadata=metadata
    )
    if answer is None or answer.client_sent_ns != sent:
        return False
    estimator.add(sent, answer.server_received_ns, answer.server_sent_ns, clock.now_ns())
    return True
