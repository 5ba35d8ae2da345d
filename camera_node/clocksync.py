"""Keeps an estimate of the peer's clock: one small exchange a second on the channel of the frames."""

from __future__ import annotations

import asyncio

import grpc
import grpc.aio

from freshfield.clock import Clock, Offset, OffsetEstimator
from freshfield.v1 import clock_pb2 as pb
from freshfield.v1 import clock_pb2_grpc as rpc

PERIOD_S = 1.0
# The first exchanges follow one another closely, so that early frames get a good estimate too.
_FIRST = 4
_FIRST_PERIOD_S = 0.05


class ClockSync:
    """``offset()`` is the peer's clock minus ``clock``, or None before the first answer."""

    def __init__(
        self, channel: grpc.aio.Channel, metadata: tuple[tuple[str, str], ...], clock: Clock
    ) -> None:
        self._channel = channel
        self._metadata = metadata
        self._clock = clock
        self._estimator = OffsetEstimator()  # the first one is used from its first exchange on

    def offset(self) -> Offset | None:
        return self._estimator.estimate(self._clock.now_ns())

    async def run(self) -> None:
        """Until cancelled."""
        fresh, exchanges = self._estimator, 0
        while True:
            # A call made while the connection is being set up would count that as a round trip.
            await self._channel.channel_ready()
            try:
                answered = await exchange(self._channel, self._metadata, self._clock, fresh, PERIOD_S)
            except (grpc.RpcError, grpc.aio.BaseError):
                answered = False  # the senders log what is wrong with the peer
            if answered:
                exchanges += 1
            else:
                # After a silence the peer may be another process with another clock: start afresh, but
                # keep to the old estimate until the new one rests on a few exchanges.
                fresh, exchanges = OffsetEstimator(), 0
            if exchanges == _FIRST:
                self._estimator = fresh
            await asyncio.sleep(_FIRST_PERIOD_S if 0 < exchanges < _FIRST else PERIOD_S)


async def exchange(
    channel: grpc.aio.Channel,
    metadata: tuple[tuple[str, str], ...],
    clock: Clock,
    estimator: OffsetEstimator,
    timeout_s: float,
) -> bool:
    """Ask the peer for its time once; whether it answered. Raises grpc.RpcError, and grpc.aio.BaseError."""
    sent = clock.now_ns()
    answer = await rpc.ClockServiceStub(channel).Exchange(
        pb.ExchangeRequest(client_sent_ns=sent), timeout=timeout_s, metadata=metadata
    )
    if answer is None or answer.client_sent_ns != sent:
        return False
    estimator.add(sent, answer.server_received_ns, answer.server_sent_ns, clock.now_ns())
    return True
