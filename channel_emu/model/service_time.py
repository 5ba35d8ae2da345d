"""Service times: how long the link takes to transmit a frame, by the chain's state (thesis 6.23, 6.24).

A law draws a frame's work, with mean one; the state sets the mean delay. ``at-start``: the state in which
transmission starts counts (the thesis). ``modulated``: the work is served at the rate of whichever state the
chain is in (a Gilbert-Elliott-modulated link).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from channel_emu.model.chain import Chain
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.nanoseconds import saturating_add, to_ns
from channel_emu.model.traffic import completion_ns

# Frame number -> work of mean one.
WorkSampler = Callable[[int], float]


def exponential(rng: CounterRng) -> WorkSampler:
    """Exponential of mean one."""
    return rng.exponential


def lognormal(rng: CounterRng, sigma: float) -> WorkSampler:
    """exp(sigma Z - sigma²/2), Z standard normal by Box and Muller."""

    def draw(number: int) -> float:
        return math.exp(sigma * normal(*rng.pair(number)) - sigma * sigma / 2)

    return draw


def gamma(rng: CounterRng, shape: float) -> WorkSampler:
    """Gamma of the given shape, scaled to mean one (Marsaglia and Tsang, ACM TOMS 26(3), 2000; shapes below
    one by their boost). After a rejection the frame's next pairs are used, so frames stay independent."""
    boosted = shape if shape >= 1.0 else shape + 1.0
    d = boosted - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)

    def draw(number: int) -> float:
        attempt = 1
        while True:
            x = normal(*rng.pair(number, attempt))
            v = (1.0 + c * x) ** 3
            u = rng.uniform(number, attempt + 1)
            if v > 0.0 and math.log(u) < 0.5 * x * x + d - d * v + d * math.log(v):
                break
            attempt += 2
        value = d * v
        if shape < 1.0:
            value *= rng.uniform(number) ** (1.0 / shape)
        return value / shape

    return draw


def replayed(works: Sequence[float]) -> WorkSampler:
    """The given works in turn, repeated from the start. With a mean of 1 ms they are delays in ms."""
    return lambda number: works[number % len(works)]


class ServiceTime:
    """When a frame that starts transmission will be delivered."""

    def __init__(
        self, draw_work: WorkSampler, means_ms: Sequence[float], chain: Chain | None, modulated: bool = False
    ) -> None:
        """draw_work: frame number to work of mean one.
        means_ms: mean delay, one for all states or one a state.
        modulated: the chain's state counts during the whole transmission, not only at its start.
        """
        self.draw_work = draw_work
        self.means_ms = list(means_ms)
        self.chain = chain
        self.modulated = modulated and chain is not None and len(self.means_ms) > 1
        self._speeds_per_ns = [1.0 / (mean * 1e6) if mean > 0.0 else math.inf for mean in self.means_ms]

    def due_ns(self, start_ns: int, number: int) -> tuple[int, int]:
        """Delivery instant of frame ``number`` if it starts at ``start_ns``, and the state at the start."""
        state = 0 if self.chain is None else self.chain.state(start_ns)
        work = self.draw_work(number)
        if self.modulated:
            return completion_ns(work, self._speeds_per_ns, self.chain, start_ns), state
        mean = self.means_ms[state] if len(self.means_ms) > 1 else self.means_ms[0]
        return saturating_add(start_ns, to_ns(work * mean)), state


def normal(u: float, v: float) -> float:
    """Standard normal from two uniforms in (0, 1) (Box and Muller)."""
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)
