"""The channel with extreme numbers: it stays exact, or refuses and says why."""

import numpy as np
import pytest

from channel_emu.model.chain import Chain, ChainError, two_state_generator
from channel_emu.model.channel import Channel
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.link import DISCIPLINES, EventKind
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate
from tests.support import refused

pytestmark = pytest.mark.stability


def run(section: dict, seconds: float = 10, **more):
    return simulate(channel_from_mapping(section), 2, seconds, 1, **more).summary()


@pytest.mark.parametrize("discipline", DISCIPLINES)
def test_zero_delays_deliver_everything_and_huge_ones_saturate(discipline):
    found = run({"preset": "ch5", "service": {"mean_ms": 0.0}, "discipline": discipline})
    assert found["delivered"] == found["offered"] and found["dropped"] == 0
    assert found["mean_age_ms"] == pytest.approx(15.0, abs=0.05)
    assert found["delay_ms"]["mean"] == 0.0
    service = {"law": "deterministic", "mean_ms": 1e300}
    found = run({"preset": "ch5", "service": service, "queue_limit": 8, "discipline": discipline})
    assert found["delivered"] == 0 and found["mean_age_ms"] is None
    assert found["in_flight"] <= 2 * 9
    assert found["offered"] == found["in_flight"] + found["dropped_busy"] + found["superseded"]


@pytest.mark.slow
def test_a_chain_that_always_switches():
    """40 switches a millisecond: the channel is its average."""
    section = {
        "preset": "ch6",
        "chain": {"mu1_per_ms": 40.0, "mu2_per_ms": 40.0},
        "discipline": "parallel",
        "service_state": "modulated",
    }
    found = run(section, seconds=2)
    assert found["state_share"]["low"] == pytest.approx(0.5, abs=0.01)
    # Speeds 1/30 and 1/60 average to 1/40.
    assert found["delay_ms"]["mean"] == pytest.approx(40, abs=4 * 40 / max(found["delivered"], 1) ** 0.5)


def test_chains_too_fast_to_follow_are_refused_with_a_reason():
    fast = np.array([[-1e9, 1e9, 0.0], [0.0, -1e9, 1e9], [1e9, 0.0, -1e9]])
    for generator in (two_state_generator(1e6, 1e6), fast):
        refused(ChainError, "at most 1000 are", Chain, generator, CounterRng(0, "", "c"))
    # Named start, closed class only reached later: found out while running, not by hanging.
    late = np.array([[-1.0, 1.0, 0, 0], [0, -1e9, 1e9, 0], [0, 1e9, -1e9, 0], [0, 0, 0, 0]])
    refused(ChainError, "more than 10000 times", Chain(late, CounterRng(0, "", "c"), initial=0).state, 10**12)


def test_rates_of_1e_minus_9_and_1e9_together():
    """Rarely leaves the first state, and is back at once: what happens is the first state's."""
    chain = Chain(two_state_generator(1e-9, 1e9), CounterRng(0, "", "c"))
    assert chain.occupancy(10**15) == [1.0, 0.0]
    found = run({"preset": "ch6", "chain": {"mu1_per_ms": 1e-9, "mu2_per_ms": 1e9}}, seconds=100)
    assert found["state_share"]["low"] == pytest.approx(1.0)
    assert found["delay_ms"]["mean"] == pytest.approx(30, rel=0.2)


@pytest.mark.parametrize("rate", [1e-9, 1e9])
def test_arrival_rates_at_both_ends(rate):
    section = {"preset": "ch6-low", "arrivals": {"rate_per_ms": rate}, "service": {"mean_ms": 1.0}}
    found = run(section, frame_period_ms=33.0)
    if rate < 1:  # nothing is ever sampled
        assert found["skipped"] == found["offered"] - 2 and found["delivered"] == 0
    else:  # everything is, at once
        assert found["skipped"] == 0 and found["delivered"] >= found["offered"] - 2


def test_a_frame_after_years_of_silence():
    link = Channel(channel_from_mapping({"preset": "ch5"}), 0).link("late")
    transit, _ = link.offer(3 * 365 * 86_400 * 10**9)
    events = link.advance(NEVER_NS)
    assert events[-1].kind is EventKind.DELIVERED and transit.drawn_ns is not None and transit.drawn_ns < 10**9
