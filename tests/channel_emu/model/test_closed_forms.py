"""The simulated ages against theory, within 2 %."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("scipy", reason="the closed forms need scipy")

from scipy import stats

from channel_emu.model.ages import RunningAge
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate
from tests.channel_emu.model import exact_forms as exact

TOLERANCE = 0.02


def poisson(rate: float) -> dict:
    return {"process": "poisson", "rate_per_ms": rate}


def periodic(period_ms: float) -> dict:
    return {"process": "periodic", "period_ms": period_ms}


def exponential(mean_ms: float | list[float]) -> dict:
    return {"law": "exponential", "mean_ms": mean_ms}


def deterministic(mean_ms: float) -> dict:
    return {"law": "deterministic", "mean_ms": mean_ms}


def gamma(mean_ms: float, shape: float) -> dict:
    return {"law": "gamma", "mean_ms": mean_ms, "shape": shape}


def mean_age(
    arrivals: dict, service: dict, discipline: str, seconds: float, key: str = "mean_age_ms", **more: object
) -> float:
    section = {"arrivals": arrivals, "service": service, "discipline": discipline, **more}
    return simulate(channel_from_mapping(section), 1, seconds, seed=5).summary()[key]


# (name, arrivals, service, discipline, exact age, what else the channel has)
CASES = [
    ("M/M/1 fcfs", poisson(0.5), exponential(1.0), "fcfs", exact.mm1_fcfs(0.5, 1.0)),
    ("M/D/1 fcfs", poisson(0.5), deterministic(1.0), "fcfs", exact.md1_fcfs(0.5, 1.0)),
    ("D/M/1 fcfs", periodic(2.0), exponential(1.0), "fcfs", exact.dm1_fcfs(2.0, 1.0)),
    ("M/M/1 blocking", poisson(1.0), exponential(1.0), "drop-new", exact.mm1_blocking(1.0, 1.0)),
    ("M/M/1/2", poisson(0.7), exponential(1.0), "fcfs", exact.mm12(0.7, 1.0), {"queue_limit": 1}),
    ("M/G/1 blocking", poisson(1.0), gamma(1.0, 2.0), "drop-new", exact.mg1_blocking(1.0, 1.0, 1.5)),
    ("M/G/1 preemptive", poisson(1.0), gamma(1.0, 2.0), "lcfs-preempt", exact.mg1_preemptive(1.0, 2.0, 1.0)),
    (
        "D/G/1/0 gamma",
        periodic(1.0),
        gamma(1.5, 2.0),
        "drop-new",
        exact.dg1_drop_new(1.0, 1.5, stats.gamma(2.0, scale=0.75).sf)[0],
    ),
    (
        "D/G/1/0 lognormal",
        periodic(1.0),
        {"law": "lognormal", "mean_ms": 1.5, "sigma": 0.8},
        "drop-new",
        exact.dg1_drop_new(1.0, 1.5, stats.lognorm(0.8, scale=1.5 * math.exp(-0.32)).sf)[0],
    ),
    ("M/M/1 newest waits", poisson(1.0), exponential(1.0), "newest-waits", exact.mm1_newest_waits(1.0, 1.0)),
    ("M/M/1 preemptive", poisson(1.0), exponential(1.0), "lcfs-preempt", exact.mm1_preemptive(1.0, 1.0)),
    ("D/M/1 drop-new, C=1", periodic(1.0), exponential(1.0), "drop-new", exact.dm1_drop_new(1.0, 1.0)),
    ("D/M/1 drop-new, thesis", periodic(30.0), exponential(60.0), "drop-new", exact.dm1_drop_new(30.0, 1 / 60)),
    ("D/M/inf, thesis", periodic(30.0), exponential(60.0), "parallel", exact.dm1_parallel(30.0, 1 / 60)),
]


def seconds_for(arrivals: dict) -> float:
    """Of virtual time, for forty thousand frames."""
    return 40 * arrivals.get("period_ms", 1 / arrivals.get("rate_per_ms", 1.0))


@pytest.mark.parametrize(
    ("arrivals", "service", "discipline", "age", "more"),
    [(*c[1:5], c[5] if len(c) > 5 else {}) for c in CASES],
    ids=[c[0] for c in CASES],
)
def test_mean_age(arrivals: dict, service: dict, discipline: str, age: float, more: dict) -> None:
    seconds = seconds_for(arrivals)
    assert mean_age(arrivals, service, discipline, seconds, **more) == pytest.approx(age, rel=TOLERANCE)


def test_the_values_that_were_checked_before() -> None:
    """Against numbers computed elsewhere, so that a formula mistyped here is noticed."""
    assert exact.mm1_fcfs(0.5, 1.0) == pytest.approx(3.5)
    assert exact.md1_fcfs(0.5, 1.0) == pytest.approx(3.14872, abs=1e-5)
    assert exact.dm1_fcfs(2.0, 1.0) == pytest.approx(2.25500, abs=1e-5)
    for period, age in ((0.5, 2.02075), (1.0, 2.08198), (2.0, 2.31304)):
        assert exact.dm1_drop_new(period, 1.0) == pytest.approx(age, abs=1e-5)
    assert exact.modulated_drop_new(0.2, 0.5, 5, 0.5, 0.5) == pytest.approx(0.96021, abs=1e-5)
    assert exact.modulated_drop_new(1, 3, 10, 0.2, 0.1) == pytest.approx(0.36346, abs=1e-5)
    assert exact.modulated_drop_new(1, 3, 2, 2, 0.7) == pytest.approx(exact.dm1_drop_new(0.7, 2.0))


def test_peak_age_of_drop_new() -> None:
    peak = mean_age(periodic(1.0), exponential(1.0), "drop-new", 40, key="peak_age_ms")
    assert peak == pytest.approx(exact.dm1_drop_new_peak(1.0, 1.0), rel=TOLERANCE)
    peak = mean_age(periodic(1.0), gamma(1.5, 2.0), "drop-new", 40, key="peak_age_ms")
    general = exact.dg1_drop_new(1.0, 1.5, stats.gamma(2.0, scale=0.75).sf)[1]
    assert peak == pytest.approx(general, rel=TOLERANCE)


def test_drop_new_with_constant_delay_is_exact() -> None:
    """K frames a cycle, no chance in it: the age follows from arithmetic, to the end effects."""
    age = mean_age(periodic(30.0), deterministic(70.0), "drop-new", 900)
    assert age == pytest.approx(exact.dd1_drop_new(30.0, 70.0), rel=1e-4)


@pytest.mark.parametrize(
    ("a", "b", "good", "bad", "period"), [(0.2, 0.5, 5, 0.5, 0.5), (1, 3, 10, 0.2, 0.1)], ids=["slow", "fast"]
)
def test_modulated_service(a: float, b: float, good: float, bad: float, period: float) -> None:
    chain = {"mu1_per_ms": a, "mu2_per_ms": b}
    age = mean_age(
        periodic(period),
        exponential([1 / good, 1 / bad]),
        "drop-new",
        40 * period,
        chain=chain,
        service_state="modulated",
    )
    theory = exact.modulated_drop_new(a, b, good, bad, period)
    assert age == pytest.approx(theory, rel=TOLERANCE)


def test_several_sources_at_one_server() -> None:
    """Two unequal sources; the known forms hold for each."""
    lam, other, mu = 0.2, 0.3, 1.0
    preemptive, blocking, fcfs = [
        _unequal(discipline, (lam, other)) for discipline in ("lcfs-preempt", "drop-new", "fcfs")
    ]
    for mine, theirs, found in ((lam, other, 0), (other, lam, 1)):
        expected = exact.shared_mm1_preemptive(mine, theirs, mu)
        assert preemptive[found] == pytest.approx(expected, rel=TOLERANCE)
        expected = exact.shared_mg1_blocking(mine, theirs, 1 / mu, 2 / mu**2)
        assert blocking[found] == pytest.approx(expected, rel=TOLERANCE)
        assert fcfs[found] == pytest.approx(exact.shared_mm1_fcfs(mine, theirs, mu), rel=TOLERANCE)


def _unequal(discipline: str, rates: tuple[float, float]) -> list[float]:
    """Mean ages of two sources of these rates. Cameras of one channel share their rate, so the first source
    is two of five cameras and the second three: what several cameras deliver is one source's deliveries."""
    each = rates[0] / 2
    config = channel_from_mapping(
        {
            "arrivals": poisson(each),
            "service": exponential(1.0),
            "discipline": discipline,
            "server": {"shared": True},
            "queue_limit": 10**6,
        }
    )
    runs = simulate(config, 5, 60, seed=5).runs
    merged = []
    for group in (runs[:2], runs[2:]):
        came = [(t.ended_ns, t.offered_ns) for run in group for t in run.transits if t.outcome == "delivered"]
        merged.append(RunningAge(sorted(came)).mean_age_ms(group[0].end_ns))
    return merged


def test_losses_by_state() -> None:
    """Gilbert and Elliott's channel: the mean age and peak age that bursts of losses leave."""
    section: dict = {
        "arrivals": "periodic:30ms",
        "service": "det:20ms",
        "discipline": "parallel",
        "chain": "mu1=1/200,mu2=1/70",
        "faults": {"loss": [0.05, 0.7]},
    }
    age, peak = exact.gilbert_elliott(1 / 200, 1 / 70, (0.05, 0.7), 30.0, 20.0)
    found = simulate(channel_from_mapping(section), 1, 600, seed=5).summary()
    assert found["mean_age_ms"] == pytest.approx(age, rel=TOLERANCE)
    assert found["peak_age_ms"] == pytest.approx(peak, rel=TOLERANCE)
    section["faults"] = {"loss": 0.05 * 20 / 27 + 0.7 * 7 / 27}  # as many losses, but not in bursts
    found = simulate(channel_from_mapping(section), 1, 600, seed=5).summary()
    assert found["mean_age_ms"] != pytest.approx(age, rel=TOLERANCE)
