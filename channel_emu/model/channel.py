"""From a configuration and a seed to links: who shares a chain, and which stream each draw comes from."""

from __future__ import annotations

from channel_emu.model import faults
from channel_emu.model.chain import Chain
from channel_emu.model.config import ChannelConfig, per_state
from channel_emu.model.counter_rng import Uniforms
from channel_emu.model.link import Link
from channel_emu.model.queue_server import Server
from channel_emu.model.service_time import (
    NoService,
    Service,
    Shape,
    deterministic,
    exponential,
    gamma,
    lognormal,
    recorded,
)
from channel_emu.model.traffic import PoissonArrivals


class Channel:
    """All links of one deployment. ``link(camera)`` makes a camera's; the name alone decides its draws."""

    def __init__(self, config: ChannelConfig, seed: int) -> None:
        self.config = config
        self.seed = seed
        self.chain = self._chain("") if config.chain is not None and config.chain.scope == "shared" else None
        self._server = Server(config.server.order, config.queue_limit) if config.server.shared else None

    def chain_of(self, camera: str) -> Chain | None:
        """A fresh chain of the camera's own where each has one, else the shared one (None: one state)."""
        own = self.config.chain is not None and self.config.chain.scope == "per-camera"
        return self._chain(camera) if own else self.chain

    def link(self, camera: str, *, sampled: bool = True) -> Link:
        """A fresh link. ``sampled=False``: frames are offered at the arrivals of the arrival process itself,
        so the link takes each as it comes. Links of a shared server serve the cameras they were made for:
        make one for each camera."""
        chain = self.chain_of(camera)
        arrivals = self.arrivals(camera, chain) if sampled else None
        return Link(
            camera,
            self.config.discipline,
            self.service(camera, chain),
            arrivals,
            faults.make(self.config.faults, self.seed, camera) if self.config.faults else (),
            self._server or Server(queue_limit=self.config.queue_limit),
        )

    def forget(self, before_ns: int) -> None:
        """Drop the shared chain's path before an instant."""
        if self.chain is not None:
            self.chain.forget(before_ns)

    def arrivals(self, camera: str, chain: Chain | None) -> PoissonArrivals | None:
        rates = self.config.arrivals.rate_per_ms
        if rates is None:
            return None
        return PoissonArrivals(per_state(rates), chain, Uniforms(self.seed, camera, "channel.arrivals"))

    def service(self, camera: str, chain: Chain | None) -> Service | NoService:
        config = self.config.service
        if config.law == "none":
            return NoService(chain)
        means = [1.0] if config.mean_ms is None else per_state(config.mean_ms)
        modulated = self.config.service_state == "modulated"
        return Service(self._shape(Uniforms(self.seed, camera, "channel.service")), means, chain, modulated)

    def _shape(self, uniforms: Uniforms) -> Shape:
        config = self.config.service
        if config.law == "exponential":
            return exponential(uniforms)
        if config.law == "gamma":
            assert config.shape is not None
            return gamma(uniforms, config.shape)
        if config.law == "lognormal":
            assert config.sigma is not None
            return lognormal(uniforms, config.sigma)
        if config.law == "trace":
            assert config.delays_ms is not None
            return recorded(config.delays_ms)
        return deterministic()

    def _chain(self, camera: str) -> Chain:
        config = self.config.chain
        assert config is not None
        initial = None if config.initial is None else config.names().index(config.initial)
        uniforms = Uniforms(self.seed, camera, "channel.chain")
        return Chain(config.generator(), uniforms, initial, config.slot_ms)
