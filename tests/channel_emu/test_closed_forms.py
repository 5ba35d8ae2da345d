"""The simulated ages against theory, within 0.5 %, and a proof that a 2 % error would not pass."""

from __future__ import annotations

import pytest

pytest.importorskip("numba", reason="the closed forms are checked on the numba kernel")
pytest.importorskip("scipy", reason="the closed forms need scipy")

from channel_emu.config import channel_from_mapping
from channel_emu.simulate import simulate
from tests.channel_emu import closed_forms as exact

TOLERANCE = 0.005


def poisson(rate: float) -> dict:
    return {"process": "poisson", "rate_per_ms": rate}


def periodic(period_ms: float) -> dict:
    return {"process": "periodic", "period_ms": period_ms}


def exponential(mean_ms: float | list[float]) -> dict:
    return {"law": "exponential", "mean_ms": mean_ms}


def deterministic(mean_ms: float) -> dict:
    return {"law": "deterministic", "mean_ms": mean_ms}


def mean_age(
    arrivals: dict, service: dict, discipline: str, seconds: float, key: str = "mean_age_ms", **more: object
) -> float:
    section = {"arrivals": arrivals, "service": service, "discipline": discipline, **more}
    return simulate(channel_from_mapping(section), 1, seconds, seed=5, engine="kernel").summary()[key]


# (name, arrivals, service, discipline, exact age)
CASES = [
    ("M/M/1 fcfs", poisson(0.5), exponential(1.0), "fcfs", exact.mm1_fcfs(0.5, 1.0)),
    ("M/M/1 fcfs, best load", poisson(0.531), exponential(1.0), "fcfs", exact.mm1_fcfs(0.531, 1.0)),
    ("M/D/1 fcfs", poisson(0.5), deterministic(1.0), "fcfs", exact.md1_fcfs(0.5, 1.0)),
    ("D/M/1 fcfs", periodic(2.0), exponential(1.0), "fcfs", exact.dm1_fcfs(2.0, 1.0)),
    ("M/M/1 blocking", poisson(1.0), exponential(1.0), "drop-new", exact.mm1_blocking(1.0, 1.0)),
    ("M/D/1 blocking", poisson(1.0), deterministic(1.0), "drop-new", exact.mg1_blocking(1.0, 1.0, 1.0)),
    ("M/M/1 newest waits", poisson(1.0), exponential(1.0), "newest-waits", exact.mm1_newest_waits(1.0, 1.0)),
    ("M/M/1 newest waits, busy", poisson(4.0), exponential(1.0), "newest-waits",
     exact.mm1_newest_waits(4.0, 1.0)),
    ("M/M/1 preemptive", poisson(1.0), exponential(1.0), "lcfs-preempt", exact.mm1_preemptive(1.0, 1.0)),
    ("M/D/1 preemptive", poisson(1.0), deterministic(1.0), "lcfs-preempt", exact.md1_preemptive(1.0, 1.0)),
    ("D/M/1 drop-new, C=.5", periodic(0.5), exponential(1.0), "drop-new", exact.dm1_drop_new(0.5, 1.0)),
    ("D/M/1 drop-new, C=1", periodic(1.0), exponential(1.0), "drop-new", exact.dm1_drop_new(1.0, 1.0)),
    ("D/M/1 drop-new, C=2", periodic(2.0), exponential(1.0), "drop-new", exact.dm1_drop_new(2.0, 1.0)),
    ("D/M/1 drop-new, thesis", periodic(30.0), exponential(60.0), "drop-new",
     exact.dm1_drop_new(30.0, 1 / 60)),
    ("D/M/inf, thesis", periodic(30.0), exponential(60.0), "parallel", exact.dm1_parallel(30.0, 1 / 60)),
]  # fmt: skip


def seconds_for(arrivals: dict) -> float:
    """Of virtual time, for a million frames."""
    return 1e3 * arrivals.get("period_ms", 1 / arrivals.get("rate_per_ms", 1.0))


@pytest.mark.parametrize(
    ("arrivals", "service", "discipline", "age"), [c[1:] for c in CASES], ids=[c[0] for c in CASES]
)
def test_mean_age(arrivals: dict, service: dict, discipline: str, age: float) -> None:
    seconds = seconds_for(arrivals)
    assert mean_age(arrivals, service, discipline, seconds) == pytest.approx(age, rel=TOLERANCE)
    # Would the test notice service that is 2 % too slow?
    slower = {**service, "mean_ms": service["mean_ms"] * 1.02}
    assert mean_age(arrivals, slower, discipline, seconds / 2) != pytest.approx(age, rel=TOLERANCE)


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
    peak = mean_age(periodic(1.0), exponential(1.0), "drop-new", 2000, key="peak_age_ms")
    assert peak == pytest.approx(exact.dm1_drop_new_peak(1.0, 1.0), rel=TOLERANCE)


def test_drop_new_with_constant_delay_is_exact() -> None:
    """K frames a cycle, no chance in it: the age follows from arithmetic, to the end effects."""
    age = mean_age(periodic(30.0), deterministic(70.0), "drop-new", 9000)
    assert age == pytest.approx(exact.dd1_drop_new(30.0, 70.0), rel=1e-5)


@pytest.mark.parametrize(
    ("a", "b", "good", "bad", "period"), [(0.2, 0.5, 5, 0.5, 0.5), (1, 3, 10, 0.2, 0.1)], ids=["slow", "fast"]
)
def test_modulated_service(a: float, b: float, good: float, bad: float, period: float) -> None:
    chain = {"mu1_per_ms": a, "mu2_per_ms": b}
    age = mean_age(
        periodic(period), exponential([1 / good, 1 / bad]), "drop-new", 400, chain=chain,
        service_state="modulated",
    )  # fmt: skip
    assert age == pytest.approx(exact.modulated_drop_new(a, b, good, bad, period), rel=TOLERANCE)


def test_slotted_age_differs_by_what_theory_says() -> None:
    """Deliveries anywhere within a slot: sampling at boundaries neither adds nor removes age on average.
    Deliveries on boundaries: each tooth is sampled from its foot on, half a slot below its mean."""
    section = {"arrivals": periodic(30.0), "service": deterministic(70.0), "discipline": "drop-new"}
    found = simulate(channel_from_mapping(section), 1, 9000, engine="kernel", slot_ms=1.0).summary()
    assert found["mean_age_ms"] - found["mean_age_slotted_ms"] == pytest.approx(0.5, abs=1e-6)
    section["service"] = exponential(60.0)
    found = simulate(channel_from_mapping(section), 4, 9000, engine="kernel", slot_ms=1.0).summary()
    assert found["mean_age_slotted_ms"] == pytest.approx(found["mean_age_ms"], abs=0.02)
