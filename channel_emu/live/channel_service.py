"""What an operator may change while the emulator runs: mean delay and loss of every link."""

from __future__ import annotations

import logging
from collections import deque
from typing import TYPE_CHECKING, Any

import grpc
import grpc.aio

from channel_emu.live.live_emulator_constants import MAX_CHANNEL_CHANGES, MAX_SET_DELAY_MS
from freshfield.v1 import channel_pb2, channel_pb2_grpc

if TYPE_CHECKING:
    from channel_emu.live.proxy import Proxy

log = logging.getLogger("channel-emu")


class ChannelService(channel_pb2_grpc.ChannelServiceServicer):
    """Serves ``SetChannel`` of a proxy."""

    def __init__(self, proxy: Proxy) -> None:
        self._proxy = proxy
        self.changes: deque[dict[str, Any]] = deque(maxlen=MAX_CHANNEL_CHANGES)
        """Oldest first: {at_ns: on the emulator's clock, delay_ms, loss}; the latter two are None if the scenario's
        channel was restored."""

    async def SetChannel(
        self, request: channel_pb2.SetChannelRequest, context: grpc.aio.ServicerContext
    ) -> channel_pb2.SetChannelResponse:
        proxy, channel = self._proxy, self._proxy.channel
        delay_ms, loss = request.delay_ms, request.loss
        code, problem = grpc.StatusCode.INVALID_ARGUMENT, ""
        if proxy.options.replay is not None:
            code = grpc.StatusCode.FAILED_PRECONDITION
            problem = "the emulator replays a recorded trace, which fixes delays and losses: start it without --replay"
        elif not 0.0 <= delay_ms <= MAX_SET_DELAY_MS:
            problem = f"expected a delay of 0 to {MAX_SET_DELAY_MS:g} ms, got {delay_ms:g} ms"
        elif not 0.0 <= loss <= 1.0:
            problem = f"expected a loss of 0 to 1, got {loss:g}"
        if problem:
            context.set_code(code)
            context.set_details(problem)
        else:
            if request.HasField("delay_ms") or request.HasField("loss"):
                channel.set_by_hand(delay_ms, loss)
            else:
                channel.set_by_scenario()
            for link in proxy.links.values():
                link.change(channel, proxy.events.now_ns())
            in_force = channel.by_hand or (None, None)
            self.changes.append({"at_ns": proxy.clock.now_ns(), "delay_ms": in_force[0], "loss": in_force[1]})
            log.info("an operator set the channel: %s", self.changes[-1])
        return channel_pb2.SetChannelResponse()
