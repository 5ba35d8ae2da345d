"""Makes links from a configuration and a seed, with the chain and the server that they share."""

from __future__ import annotations

from channel_emu.model import faults
from channel_emu.model.chain import Chain
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.faults import per_state
from channel_emu.model.link import Link
from channel_emu.model.queue_server import QueueServer
from channel_emu.model.service_time import ServiceTime, WorkSampler, exponential, gamma, lognormal, replayed
from channel_emu.model.settings import ChannelConfig
from channel_emu.model.traffic import PoissonArrivals


class Channel:
    """Makes the links of one deployment. A camera's random numbers depend on its name alone."""

    def __init__(self, config: ChannelConfig, seed: int) -> None:
        self.config = config
        self.seed = seed
        self.chain = self._chain("") if config.chain is not None and config.chain.scope == "shared" else None
        self._server = QueueServer(config.queue_limit) if config.server.shared else None

    def chain_of(self, camera: str) -> Chain | None:
        """A new chain if the scope is per-camera, else the shared one; None if the channel has no chain."""
        own = self.config.chain is not None and self.config.chain.scope == "per-camera"
        return self._chain(camera) if own else self.chain

    def link(self, camera: str, *, sampled: bool = True) -> Link:
        """Make the link of a camera. Raises ValueError for a second link of a camera to a shared server.

        sampled: the arrival process samples the offered frames. False: every offer is an arrival, because the
            caller offers frames at the instants of the arrival process.
        """
        chain = self.chain_of(camera)
        arrivals = self.arrivals(camera, chain) if sampled else None
        return Link(
            camera,
            self.config.discipline,
            self.service(camera, chain),
            arrivals,
            faults.make(self.config.faults, self.seed, camera) if self.config.faults else (),
            self._server or QueueServer(self.config.queue_limit),
        )

    def forget(self, before_ns: int) -> None:
        """Drop the shared chain's path before an instant."""
        if self.chain is not None:
            self.chain.forget(before_ns)

    def arrivals(self, camera: str, chain: Chain | None) -> PoissonArrivals | None:
        """The camera's Poisson arrival process; None if frames arrive as they are offered."""
        rates = self.config.arrivals.rate_per_ms
        if rates is None:
            return None
        return PoissonArrivals(per_state(rates), chain, CounterRng(self.seed, camera, "channel.arrivals"))

    def service(self, camera: str, chain: Chain | None) -> ServiceTime:
        """The camera's service times. chain: as ``chain_of`` returned it."""
        config = self.config.service
        means = [1.0] if config.mean_ms is None else per_state(config.mean_ms)
        modulated = self.config.service_state == "modulated"
        return ServiceTime(
            self._work_sampler(CounterRng(self.seed, camera, "channel.service")), means, chain, modulated
        )

    def _work_sampler(self, rng: CounterRng) -> WorkSampler:
        config = self.config.service
        if config.law == "exponential":
            return exponential(rng)
        if config.law == "gamma" and config.shape is not None:
            return gamma(rng, config.shape)
        if config.law == "lognormal" and config.sigma is not None:
            return lognormal(rng, config.sigma)
        return replayed(config.delays_ms or [0.0 if config.law == "none" else 1.0])

    def _chain(self, camera: str) -> Chain:
        config = self.config.chain
        assert config is not None
        initial = None if config.initial is None else config.names().index(config.initial)
        rng = CounterRng(self.seed, camera, "channel.chain")
        return Chain(config.generator(), rng, initial)
