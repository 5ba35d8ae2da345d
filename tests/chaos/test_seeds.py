"""Deployments with faults drawn from seeds: ``pytest -m chaos --seeds 0..99``; what is broken on purpose is found."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_server.report import frame_accounting
from tests.chaos import seeds
from tests.chaos.chaos_deployment import ChaosDeployment
from tests.chaos.fault_plan import FAULTS_OVER_S, Fault, draw_faults, scenario_of

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


CRASHES = tuple(Fault(k, "crash", 500.0 + 200 * k, 150.0, role) for k, role in enumerate(("node", "emulator", "edge")))


def run(tmp_path: Path, faults: tuple[Fault, ...], seed: int = 11) -> ChaosDeployment:
    scenario = scenario_of(seed)
    deployment = ChaosDeployment(scenario, seeds.training_cameras(scenario), seeds.SETTINGS, faults, tmp_path)
    deployment.run(2.0)
    deployment.end()
    return deployment


def test_what_a_crashed_process_held_is_gone_and_accounted_for(tmp_path: Path) -> None:
    deployment = run(tmp_path, CRASHES)
    assert deployment.restarts == {"node": 1, "emulator": 1, "edge": 1}
    assert {f.session for f in deployment.updates.buffer.newest().values()} == {"restart-1"}
    assert deployment.really["broken"] > 0, "the edge was away"
    assert list(seeds.accounting(deployment, frame_accounting.account_frames(tmp_path))) == []


def lose_a_line(patch: pytest.MonkeyPatch) -> None:
    written = []
    whole = ChaosDeployment._write

    def write(self, role, event, *about):
        written.append(event)
        if written.count("delivered") % 20 or event != "delivered":
            whole(self, role, event, *about)

    patch.setattr(ChaosDeployment, "_write", write)


def forget_kills(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(frame_accounting, "_cut_off_ends", lambda ledgers: [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("broken", "fault", "says"),
    [(lose_a_line, Fault(0, "away", 500.0, 100.0, "cam01"), "off by"), (forget_kills, CRASHES[1], "in no ledger")],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_is_broken_is_found(broken, fault: Fault, says: str, tmp_path: Path, monkeypatch) -> None:
    broken(monkeypatch)
    deployment = run(tmp_path, (fault,))
    account = frame_accounting.account_frames(tmp_path)
    assert any(says in problem for problem in (*seeds.accounting(deployment, account), *seeds.bounds(deployment)))
