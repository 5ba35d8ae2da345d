"""Deployments with faults drawn from seeds: ``pytest -m chaos --seeds 0..99``."""

from __future__ import annotations

import pytest

from tests.chaos import seeds
from tests.chaos.chaos_deployment import ChaosDeployment
from tests.chaos.fault_plan import FAULTS_OVER_S, draw_faults, scenario_of

CAMERAS = ("cam01", "cam02", "cam03", "cam04")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Seeds of --seeds: ``A..B``, or numbers separated by commas."""
    if metafunc.definition.get_closest_marker("chaos") is not None:
        metafunc.parametrize("seed", seeds.read_seeds(metafunc.config.getoption("--seeds")))


@pytest.fixture
def faults(request: pytest.FixtureRequest) -> list[int] | None:
    """Numbers of the faults to carry out; None: all."""
    words = request.config.getoption("--faults")
    return None if words is None else [int(word) for word in words.split(",") if word != "none"]


@pytest.mark.chaos
def test_a_seed_holds(seed: int, faults: list[int] | None) -> None:
    found = seeds.run_seed(seed, faults)
    assert found["problems"] == [], "\n".join(found["faults"])  # --faults 0,3 runs some of them
    assert found["delivered"] > 20


def test_seeds_draw_every_kind_of_fault_and_all_are_over_in_time() -> None:
    drawn = [fault for seed in range(50) for fault in draw_faults(seed, CAMERAS)]
    kinds = {name.removeprefix("_do_") for name in dir(ChaosDeployment) if name.startswith("_do_")}
    assert {f.kind for f in drawn} == kinds
    assert {f.target for f in drawn if f.kind == "crash"} == {"node", "emulator", "edge"}
    assert all(f.at_ms + f.for_ms <= 1e3 * FAULTS_OVER_S for f in drawn)
    assert draw_faults(3, CAMERAS) == draw_faults(3, CAMERAS) != draw_faults(4, CAMERAS)
    assert len({str(scenario_of(seed).channel) for seed in range(50)}) > 10
