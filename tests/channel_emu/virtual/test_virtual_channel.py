"""Ages and deliveries as arrays: they agree with each other and with the summary of the same run."""

from __future__ import annotations

import numpy as np
import pytest

import freshfield as ff
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import SimulationError, simulate
from freshfield.scenario import ScenarioError


def test_ages_are_the_sawtooth_of_the_deliveries():
    channel = ff.Channel("swing", cameras=3, seed=5)
    t_s, ages_ms = channel.ages(4.0, every_ms=7.0)
    assert ages_ms.shape == (3, len(t_s)) and t_s[-1] <= 4.0
    for row, frames in zip(ages_ms, channel.deliveries(4.0).values()):
        for at_ms, age_ms in zip(t_s * 1e3, row):
            captured = [c for c, arrived in frames if arrived <= at_ms]
            if captured:
                assert age_ms == pytest.approx(at_ms - max(captured), abs=1e-6)
            else:
                assert np.isnan(age_ms)


def test_it_is_the_channel_that_the_command_simulates():
    channel = ff.Channel("ch5", service="exp:90ms", cameras=4, seed=1)
    same = simulate(channel_from_mapping({"preset": "ch5", "service": "exp:90ms"}), 4, 30.0, 1)
    assert channel.simulate(30.0).summary() == same.summary()
    delivered = sum(len(frames) for frames in channel.deliveries(30.0).values())
    assert delivered == same.summary()["delivered"]
    assert np.nanmean(channel.ages(30.0, every_ms=1.0)[1]) == pytest.approx(same.summary()["mean_age_ms"], rel=0.01)


@pytest.mark.stability
@pytest.mark.parametrize("every_ms", [0.0, -1.0, float("nan"), 1e-9])
def test_a_period_that_no_memory_holds_is_refused(every_ms):
    with pytest.raises(SimulationError, match="every_ms"):
        ff.Channel("ch5").ages(1.0, every_ms=every_ms)


@pytest.mark.stability
def test_what_is_no_channel_is_refused_and_a_dead_one_has_no_age():
    with pytest.raises(ScenarioError, match="latency"):
        ff.Channel("ch5", latency="60ms")
    with pytest.raises(ScenarioError, match="expected one of"):
        ff.Channel("ch7")
    dead = ff.Channel("ideal", faults={"loss": 1.0})
    assert np.isnan(dead.ages(1.0)[1]).all() and dead.deliveries(1.0)["cam00"].shape == (0, 2)
