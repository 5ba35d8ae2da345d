"""The recursions against sums over all paths, and the expected jumps against small steps of time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from channel_emu.estimate import two_states
from channel_emu.estimate.two_states import TwoStates
from channel_emu.model.chain import two_state_generator

linalg = pytest.importorskip("scipy.linalg")

LEAVE, MEAN, LOSS = (0.02, 0.05), (20.0, 90.0), (0.05, 0.4)
MODEL = TwoStates(np.array([LEAVE]), np.array([MEAN]), np.array([LOSS]), np.array([1.0]))
START_MS = np.array([0.0, 12.0, 13.0, 70.0, 71.0, 400.0])
DELAY_MS = np.array([5.0, 100.0, np.nan, 15.0, np.nan, 60.0])
LOST = np.array([0.0, 0.0, 1.0, 1.0, np.nan, 0.0])


def likelihood(state: int, k: int) -> float:
    """Of frame k, written out."""
    density = 1.0 if math.isnan(DELAY_MS[k]) else math.exp(-DELAY_MS[k] / MEAN[state]) / MEAN[state]
    return density * {0.0: 1 - LOSS[state], 1.0: LOSS[state]}.get(float(LOST[k]), 1.0)


def test_likelihood_states_and_losses_are_sums_over_all_paths() -> None:
    q, count = two_state_generator(*LEAVE), len(START_MS)
    steps = [linalg.expm(q * span) for span in np.diff(START_MS)]
    share = (LEAVE[1] / sum(LEAVE), LEAVE[0] / sum(LEAVE))
    total, states = 0.0, np.zeros((count, 2))
    for path in itertools.product((0, 1), repeat=count):
        p = share[path[0]] * math.prod(likelihood(s, k) for k, s in enumerate(path))
        p *= math.prod(step[a, b] for step, a, b in zip(steps, path, path[1:]))
        total += p
        states[range(count), path] += p
    states /= total
    data = two_states.segments((START_MS, DELAY_MS, LOST), True)
    after, log_likelihood, second = two_states.step(MODEL, data, "exponential")
    assert log_likelihood[0] == pytest.approx(math.log(total), rel=1e-12)
    assert second[0, 0] == pytest.approx(states[:, 1], rel=1e-10)
    known, came = ~np.isnan(LOST), ~np.isnan(DELAY_MS)
    assert after.loss[0] == pytest.approx((LOST[known] @ states[known]) / states[known].sum(0))
    assert after.mean_ms[0] == pytest.approx((DELAY_MS[came] @ states[came]) / states[came].sum(0))


def test_a_step_gives_the_expected_jumps_over_the_expected_time() -> None:
    """Two frames 40 ms apart, and the way between them in four thousand steps of the chain."""
    parts, span = 4000, 40.0
    start, delay, lost = np.array([0.0, span]), np.array([5.0, 150.0]), np.array([0.0, 0.0])
    after, _, _ = two_states.step(MODEL, two_states.segments((start, delay, lost), True), "exponential")
    q, h = two_state_generator(*LEAVE), span / parts
    small = linalg.expm(q * h)
    ahead = np.empty((parts + 1, 2))
    back = np.empty((parts + 1, 2))
    ahead[0] = [LEAVE[1 - k] / sum(LEAVE) * math.exp(-5.0 / MEAN[k]) / MEAN[k] * (1 - LOSS[k]) for k in (0, 1)]
    back[-1] = [math.exp(-150.0 / MEAN[k]) / MEAN[k] * (1 - LOSS[k]) for k in (0, 1)]
    for k in range(parts):
        ahead[k + 1] = ahead[k] @ small
        back[-k - 2] = small @ back[-k - 1]
    time_in = (ahead * back)[:-1].sum(0) * h
    jumps = [(ahead[:-1, k] * small[k, 1 - k] * back[1:, 1 - k]).sum() for k in (0, 1)]
    assert after.leave_per_ms[0] == pytest.approx(np.array(jumps) / time_in, rel=2e-3)


def test_the_maximum_is_higher_than_all_around_it_and_reached_in_a_dozen_steps() -> None:
    base = two_states.segments((np.arange(1500) * 30.0, np.ones(1500), np.zeros(1500)), False)
    data = two_states.draw(MODEL, base, 1, np.random.default_rng(1))
    found, best = two_states.maximize(MODEL, data, "gamma")
    for k, parameter in itertools.product((0, 1), ("leave_per_ms", "mean_ms", "loss")):
        for by in (0.97, 1.03):
            values = {name: getattr(found, name).copy() for name in ("leave_per_ms", "mean_ms", "loss", "shape")}
            values[parameter][0, k] *= by
            assert two_states.step(TwoStates(**values), data, "gamma")[1] < best + 0.01
    far = TwoStates(MODEL.leave_per_ms * [[3.0, 0.3]], MODEL.mean_ms * [[2.0, 0.7]], np.full((1, 2), 0.2), MODEL.shape)
    assert two_states.maximize(far, data, "gamma", 12)[1] > best - 0.05
