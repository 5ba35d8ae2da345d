"""Each policy's exact meaning, and what all of them promise."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_server.scheduler import OFFERED, POLICIES, Epoch, LivePolicies, make_policy, policy_help
from tests.support import MOST_MS, refused, work_ms

MS = 1_000_000


def epoch(now_ms: float, **generated_ms: float) -> Epoch:
    return Epoch(round(now_ms * MS), 0, {c: round(g * MS) for c, g in generated_ms.items()})


AT = epoch(200, a=190, b=80, c=150, d=10)  # ages: 10, 120, 50 and 190 ms


@pytest.mark.parametrize(
    ("name", "value", "at", "chosen"),
    [
        ("all", None, AT, "abcd"),
        ("threshold", 50, AT, "ac"),  # the age of exactly omega is included
        ("threshold", 49.999, AT, "a"),
        ("threshold", 5, AT, "a"),  # the freshest, where none is young enough
        ("wait", 0, AT, "abcd"),
        ("freshest-k", 2, AT, "ac"),
        ("freshest-k", 2, epoch(9, a=5, b=5, c=5), "ab"),
        ("freshest-k", 99, AT, "abcd"),
        ("age-driven", None, AT, "a"),  # the least mean age
        ("age-driven", None, epoch(9, a=5, b=3, c=5), "ac"),
    ],
)
def test_which_cameras_a_policy_chooses(name, value, at, chosen):
    policy = make_policy(name, value, np.random.default_rng(3))
    assert policy.select(at, policy.plan(at)) == tuple(chosen)


def test_wait_counts_only_what_was_generated_after_the_decision_or_has_arrived_since():
    policy = make_policy("wait", 60, np.random.default_rng(0))
    window = policy.plan(AT)
    assert (window.wait_until_ns, window.generated_after_ns, window.flush) == (260 * MS, 200 * MS, False)
    for omega_ms in (0.0, 40.0):  # flushing is asked for only where something is waited for
        flushing = make_policy("wait-flush", omega_ms, np.random.default_rng(0)).plan(AT)
        assert flushing.flush == bool(omega_ms) and (flushing.wait_until_ns == 240 * MS) == bool(omega_ms)
    assert policy.select(epoch(260, a=200, b=201, c=259, d=10), window) == ("b", "c")
    assert policy.select(epoch(260, a=190, b=80), window) == ()  # the wait goes on
    policy = make_policy("wait-arrived", 60, np.random.default_rng(0))
    window = policy.plan(AT)
    assert (window.wait_until_ns, window.generated_after_ns, window.received_after_ns) == (260 * MS, None, 200 * MS)
    at = replace(epoch(260, a=100, b=201, c=150), received_ns={"a": 220 * MS, "b": 230 * MS, "c": 200 * MS})
    assert policy.select(at, window) == ("a", "b")


def test_round_robin_gives_everybody_a_turn():
    policy = make_policy("round-robin", 3, np.random.default_rng(0))
    turns = [policy.select(AT, policy.plan(AT)) for _ in range(4)]
    assert turns == [("a", "b", "c"), ("a", "b", "d"), ("a", "c", "d"), ("b", "c", "d")]


def test_periodic_waits_for_the_next_multiple_and_never_catches_up():
    policy = make_policy("periodic", 100, np.random.default_rng(0))
    assert [policy.plan(epoch(ms, a=1)).wait_until_ns // MS for ms in (201, 200, 999)] == [300, 200, 1000]


def test_random_is_uniform_over_non_empty_sets_and_repeats_with_its_seed():
    policy = make_policy("random", None, np.random.default_rng(1))
    at = epoch(9, a=1, b=2)
    seen = [policy.select(at, policy.plan(at)) for _ in range(6000)]
    shares = [seen.count(s) / 6000 for s in (("a",), ("b",), ("a", "b"))]
    # Three equally likely sets: the standard deviation of a share is 0.0061.
    assert np.allclose(shares, 1 / 3, atol=0.025)
    again = make_policy("random", None, np.random.default_rng(1))
    assert [again.select(at, again.plan(at)) for _ in range(100)] == seen[:100]


@pytest.mark.parametrize("name", POLICIES)
@given(ages=st.lists(st.floats(-1e4, 1e9), max_size=40), now=st.integers(0, 2**62))
def test_every_policy_selects_known_cameras_once_and_at_least_one(name, ages, now):
    generated = {f"c{i}": now - round(a * MS) for i, a in enumerate(ages)}
    policy = make_policy(name, None, np.random.default_rng(0))
    at = Epoch(now, 0, generated)
    window = policy.plan(at)
    assert window.wait_until_ns <= now + 1000 * MS
    chosen = policy.select(at, window)
    assert len(set(chosen)) == len(chosen) and set(chosen) <= set(generated)
    # omega-wait may go on waiting: nothing was generated, or has arrived, after the decision yet.
    assert bool(chosen) == bool(generated) or name.startswith("wait")


def test_a_value_out_of_range_is_refused_by_name_and_an_unknown_policy_lists_the_known_ones():
    beyond = {"threshold": -1, "wait": np.nan, "freshest-k": 0, "round-robin": 2.5, "periodic": 3.7e6, "random": np.nan}
    for name, value in beyond.items():
        refused(ValueError, "expected", make_policy, name, value, np.random.default_rng(0))
    refused(ValueError, "no value to set", make_policy, "bandit:policy.npz", 3.0, np.random.default_rng(0))
    for name in ("best", "wait+mask", ""):
        with pytest.raises(ValueError, match=f"{re.escape(repr(name))} is not known.*; there are: .*freshest-k"):
            make_policy(name, None, np.random.default_rng(0))
        assert policy_help(name) == ""


def test_a_running_edge_offers_what_it_began_with_and_no_other_file():
    policies = LivePolicies("threshold", 70.0, lambda name: np.random.default_rng(len(name)))
    assert (policies.first.name, policies.first.value, policies.offered) == ("threshold", 70.0, OFFERED)
    assert policies.make("freshest-k", 3.0).value == 3
    for name in ("bandit:other.npz", "wait-flush", "best"):
        refused(ValueError, name, policies.make, name, None)

    def ask():
        refused(ValueError, "8000000 characters", policies.make, "n" * 8_000_000, None)

    assert work_ms(ask) < MOST_MS
