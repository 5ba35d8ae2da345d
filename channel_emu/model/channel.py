"""Makes links from a configuration and a seed, with the chain and the server that they share."""

from __future__ import annotations

from msgspec.structs import replace

from channel_emu.model import faults
from channel_emu.model.chain import Chain
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.faults import per_state
from channel_emu.model.link import Event, Fault, Link
from channel_emu.model.queue_server import QueueServer
from channel_emu.model.service_time import ServiceTime, WorkSampler, exponential, gamma, lognormal, replayed
from channel_emu.model.settings import ArrivalsConfig, ChannelConfig, ServiceConfig
from channel_emu.model.traffic import PoissonArrivals


class Channel:
    """Makes the links of one deployment. A camera's random numbers depend on its name alone."""

    def __init__(self, config: ChannelConfig, seed: int) -> None:
        self.config = config
        self.seed = seed
        self.chain = self._chain("") if config.chain is not None and config.chain.scope == "shared" else None
        self._server = QueueServer(config.queue_limit) if config.server.shared else None
        self.by_hand: tuple[float, float] | None = None
        """Mean delay (ms) and loss that an operator has set; None: the scenario's channel applies."""
        self._in_force = config

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
            self._faults(camera),
            self._server or QueueServer(self.config.queue_limit),
        )

    def set_by_hand(self, delay_ms: float, loss: float) -> None:
        """Give links, once they ``change``, these delays and losses instead of the scenario's channel.

        delay_ms: mean; the distribution's shape stays (none: every delay is the mean). loss: probability.
        Frames enter as they are offered, and all other faults are off. Chain, discipline and server stay.
        """
        service = self.config.service
        spread = service.law not in ("none", "trace")
        self.by_hand = delay_ms, loss
        self._in_force = replace(
            self.config,
            arrivals=ArrivalsConfig(),
            service=replace(service, mean_ms=delay_ms) if spread else ServiceConfig("deterministic", mean_ms=delay_ms),
            faults={"loss": faults.params_class("loss")(loss)} if loss > 0.0 else {},
        )

    def set_by_scenario(self) -> None:
        """End ``set_by_hand``."""
        self.by_hand, self._in_force = None, self.config

    def change(self, link: Link, at_ns: int) -> list[Event]:
        """Apply the current channel to a link from ``at_ns`` on. Returns its events up to then."""
        return link.change(
            at_ns,
            self.service(link.camera, link.chain),
            self.arrivals(link.camera, link.chain),
            self._faults(link.camera),
        )

    def arrivals(self, camera: str, chain: Chain | None) -> PoissonArrivals | None:
        """The camera's Poisson arrival process; None if frames arrive as they are offered."""
        rates = self._in_force.arrivals.rate_per_ms
        if rates is None:
            return None
        return PoissonArrivals(per_state(rates), chain, CounterRng(self.seed, camera, "channel.arrivals"))

    def service(self, camera: str, chain: Chain | None) -> ServiceTime:
        """The camera's service times. chain: as ``chain_of`` returned it."""
        config = self._in_force.service
        means = [1.0] if config.mean_ms is None else per_state(config.mean_ms)
        modulated = self.config.service_state == "modulated"
        return ServiceTime(
            self._work_sampler(CounterRng(self.seed, camera, "channel.service")), means, chain, modulated
        )

    def _work_sampler(self, rng: CounterRng) -> WorkSampler:
        config = self._in_force.service
        if config.law == "exponential":
            return exponential(rng)
        if config.law == "gamma" and config.shape is not None:
            return gamma(rng, config.shape)
        if config.law == "lognormal" and config.sigma is not None:
            return lognormal(rng, config.sigma)
        return replayed(config.delays_ms or [0.0 if config.law == "none" else 1.0])

    def _faults(self, camera: str) -> tuple[Fault, ...]:
        listed = self._in_force.faults
        return faults.make(listed, self.seed, camera) if listed else ()

    def _chain(self, camera: str) -> Chain:
        config = self.config.chain
        assert config is not None
        initial = None if config.initial is None else config.names().index(config.initial)
        rng = CounterRng(self.seed, camera, "channel.chain")
        return Chain(config.generator(), rng, initial)
