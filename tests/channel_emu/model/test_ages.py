"""Ages by hand, against a sum over instants, and simulated ones against theory, within 0.5 %. Rates per ms, ages in ms.

Sources: Kaul, Yates and Gruteser (INFOCOM 2012); Costa, Codreanu and Ephremides (IEEE T-IT 62(4), 2016) for
one waiting place; Yates and Kaul (IEEE T-IT 65(3), 2019) for preemption by several sources; the other forms are
derived where they stand, by renewal arguments.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from channel_emu.model.ages import RunningAge
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate

TOLERANCE = 0.005


@given(
    st.lists(st.tuples(st.integers(0, 50), st.integers(0, 50)), min_size=1, max_size=30),
    st.integers(1, 50),
    st.sampled_from([100, 10**18]),  # late instants lose no nanoseconds
)
def test_the_mean_is_that_over_all_instants_and_the_peak_that_before_each_newer_frame(steps, after, start_ns):
    """Deliveries in order of time, of frames of any age, out of order and doubled."""
    at = np.cumsum([step for step, _ in steps])
    born = at - [old for _, old in steps]
    middles = np.arange(at[0], at[-1] + after) + 0.5
    newest = [born[at < now].max() for now in middles]
    found = RunningAge((start_ns + int(a), start_ns + int(b)) for a, b in zip(at, born))
    assert found.mean_age_ms(start_ns + int(at[-1]) + after) == pytest.approx(float((middles - newest).mean()) / 1e6)
    best = np.maximum.accumulate(born)
    peaks = (at[1:] - best[:-1])[best[1:] > best[:-1]]
    assert found.peak_age_ms() == (pytest.approx(peaks.mean() / 1e6) if len(peaks) else None)
    assert RunningAge([(7, 3)]).mean_age_ms(7) is None


def mm1_newest_waits(lam: float, mu: float) -> float:
    both = lam**2 + lam * mu + mu**2
    return 1 / lam + 2 / mu + lam / (lam + mu) ** 2 + 1 / (lam + mu) - 2 * (lam + mu) / both


def dg1_drop_new(period: float, mean: float, survival: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """Mean and peak age; survival(t) = P(S > t) of an array. E[K], E[K²] are sums of P(K > k) = P(S > kC)."""
    above = survival(period * np.arange(2000))
    first, second = above.sum(), ((2 * np.arange(2000) + 1) * above).sum()
    return mean + period * second / (2 * first), mean + period * first


def dm1_parallel(period: float, mu: float) -> float:
    """The age is that of the youngest frame that has arrived: summed over the frames, averaged over the phase."""
    ages = (np.arange(2000)[:, None] + 0.5) / 2000 * period + period * np.arange(400)
    late = np.exp(-mu * ages)
    none_younger = np.cumprod(np.hstack((np.ones((2000, 1)), late[:, :-1])), 1)
    return float((none_younger * (1 - late) * ages).sum(1).mean())


def mm1_preemptive(lam: float, other: float, mu: float) -> float:
    """Of the source of rate lam where others of rate ``other`` in all use the same server, as in all that follow."""
    return (1 + (lam + other) / mu) / lam


def mm1_drop_new(lam: float, other: float, mu: float) -> float:
    """A source's deliveries are N server cycles S + X apart, N geometric of mean 1 + other/lam."""
    rate = lam + other
    cycle, variation, p = 1 / mu + 1 / rate, 1 / mu**2 + 1 / rate**2, lam / rate
    apart = cycle / p
    variance = variation / p + (1 - p) / p**2 * cycle**2
    return 1 / mu + (variance + apart**2) / (2 * apart)


def mm1_fcfs(lam: float, other: float, mu: float) -> float:
    """age = lam (E[X²]/2 + E[X T]): T is the workload V that the previous update left after X, and its own
    service. V starts exponential of rate mu - lam - other and gets the others' work meanwhile, so that
    E[V(x)] = E[V(0)] - (1 - other/mu) x + time spent empty, whose Laplace transform is
    E[e^(-eta V(0))] / (eta s²) with eta (1 - other/(mu + eta)) = s; X weighs it with lam x e^(-lam x).
    """
    start = mu - lam - other
    half = (lam + other - mu) / 2
    eta = half + math.sqrt(half**2 + lam * mu)
    slope = 1 / (1 - other * mu / (mu + eta) ** 2)  # of eta by s, at s = lam
    empty = start / ((start + eta) * eta)
    empty_slope = -start * (start + 2 * eta) / ((start + eta) * eta) ** 2 * slope
    idle = empty / lam - empty_slope  # -lam d/ds [empty / s]
    workload = 1 / (start * lam) - 2 * (1 - other / mu) / lam**2 + idle
    return lam * (1 / lam**2 + workload + 1 / (lam * mu))


LOGNORMAL = dg1_drop_new(1.0, 1.5, stats.lognorm(0.8, scale=1.5 * np.exp(-0.32)).sf)
THESIS = dg1_drop_new(30.0, 60.0, stats.expon(scale=60.0).sf)
# Arrivals, service, discipline, seconds, exact mean age, exact peak age where known.
CASES = {
    "M/M/1 fcfs": ("poisson:0.5", "exp:1ms", "fcfs", 80, 3.5, None),
    "M/G/1 preemptive": ("poisson:1", "gamma:1ms:2", "lcfs-preempt", 80, 1.5**2, None),  # 1 / (lam E[e^(-lam S)])
    "M/M/1 newest waits": ("poisson:1", "exp:1ms", "newest-waits", 40, mm1_newest_waits(1.0, 1.0), None),
    "D/G/1/0": ("periodic:1ms", "lognormal:1.5ms:0.8", "drop-new", 80, *LOGNORMAL),
    "D/M/1/0, thesis": ("periodic:30ms", "exp:60ms", "drop-new", 1200, *THESIS),
    "D/M/inf, thesis": ("periodic:30ms", "exp:60ms", "parallel", 1200, dm1_parallel(30.0, 1 / 60), None),
}


@pytest.mark.parametrize("case", CASES)
def test_mean_age_and_peak_age(case):
    arrivals, service, discipline, seconds, age, peak = CASES[case]
    section = {"arrivals": arrivals, "service": service, "discipline": discipline}
    found = simulate(channel_from_mapping(section), 1, seconds, seed=5).summary()
    assert found["mean_age_ms"] == pytest.approx(age, rel=TOLERANCE)
    assert peak is None or found["peak_age_ms"] == pytest.approx(peak, rel=TOLERANCE)


@pytest.mark.parametrize(
    ("discipline", "form"), [("lcfs-preempt", mm1_preemptive), ("drop-new", mm1_drop_new), ("fcfs", mm1_fcfs)]
)
def test_several_sources_at_one_server(discipline, form):
    """The first source is two of five cameras, the second three: what they deliver is one source's deliveries. The
    known forms hold at the rates that the numbers drawn happen to have."""
    section = {"arrivals": "poisson:0.1", "service": "exp:1ms", "discipline": discipline}
    config = channel_from_mapping({**section, "server": {"shared": True}, "queue_limit": 10**6})
    runs = simulate(config, 5, 180.0, seed=10).runs
    started = [t for run in runs for t in run.transits if t.started_ns is not None and t.due_ns is not None]
    mu = 1 / float(np.mean([(t.due_ns - t.started_ns) / 1e6 for t in started]))
    groups = runs[:2], runs[2:]
    rates = [sum(len(run.transits) for run in group) / 180e3 for group in groups]
    assert rates == pytest.approx([0.2, 0.3], rel=0.02) and mu == pytest.approx(1.0, rel=0.02)
    for group, mine, other in zip(groups, rates, rates[::-1]):
        came = [(t.ended_ns, t.offered_ns) for run in group for t in run.transits if t.outcome == "delivered"]
        age = RunningAge(sorted(came)).mean_age_ms(group[0].end_ns)
        assert age == pytest.approx(form(mine, other, mu), rel=TOLERANCE)
