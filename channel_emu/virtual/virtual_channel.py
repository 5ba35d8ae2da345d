"""A channel as the library has it (``freshfield.Channel``)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu import emulator_constants as tuned
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import Simulation, simulate


class VirtualChannel:
    """A channel as a library has it: ages and deliveries of its cameras as arrays, from one seed.

    config: the channel, with all defaults.
    cameras, seed, frame_period_ms: see ``simulate``.
    """

    def __init__(
        self,
        preset: str = "ideal",
        *,
        cameras: int | list[str] = 1,
        seed: int = 0,
        frame_period_ms: float | None = None,
        **section: Any,
    ) -> None:
        """preset: name of a channel (``channel-emu presets``). section: keys of a scenario's ``channel:`` in place of
        the preset's, in short or full notation: ``service="exp:60ms"``, ``arrivals="periodic:30ms"``,
        ``discipline="newest-waits"``, ``faults={"loss": 0.1}``. Raises ScenarioError for an unknown preset or key."""
        self.config = channel_from_mapping({"preset": preset, **section})
        self.cameras, self.seed, self.frame_period_ms = cameras, seed, frame_period_ms
        self._simulated = lru_cache(maxsize=1)(self._simulate)

    def ages(
        self, seconds: float, every_ms: float = tuned.AGES_EVERY_MS
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The sawtooth of ages: instants (T,) in seconds, and ages (cameras, T) in milliseconds, see
        ``Simulation.ages_ms``. Raises SimulationError."""
        return self.simulate(seconds).ages_ms(every_ms)

    def deliveries(self, seconds: float) -> dict[str, NDArray[np.float64]]:
        """Camera -> (n, 2): when each delivered frame was captured and when it arrived, in milliseconds, in the order
        of arrival. Raises SimulationError."""
        return {run.camera: run.deliveries_ns() / 1e6 for run in self.simulate(seconds).runs}

    def simulate(self, seconds: float) -> Simulation:
        """The first ``seconds`` of virtual time; equal calls give equal results. Raises SimulationError."""
        return self._simulated(seconds)

    def _simulate(self, seconds: float) -> Simulation:
        return simulate(self.config, self.cameras, seconds, self.seed, frame_period_ms=self.frame_period_ms)
