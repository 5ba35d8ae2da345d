"""The pytest fixture ``channel``: a bad network for your tests.

It needs only pytest besides freshfield (``pip install freshfield[test]``), which finds the fixture by itself. Where
freshfield is only on the path, write ``pytest_plugins = ["channel_emu.testing"]`` in the ``conftest.py`` at the root of
your tests, or ``from channel_emu.testing import channel`` in the test's module. A test then puts any gRPC service
behind a seeded link, talks to ``link.address`` instead of the service, and asserts on the report::

    def test_positions_stay_fresh(channel):
        server = grpc.server(ThreadPoolExecutor())          # your own service, as it is
        add_TrackerServicer_to_server(Tracker(), server)
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()

        link = channel("ch5", to=f"127.0.0.1:{port}", seed=1)
        with grpc.insecure_channel(link.address) as to_server:
            stub = TrackerStub(to_server)
            stub.Follow(positions(every_s=0.03, count=200))  # a stream: dropped messages are left out
        report = link.settle()
        assert report.mean_age_ms < 200
        assert 0.3 < report.dropped / report.offered < 0.8

    def test_the_client_retries(channel, service):
        link = channel({"faults": {"loss": {"probability": 0.5}}}, to=service, seed=3)
        ...                                                  # a dropped unary call answers UNAVAILABLE

The first argument is a preset (``ideal``, ``ch5``, ``ch6``, ...), a mapping as in a scenario's ``channel:``
section, or a ``ChannelConfig``. The same seed gives the same decisions for messages offered at the same
instants. When a test fails, pytest shows each link's seed and statistics in a section of their own.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from channel_emu import emulator_constants as tuned
from channel_emu.live.proxy import Proxy, ProxyOptions
from channel_emu.live.report import Report, show
from channel_emu.model.settings import ChannelConfig, channel_from_mapping
from channel_emu.pytest_plugin import channel
from freshfield.transport import peer

__all__ = ["EmulatedLink", "channel"]

T = TypeVar("T")


class EmulatedLink:
    """A running proxy in front of one service, with an event loop in its own thread. Close it after use.

    channel: a preset's name, a ``channel:`` section, or a configuration.
    to: HOST:PORT of the service.
    seed: of the link's decisions.
    direction: the messages that pass the link: up (to the service), down (its answers) or both.
    Raises ScenarioError or TransportError (both ValueErrors) with one line that says what to change.

    ``address`` is HOST:PORT to which clients connect.
    """

    def __init__(
        self, channel: str | dict[str, Any] | ChannelConfig, *, to: str, seed: int = 0, direction: str = "up"
    ) -> None:
        section: Any = {"preset": channel} if isinstance(channel, str) else channel
        self.config = section if isinstance(section, ChannelConfig) else channel_from_mapping(section)
        self.seed = seed
        self.options = ProxyOptions("127.0.0.1:0", peer("to", to), direction=direction)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="channel", daemon=True)
        self._thread.start()
        self._last: Report | None = None
        try:
            self._proxy = self._await(self._start())
        except BaseException:
            self._end()
            raise
        self.address = f"127.0.0.1:{self._proxy.port}"

    def report(self) -> Report:
        """Ages, losses and delays so far, in total and by method; after ``close`` the last report. Raises
        EmulatorFailed if the proxy failed."""
        return self._last or self._await(self._report(checked=True))

    def settle(self, timeout_s: float = tuned.SETTLE_S) -> Report:
        """Wait until no message is inside the link, then report. Raises TimeoutError, EmulatorFailed."""
        try:
            self._await(asyncio.wait_for(self._proxy.settled(), timeout_s), timeout_s + tuned.PATIENCE_S)
        except TimeoutError:
            inside = self.report().in_flight + self._proxy.pending
            raise TimeoutError(
                f"{inside} messages are still inside the link, or wait for their reader, after {timeout_s:g} s"
            ) from None
        return self.report()

    def close(self) -> None:
        """Stop the proxy and end open calls. A second call does nothing."""
        if self._last is None:
            try:
                self._last = self._await(self._report(checked=False))
                self._await(self._proxy.stop())
            finally:
                self._end()

    def describe(self) -> str:
        """Text with the call that makes the same link again, and with the report of this one."""
        report = self._last or self._await(self._report(checked=False))
        preset, to, direction = self.config.preset, self.options.to, self.options.direction
        plain = preset is not None and channel_from_mapping({"preset": preset}) == self.config
        channel = preset if plain else _without_none(self.config.to_mapping())
        return f"channel({channel!r}, {to=!r}, seed={self.seed}, {direction=!r})\n{show(report)}"

    async def _start(self) -> Proxy:
        proxy = Proxy(self.config, self.seed, self.options)
        await proxy.start()
        return proxy

    async def _report(self, checked: bool) -> Report:
        if checked:
            self._proxy.check()
        return self._proxy.report()

    def _await(self, work: Coroutine[Any, Any, T], patience_s: float = tuned.PATIENCE_S) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(patience_s)

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(tuned.PATIENCE_S)
        self._loop.close()


def _without_none(value: Any) -> Any:
    """Mappings at any depth without the keys that are None."""
    if not isinstance(value, dict):
        return value
    return {key: _without_none(inner) for key, inner in value.items() if inner is not None}
