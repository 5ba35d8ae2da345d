"""Runs small deployments in virtual time, each with faults drawn from its seed, and checks invariants:
``pytest -m chaos --seeds 0..99``.

After each run: every frame is accounted for as it really ended (ledgers against what happened), queues and memory are
within their bounds, no number is NaN, every camera and the field are up to date again within 2 s of the last fault, and
a second run has the same digest. The queue discipline of a shared line may starve cameras: of these one must be up to
date.
"""

import hashlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_node.capture import Camera
from edge_server.experiments.virtual.from_scenario import training_cameras
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.simulate_command import digest
from edge_server.report.frame_accounting import FrameCounts, account_frames
from edge_server.settings import ComputeConfig
from freshfield.limits import MAX_SESSIONS_PER_CAMERA
from freshfield.scenario import Scenario
from tests.chaos.chaos_deployment import ChaosDeployment
from tests.chaos.fault_plan import FAULTS_OVER_S, QUEUE_LIMIT, SECONDS, Fault, draw_faults, scenario_of

_COMPUTE = ComputeConfig(ms_per_step=20.0, ms_per_update=20.0)
SETTINGS = RunSettings(steps=2, compute=_COMPUTE, grace_ms=500.0, epoch_ms=100.0, score_every_ms=None)
RECOVERY_S = 2.0
# Most frames inside a link: a queue's limit, plus the frame in service and the one not sampled yet.
_MOST_INSIDE = QUEUE_LIMIT + 2


def read_seeds(text: str) -> list[int]:
    """The seeds of ``A..B``, or of numbers separated by commas. Raises ValueError."""
    first, dots, last = text.partition("..")
    return list(range(int(first), int(last) + 1)) if dots else [int(word) for word in text.split(",")]


def run_seed(seed: int, only: Sequence[int] | None = None) -> dict[str, Any]:
    """Run one seed twice. only: numbers of the faults to carry out; None: all.

    Returns faults and problems (one line each), digest and the number of frames delivered.
    """
    scenario = scenario_of(seed)
    faults = [f for f in draw_faults(seed, scenario.training) if only is None or f.number in only]
    cameras = training_cameras(scenario)  # of both runs: each frame is rendered once
    first, second = (_run(scenario, cameras, faults) for _ in range(2))
    if first["digest"] != second["digest"]:
        first["problems"].append("a second run has another digest")
    return first | {"faults": [str(f) for f in faults]}


def _run(scenario: Scenario, cameras: list[Camera], faults: Sequence[Fault]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        deployment = ChaosDeployment(scenario, cameras, SETTINGS, faults, Path(folder))
        deployment.run(SECONDS)
        deployment.end()
        account = account_frames(Path(folder))
    text = json.dumps([sorted(deployment.really.items()), account.as_dict()])
    return {
        "problems": [*accounting(deployment, account), *bounds(deployment), *_recovery(deployment, faults)],
        "digest": hashlib.sha256((digest(deployment) + text).encode()).hexdigest(),
        "delivered": deployment.really["delivered"],
    }


def accounting(deployment: ChaosDeployment, account: Any) -> Iterator[str]:
    """Problems of the ledgers' accounting, compared with what really happened."""
    if account.contradictions:
        yield f"contradiction: {account.contradictions[0]}"
    yield from account.doubts
    truth = FrameCounts(deployment.really)
    if truth.as_dict() != account.total.as_dict():
        yield f"the ledgers say {account.total.as_dict()}, really {truth.as_dict()}"


def bounds(deployment: ChaosDeployment) -> Iterator[str]:
    """Violated bounds of queues and memory, and numbers that are not finite."""
    sessions = max(len(s) for s in deployment._admission._sessions.values())
    held = max((len(frames) for frames in deployment._used.values()), default=0)
    for found, most, what in (
        (deployment.most_inside, _MOST_INSIDE, "frames inside a link"),
        (deployment.damaged_admitted, 0, "damaged frames taken in"),
        (sessions, MAX_SESSIONS_PER_CAMERA, "sessions remembered of a camera"),
        (held, 2, "images kept of a camera"),
    ):
        if found > most:
            yield f"{found} {what}, at most {most} expected"
    for name, array in deployment.updates.field.state().items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            yield f"the field's {name} is not finite"
    for publication in deployment.publications:
        numbers = (publication.aaoi_ms, publication.loss or 0.0, *publication.ages_ms)
        if not np.isfinite(numbers).all():
            yield f"publication {publication.number}: a number is not finite"


def _recovery(deployment: ChaosDeployment, faults: Sequence[Fault]) -> Iterator[str]:
    """A problem if, RECOVERY_S after the end of the last fault, no frame of a camera has arrived, or the field was not
    published again. After a clock stepped back, it counts from when the clock has caught up."""
    back_ms = max((-f.value for f in faults if f.kind == "clock_step"), default=0.0)
    over_ms = max((f.at_ms + f.for_ms for f in faults), default=FAULTS_OVER_S * 1e3)
    over_ns = round((over_ms + max(0.0, back_ms)) * 1e6)
    arrivals = list(deployment.arrivals.values())
    if deployment.shared:
        arrivals = [sorted(at for each in arrivals for at in each)]
    for instants in (*arrivals, [p.published_ns for p in deployment.publications]):
        again_ns = next((at for at in instants if at >= over_ns), None)
        if again_ns is None or again_ns > over_ns + RECOVERY_S * 1e9:
            yield "cameras and field were not up to date again in time"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Seeds of --seeds: ``A..B``, or numbers separated by commas."""
    if metafunc.definition.get_closest_marker("chaos") is not None:
        metafunc.parametrize("seed", read_seeds(metafunc.config.getoption("--seeds")))


@pytest.mark.chaos
def test_a_seed_holds(seed, request):
    """--faults 0,3 runs some of its faults."""
    words = request.config.getoption("--faults")
    found = run_seed(seed, None if words is None else [int(word) for word in words.split(",") if word != "none"])
    assert found["problems"] == [], "\n".join(found["faults"])
    assert found["delivered"] > 20
