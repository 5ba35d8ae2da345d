"""Arrivals of a Poisson process, Markov-modulated or not (thesis 6.23, 6.24).

A Poisson process, modulated or not, has no memory: given the chain's path, the next arrival after any instant
is where the integral of the rate reaches a unit-mean exponential. That exponential is looked up by the number
of the frame to be sampled, so arrivals depend on (camera, offer number) only.
"""

from __future__ import annotations

from collections.abc import Sequence

from channel_emu.model.chain import Chain
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.nanoseconds import NEVER_NS, saturating_add, saturating_round


def completion_ns(work: float, rates_per_ns: Sequence[float], chain: Chain | None, start_ns: int) -> int:
    """Instant at which the rate, integrated from ``start_ns`` on, reaches ``work``; NEVER_NS if it does not.

    rates_per_ns: one entry a chain state, or one for all.
    """
    if chain is None or len(rates_per_ns) == 1 or rates_per_ns.count(rates_per_ns[0]) == len(rates_per_ns):
        return _at_rate(work, rates_per_ns[0], start_ns)
    at_ns = start_ns
    while at_ns < NEVER_NS:
        state, until_ns = chain.segment(at_ns)
        rate = rates_per_ns[state]
        if rate > 0.0:
            left = float(until_ns - at_ns)
            need = work / rate
            if need <= left:
                return saturating_add(at_ns, saturating_round(need))
            work -= rate * left
        at_ns = until_ns
    return NEVER_NS


def _at_rate(work: float, rate_per_ns: float, start_ns: int) -> int:
    return saturating_add(start_ns, saturating_round(work / rate_per_ns)) if rate_per_ns > 0.0 else NEVER_NS


class PoissonArrivals:
    """Poisson arrivals with one rate for all chain states, or one a state (an MMPP)."""

    def __init__(self, rates_per_ms: Sequence[float], chain: Chain | None, rng: CounterRng) -> None:
        self.rates_per_ns = [rate / 1e6 for rate in rates_per_ms]
        self.chain = chain
        self.rng = rng

    def next_ns(self, after_ns: int, number: int) -> int:
        """First arrival after ``after_ns``, drawn with the exponential of frame ``number``."""
        return completion_ns(self.rng.exponential(number), self.rates_per_ns, self.chain, after_ns)
