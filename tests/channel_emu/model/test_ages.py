"""Every metric of age against its closed form, within 2 %, or by hand."""

from __future__ import annotations

import numpy as np
import pytest

from channel_emu.model import ages
from channel_emu.model.config import channel_from_mapping
from channel_emu.model.notation import NotationError
from channel_emu.virtual.simulate import simulate
from tests.channel_emu.model import exact_forms as exact

TOLERANCE = 0.02
MS = 10**6


def test_ages_by_hand() -> None:
    """Generated at 0, 10, 20 ms; delivered at 5, 40, 30: the second comes too late to matter."""
    saw = ages.sawtooth(np.array([5, 40, 30]) * 10**6, np.array([0, 10, 20]) * 10**6, 50 * 10**6)
    assert saw.delivered_ns.tolist() == [5 * 10**6, 30 * 10**6]
    # Teeth: 5 -> 30 over 25 ms, then 10 -> 30 over 20 ms.
    assert ages.mean_age_ms(saw) == pytest.approx((25 * 17.5 + 20 * 20) / 45)
    assert ages.peak_age_ms(saw) == pytest.approx(30)
    # At 5, 10, ..., 25: 5 10 15 20 25; at 30, ..., 45: 10 15 20 25.
    assert ages.query_age_ms(saw, 5.0) == pytest.approx((75 + 70) / 9)
    at = ages.newest_at(saw, np.array([0, 5, 29, 30, 50]) * 10**6)
    assert at.tolist() == [-1, 0, 0, 20 * 10**6, 20 * 10**6]


def test_no_delivery_has_no_age() -> None:
    nothing = ages.sawtooth(np.zeros(0, np.int64), np.zeros(0, np.int64), 10**9)
    assert ages.mean_age_ms(nothing) is None and ages.peak_age_ms(nothing) is None
    assert ages.query_age_ms(nothing, 1.0) is None
    assert ages.newest_at(nothing, np.array([5])).tolist() == [-1]


def near(value: float | None) -> object:
    return pytest.approx(value, rel=TOLERANCE)


def metric(text: str, seconds: float, **section: object) -> float:
    return simulate(channel_from_mapping(section), 1, seconds, seed=5).summary([text])["metrics_ms"][text]


def path(seconds: float, **section: object) -> ages.Sawtooth:
    return simulate(channel_from_mapping(section), 1, seconds, seed=5).runs[0].sawtooth()


def two_states(away: float, back: float, seconds: float) -> np.ndarray:
    """When a process changes that leaves state 0 at the rate ``away`` and state 1 at ``back`` (per ms)."""
    count = round(seconds * 1e3 / (1 / away + 1 / back))
    stays = np.random.default_rng(1).exponential((1 / away, 1 / back), (count, 2))
    return (stays.ravel().cumsum() * MS).astype(np.int64)


@pytest.mark.parametrize(("rate", "away", "back"), [(0.5, 0.5, 0.5), (0.5, 0.2, 0.6)])
def test_age_of_incorrect_information_of_poisson_updates(rate: float, away: float, back: float) -> None:
    """They arrive at once, on a source of two states."""
    changes = two_states(away, back, 150)
    found = ages.incorrect_age_ms(path(149, arrivals=f"poisson:{rate}"), changes, np.arange(len(changes) + 1) % 2)
    assert found == near(exact.incorrect_without_delay(rate, away, back))
    if away == back:
        assert found == near(away / (2 * away + rate) / (away + rate))


def test_a_source_that_the_metric_draws_itself() -> None:
    """The metric draws its source itself, another one for each seed."""
    once = metric("incorrect:0.3:0.3", 20, arrivals="poisson:1")
    assert once == pytest.approx(exact.incorrect_without_delay(1.0, 0.3, 0.3), rel=0.15)
    assert metric("incorrect:0.3:0.3", 20, arrivals="poisson:1") == once


def test_age_of_incorrect_information_by_hand() -> None:
    """The source is 0, from 10 ms on 1, from 25 ms on 0. Delivered at 5 ms: of 2 ms; at 20 ms: of 12 ms."""
    saw = ages.Sawtooth(np.array([5, 20]) * MS, np.array([2, 12]) * MS, 35 * MS)
    found = ages.incorrect_age_ms(saw, np.array([10, 25]) * MS, np.array([0, 1, 0]))
    assert found == pytest.approx((10**2 / 2 + 10**2 / 2) / 30)  # wrong from 10 to 20 and from 25 on


def test_query_age() -> None:
    """Independent queries meet the average age; queries just after each delivery the least one."""
    mm1 = {"arrivals": "poisson:0.5", "service": "exp:1ms", "discipline": "fcfs"}
    assert metric("query:1.7ms", 100, **mm1) == near(exact.mm1_fcfs(0.5, 1.0))
    dd1 = {"arrivals": "periodic:30ms", "service": "det:30ms", "discipline": "fcfs"}
    assert metric("query:30ms", 90, **dd1) == 30
    assert metric("age", 90, **dd1) == 45


def test_age_of_what_is_shown() -> None:
    """Computing delays every frame alike; what a screen shows is half a refresh older on average."""
    mm1 = {"arrivals": "poisson:0.5", "service": "exp:1ms", "discipline": "lcfs-preempt"}
    expected = exact.mm1_preemptive(0.5, 1.0) + 4 + 0.85
    assert metric("shown:4ms:1.7ms", 100, **mm1) == near(expected)


def test_urgency() -> None:
    """A context that does not look at the channel weighs every age alike: E[weight] times the age."""
    changes = two_states(0.02, 0.06, 100)
    saw = path(99, arrivals="poisson:0.5", service="exp:1ms", discipline="lcfs-preempt")
    found = ages.urgency_ms(saw, changes, 1.0 + 4.0 * (np.arange(len(changes) + 1) % 2))
    assert found == near((5 + 3) / 4 * exact.mm1_preemptive(0.5, 1.0))
    saw = ages.Sawtooth(np.array([5]) * MS, np.array([2]) * MS, 15 * MS)
    found = ages.urgency_ms(saw, np.array([11]) * MS, np.array([1.0, 3.0]))
    assert found == pytest.approx((6 * 6 + 3 * 4 * 11) / 10)  # ages 3 to 9, then three times 9 to 13
    assert metric("urgency:1:0.02:0.06", 9, arrivals="poisson:0.5") == pytest.approx(
        metric("age", 9, arrivals="poisson:0.5")
    )


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
    assert metric("age", 600, **section) == near(age)
    assert metric("peak", 600, **section) == near(peak)
    section["faults"] = {"loss": 0.05 * 20 / 27 + 0.7 * 7 / 27}  # as many losses, but not in bursts
    assert metric("age", 600, **section) != near(age)


def test_what_is_computed_beyond_the_end_is_not_shown() -> None:
    section = {"arrivals": "periodic:100ms", "service": "det:50ms", "discipline": "parallel"}
    # Shown 450 and 500 ms after each capture, at 450, 500, ... 950 ms; and half a refresh more on average.
    assert metric("shown:400ms:50ms", 1, **section) == pytest.approx((6 * 450 + 5 * 500) / 11 + 25)
    for text in ("shown:5s:16ms", "shown:1e300ms:1e300ms", "shown:1ms:1e300ms", "query:1e300ms"):
        assert metric(text, 1, **section) is None


@pytest.mark.parametrize(
    "text",
    [
        "youth",
        "query",
        "query:fast",
        "query:0",
        "shown:1",
        "incorrect:1",
        "peak:1ms",
        "urgency:nan:1:1",
        "urgency:-5:1:1",
    ],
)
def test_a_metric_that_cannot_be_read(text: str) -> None:
    saw = ages.Sawtooth(np.array([5]) * MS, np.array([2]) * MS, 15 * MS)
    with pytest.raises(NotationError, match=f"metric '{text}'"):
        ages.measure(text, saw, 0, "cam00")
