"""How long the link takes to carry a frame: delay laws, following the chain's state (thesis 6.23, 6.24).

A law is a shape of mean one; the state sets the mean. ``at-start``: the delay is drawn for the state in
which transmission starts and kept (the thesis). ``modulated``: the frame's work is served at the speed of
whatever state the chain passes through (the closed form of the Gilbert-Elliott-modulated link).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from channel_emu.model.chain import Chain
from channel_emu.model.counter_rng import Uniforms
from channel_emu.model.instants import later, to_ns
from channel_emu.model.traffic import spend

# Number of a frame -> its work, a draw of mean one.
Shape = Callable[[int], float]


def exponential(uniforms: Uniforms) -> Shape:
    return uniforms.exponential


def deterministic() -> Shape:
    return lambda number: 1.0


def lognormal(uniforms: Uniforms, sigma: float) -> Shape:
    """exp(sigma Z - sigma²/2), Z standard normal by Box and Muller."""

    def draw(number: int) -> float:
        return math.exp(sigma * _normal(*uniforms.pair(number)) - sigma * sigma / 2)

    return draw


def gamma(uniforms: Uniforms, shape: float) -> Shape:
    """Gamma of the given shape over its mean. Marsaglia and Tsang, ACM TOMS 26(3), 2000; shapes below one by
    their boost. Each rejection looks at the frame's next pairs, so frames stay independent."""
    boosted = shape if shape >= 1.0 else shape + 1.0
    d = boosted - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)

    def draw(number: int) -> float:
        again = 1
        while True:
            x = _normal(*uniforms.pair(number, again))
            v = (1.0 + c * x) ** 3
            u = uniforms.uniform(number, again + 1)
            if v > 0.0 and math.log(u) < 0.5 * x * x + d - d * v + d * math.log(v):
                break
            again += 2
        value = d * v
        if shape < 1.0:
            value *= uniforms.uniform(number) ** (1.0 / shape)
        return value / shape

    return draw


def recorded(delays_ms: Sequence[float]) -> Shape:
    """The given delays in turn, from the first again at their end (mean_ms is then 1: works are ms)."""
    return lambda number: delays_ms[number % len(delays_ms)]


class Service:
    """Draws (delay, due) for a frame that starts transmission."""

    def __init__(
        self, shape: Shape, means_ms: Sequence[float], chain: Chain | None, modulated: bool = False
    ) -> None:
        """``means_ms``: mean delay, one for all states or one a state."""
        self.shape = shape
        self.means_ms = list(means_ms)
        self.chain = chain
        self.modulated = modulated and chain is not None and len(self.means_ms) > 1
        self._speeds_per_ns = [1.0 / (mean * 1e6) if mean > 0.0 else math.inf for mean in self.means_ms]

    def due_ns(self, start_ns: int, number: int) -> tuple[int, int]:
        """Instant at which frame ``number``, started at ``start_ns``, arrives; and the chain's state then
        (at the start)."""
        state = 0 if self.chain is None else self.chain.state(start_ns)
        work = self.shape(number)
        if self.modulated:
            return spend(work, self._speeds_per_ns, self.chain, start_ns), state
        mean = self.means_ms[state] if len(self.means_ms) > 1 else self.means_ms[0]
        return later(start_ns, to_ns(work * mean)), state


class NoService:
    """Arrives as it starts: the ideal link."""

    means_ms: Sequence[float] = (0.0,)
    modulated = False

    def __init__(self, chain: Chain | None = None) -> None:
        self.chain = chain

    def due_ns(self, start_ns: int, number: int) -> tuple[int, int]:
        return start_ns, 0 if self.chain is None else self.chain.state(start_ns)


def _normal(u: float, v: float) -> float:
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)
