"""The channel in virtual time, and the same as the library's ``Channel``."""

import numpy as np
import pytest

import freshfield as ff
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import LinkRun, SimulationError, simulate
from freshfield.scenario import ScenarioError
from tests.support import refused


def decisions(run: LinkRun) -> list[tuple]:
    return [(t.offered_ns, t.outcome, t.started_ns, t.due_ns) for t in run.transits]


def test_adding_and_renaming_cameras_changes_nothing_for_the_others():
    config = channel_from_mapping({"preset": "ch6"})
    few = [decisions(run) for run in simulate(config, ["b", "d"], 20, 3).runs]
    many = [decisions(run) for run in simulate(config, ["a", "b", "c", "d"], 20, 3).runs]
    assert few == [many[1], many[3]] and many[0] != many[1]
    assert few[0] != decisions(simulate(config, ["b", "d"], 20, 4).runs[0])


def test_impossible_requests_are_refused():
    for more, why in (
        ({"cameras": 10_001}, "cameras"),
        ({"frame_period_ms": float("nan")}, "frame_period_ms"),
        ({"frame_bytes": -1}, "frame_bytes"),
        ({"seconds": 1e7}, "frames"),
    ):
        refused(SimulationError, why, simulate, channel_from_mapping({}), **{"cameras": 1, "seconds": 1, **more})


def test_the_librarys_channel_is_the_one_that_the_command_simulates():
    """Its ages are the sawtooth of its deliveries."""
    channel = ff.Channel("ch5", service="exp:90ms", cameras=3, seed=5)
    same = simulate(channel_from_mapping({"preset": "ch5", "service": "exp:90ms"}), 3, 4.0, 5)
    deliveries = channel.deliveries(4.0).values()
    assert sum(map(len, deliveries)) == same.summary()["delivered"]
    t_s, ages_ms = channel.ages(4.0, every_ms=7.0)
    assert ages_ms.shape == (3, len(t_s)) and t_s[-1] <= 4.0
    for row, frames in zip(ages_ms, deliveries):
        for at_ms, age_ms in zip(t_s * 1e3, row):
            captured = [c for c, arrived in frames if arrived <= at_ms]
            expected = at_ms - max(captured) if captured else np.nan
            assert age_ms == pytest.approx(expected, abs=1e-6, nan_ok=True)


@pytest.mark.stability
def test_what_is_no_channel_or_no_period_is_refused_and_a_dead_one_has_no_age():
    for every_ms in (0.0, -1.0, float("nan"), 1e-9):
        refused(SimulationError, "every_ms", ff.Channel("ch5").ages, 1.0, every_ms=every_ms)
    refused(ScenarioError, "latency", ff.Channel, "ch5", latency="60ms")
    dead = ff.Channel("ideal", faults={"loss": 1.0})
    assert np.isnan(dead.ages(1.0)[1]).all() and dead.deliveries(1.0)["cam00"].shape == (0, 2)
