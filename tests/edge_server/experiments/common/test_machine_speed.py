"""How fast the machine was meanwhile."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from edge_server.experiments.common.machine_speed import MachineSpeed, median_s, speed_text


@pytest.fixture
def speed() -> Iterator[MachineSpeed]:
    made = MachineSpeed()
    yield made
    made.close()


def test_medians_are_over_the_samples_since_the_last_call(speed: MachineSpeed) -> None:
    assert speed.medians() == {}
    for _ in range(3):
        speed.sample()
    row = speed.medians()
    assert list(row) == ["multiply_adds_g_per_s", "reads_4mb_m_per_s"]
    # A core of any age that runs this does a billion of one and 10 million of the other; none does 10,000
    # billion multiply-adds, or reads faster than once a cycle with each of its units.
    assert 1.0 < row["multiply_adds_g_per_s"] < 1e5 and 10.0 < row["reads_4mb_m_per_s"] < 1e6
    assert speed.medians() == {}


def test_multiply_adds_are_no_fewer_than_numpy_makes(speed: MachineSpeed) -> None:
    a = np.ones((512, 512), np.float32)
    ours, theirs = [], []
    for _ in range(5):  # turn by turn: a shared machine changes its speed
        speed.sample()
        ours.append(speed.medians()["multiply_adds_g_per_s"])
        theirs.append(512**3 / median_s(3, lambda: np.matmul(a, a)) / 1e9)
    assert max(ours) > 0.7 * max(theirs)  # equal at best; less only where others come in between


def test_the_time_of_work_is_a_median_without_the_first() -> None:
    naps = iter([0.2, 0.01, 0.03, 0.01])
    assert 0.01 <= median_s(3, lambda: time.sleep(next(naps))) < 0.03


def test_what_was_not_measured_is_a_dash() -> None:
    assert speed_text(None) == speed_text({}) == "-"
    assert speed_text({"a": 121.4, "b": 2030.9}) == "121, 2,031"
