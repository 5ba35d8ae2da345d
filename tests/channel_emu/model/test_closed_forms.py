"""The simulated ages against theory, within 0.5 %."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the closed forms need scipy")

from scipy import stats

from channel_emu.model.ages import RunningAge
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate
from tests.channel_emu.model import exact_forms as exact

TOLERANCE = 0.005


def summary(arrivals: str, service: str, discipline: str, seconds: float, seed: int = 5, **more: object) -> dict:
    section = {"arrivals": arrivals, "service": service, "discipline": discipline, **more}
    return simulate(channel_from_mapping(section), 1, seconds, seed=seed).summary()


GAMMA = exact.dg1_drop_new(1.0, 1.5, stats.gamma(2.0, scale=0.75).sf)
LOGNORMAL = exact.dg1_drop_new(1.0, 1.5, stats.lognorm(0.8, scale=1.5 * math.exp(-0.32)).sf)
# Arrivals, service, discipline, exact mean age, exact peak age where known.
CASES = {
    "M/M/1 fcfs": ("poisson:0.5", "exp:1ms", "fcfs", exact.mm1_fcfs(0.5, 1.0), None),
    "M/G/1 blocking": ("poisson:1", "gamma:1ms:2", "drop-new", exact.mg1_blocking(1.0, 1.0, 1.5), None),
    "M/G/1 preemptive": ("poisson:1", "gamma:1ms:2", "lcfs-preempt", exact.mg1_preemptive(1.0, 2.0, 1.0), None),
    "D/G/1/0 gamma": ("periodic:1ms", "gamma:1.5ms:2", "drop-new", *GAMMA),
    "D/G/1/0 lognormal": ("periodic:1ms", "lognormal:1.5ms:0.8", "drop-new", *LOGNORMAL),
    "M/M/1 newest waits": ("poisson:1", "exp:1ms", "newest-waits", exact.mm1_newest_waits(1.0, 1.0), None),
    "D/M/1 drop-new, thesis": ("periodic:30ms", "exp:60ms", "drop-new", *exact.dm1_drop_new(30.0, 1 / 60)),
    "D/M/inf, thesis": ("periodic:30ms", "exp:60ms", "parallel", exact.dm1_parallel(30.0, 1 / 60), None),
}


@pytest.mark.parametrize(("arrivals", "service", "discipline", "age", "peak"), CASES.values(), ids=CASES)
def test_mean_age_and_peak_age(arrivals: str, service: str, discipline: str, age: float, peak: float | None) -> None:
    """Of forty thousand frames, or as many more as the bound needs."""
    frame_ms = {"poisson:0.5": 2, "periodic:30ms": 30}.get(arrivals, 1)
    times = 2 if service.startswith("lognormal") or (service, discipline) == ("gamma:1ms:2", "lcfs-preempt") else 1
    found = summary(arrivals, service, discipline, 40 * frame_ms * times)
    assert found["mean_age_ms"] == pytest.approx(age, rel=TOLERANCE)
    assert peak is None or found["peak_age_ms"] == pytest.approx(peak, rel=TOLERANCE)


def test_the_values_that_were_checked_before() -> None:
    """Against numbers computed elsewhere, so that a formula mistyped here is noticed."""
    assert exact.mm1_fcfs(0.5, 1.0) == pytest.approx(3.5)
    for period, age in ((0.5, 2.02075), (1.0, 2.08198), (2.0, 2.31304)):
        assert exact.dm1_drop_new(period, 1.0)[0] == pytest.approx(age, abs=1e-5)
        general = exact.dg1_drop_new(period, 1.0, stats.expon().sf)
        assert general == pytest.approx(exact.dm1_drop_new(period, 1.0))
    assert exact.modulated_drop_new(0.2, 0.5, 5, 0.5, 0.5) == pytest.approx(0.96021, abs=1e-5)
    assert exact.modulated_drop_new(1, 3, 10, 0.2, 0.1) == pytest.approx(0.36346, abs=1e-5)
    assert exact.modulated_drop_new(1, 3, 2, 2, 0.7) == pytest.approx(exact.dm1_drop_new(0.7, 2.0)[0])


def test_drop_new_with_constant_delay_is_exact() -> None:
    """Three periods a cycle, no chance in it: the age follows from arithmetic, to the end effects."""
    found = summary("periodic:30ms", "det:70ms", "drop-new", 900)
    assert found["mean_age_ms"] == pytest.approx(70 + 30 * 3 / 2, rel=1e-4)


@pytest.mark.parametrize(
    ("a", "b", "good", "bad", "period"), [(0.2, 0.5, 5, 0.5, 0.5), (1, 3, 10, 0.2, 0.1)], ids=["slow", "fast"]
)
def test_modulated_service(a: float, b: float, good: float, bad: float, period: float) -> None:
    service = f"exp:{1 / good}ms,exp:{1 / bad}ms"
    more = {"chain": {"mu1_per_ms": a, "mu2_per_ms": b}, "service_state": "modulated"}
    found = summary(f"periodic:{period}ms", service, "drop-new", 120 * period, seed=6, **more)
    theory = exact.modulated_drop_new(a, b, good, bad, period)
    assert found["mean_age_ms"] == pytest.approx(theory, rel=TOLERANCE)


def test_several_sources_at_one_server() -> None:
    """Two unequal sources; the known forms hold for each, at the rates that the numbers drawn happen to have."""
    forms = {
        "lcfs-preempt": lambda mine, other, mean, square: exact.shared_mm1_preemptive(mine, other, 1 / mean),
        "drop-new": exact.shared_mg1_blocking,
        "fcfs": lambda mine, other, mean, square: exact.shared_mm1_fcfs(mine, other, 1 / mean),
    }
    for discipline, form in forms.items():
        ages, rates, mean, square = _unequal(discipline, 180.0)
        assert rates == pytest.approx([0.2, 0.3], rel=0.02) and mean == pytest.approx(1.0, rel=0.02)
        assert ages[0] == pytest.approx(form(*rates, mean, square), rel=TOLERANCE)
        assert ages[1] == pytest.approx(form(*rates[::-1], mean, square), rel=TOLERANCE)


def _unequal(discipline: str, seconds: float) -> tuple[list[float], list[float], float, float]:
    """Mean ages and rates of two sources, and the mean and mean square of a frame's service in ms. Cameras of one
    channel share their rate, so the first source is two of five cameras and the second three: what several cameras
    deliver is one source's deliveries."""
    section = {"arrivals": "poisson:0.1", "service": "exp:1ms", "discipline": discipline}
    config = channel_from_mapping({**section, "server": {"shared": True}, "queue_limit": 10**6})
    runs = simulate(config, 5, seconds, seed=10).runs
    ages, rates = [], []
    for group in (runs[:2], runs[2:]):
        came = [(t.ended_ns, t.offered_ns) for run in group for t in run.transits if t.outcome == "delivered"]
        ages.append(RunningAge(sorted(came)).mean_age_ms(group[0].end_ns))
        rates.append(sum(len(run.transits) for run in group) / (1e3 * seconds))
    started = [t for run in runs for t in run.transits if t.started_ns is not None and t.due_ns is not None]
    services = np.array([(t.due_ns - t.started_ns) / 1e6 for t in started])
    return ages, rates, float(services.mean()), float((services**2).mean())


def test_losses_by_state() -> None:
    """Gilbert and Elliott's channel: the mean age and peak age that bursts of losses leave."""
    more = {"chain": "mu1=1/200,mu2=1/70", "faults": {"loss": [0.05, 0.7]}}
    age, peak = exact.gilbert_elliott(1 / 200, 1 / 70, (0.05, 0.7), 30.0, 20.0)
    found = summary("periodic:30ms", "det:20ms", "parallel", 1800, **more)
    assert found["mean_age_ms"] == pytest.approx(age, rel=TOLERANCE)
    assert found["peak_age_ms"] == pytest.approx(peak, rel=TOLERANCE)
    more["faults"] = {"loss": 0.05 * 20 / 27 + 0.7 * 7 / 27}  # as many losses, but not in bursts
    found = summary("periodic:30ms", "det:20ms", "parallel", 600, **more)
    assert found["mean_age_ms"] != pytest.approx(age, rel=TOLERANCE)
