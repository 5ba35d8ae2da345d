"""``edge-server costs``: measures the time of a scenario's updates on this machine, to be charged in virtual
time.

The deployment runs in virtual time with updates of several lengths. Each is timed, and a cost per update, per
step and per frame taken in is fitted to the times. The training and rendering of the static field of layers,
which live run beside the updates, are not charged.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from camera_node.sources.datasets.records import DatasetError
from edge_server.command import command_parser, exit_status
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.arguments import add_folders, check_seconds, folders_of
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.machine import machine, versions
from edge_server.settings import ComputeConfig, EdgeConfig, read_config
from freshfield.files import out_file, write_json
from freshfield.scenario import Scenario, ScenarioError, load
from freshfield.settings import as_mapping

DESCRIPTION = """\
Measure what an update of a scenario takes on this machine: milliseconds per update, step and frame taken in.
Name the file in the scenario (edge.compute: FILE); training and simulation then charge these times.

  edge-server costs card --out deploy/scenarios/card/costs.json
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("edge-server costs", DESCRIPTION)
    parser.add_argument("scenario", help="scenario file, or the name of a shipped one")
    parser.add_argument(
        "--seconds",
        type=float,
        default=10.0,
        metavar="S",
        help="seconds of virtual time of each of three runs [%(default)g]",
    )
    parser.add_argument("--out", type=out_file, required=True, metavar="FILE", help="JSON file to write")
    add_folders(parser)
    args = parser.parse_args(argv)

    def work() -> None:
        check_seconds(args.seconds)
        found = measure(load(args.scenario), args.seconds, folders_of(args).data)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(args.out, found, indent=1)
        print(", ".join(f"{name} {ms:g}" for name, ms in found["compute"].items() if ms), f"-> {args.out}")

    return exit_status("edge-server costs", work, (ScenarioError, DatasetError, ValueError), "nothing was written")


def measure(scenario: Scenario, seconds: float, data: Path | None = None) -> dict[str, Any]:
    """Measure the costs of a scenario's updates. seconds: virtual time of each of three runs.

    Returns ``compute`` (the fields of ``ComputeConfig``) and how it was measured. Raises ScenarioError,
    DatasetError, or ValueError if there are too few updates.
    """
    scenario = dataclasses.replace(
        scenario, edge={**scenario.edge, "policy": {"name": "all"}, "compute": "zero", "embedding": None}
    )
    rows = np.concatenate([_timed(scenario, share, seconds, data) for share in tuned.COSTS_SHARES])
    compute = fitted(rows)
    return {
        "compute": as_mapping(compute),
        "scenario": scenario.name,
        "updates": len(rows),
        "median_ms": round(float(np.median(rows[:, 2])), 3),
        "machine": machine(),
        "versions": versions(),
    }


def fitted(rows: NDArray[np.float64]) -> ComputeConfig:
    """Fit the costs by non-negative least squares. rows: (n, 3): steps, frames taken in, milliseconds."""
    kept = rows[rows[:, 2] <= np.quantile(rows[:, 2], 1.0 - tuned.COSTS_SLOWEST_SHARE)]
    design = np.column_stack([kept[:, :2], np.ones(len(kept))])
    a_step, a_view, an_update = (round(float(ms), 3) for ms in nnls(design, kept[:, 2])[0])
    return ComputeConfig(ms_per_step=a_step, ms_per_update=an_update, ms_per_view=a_view)


def _timed(scenario: Scenario, share: float, seconds: float, data: Path | None) -> NDArray[np.float64]:
    """Steps, frames taken in and milliseconds of the updates of a run, (n, 3). share: of the scenario's
    steps."""

    def settings(edge: EdgeConfig) -> RunSettings:
        return RunSettings(steps=max(1, round(share * edge.steps)), epoch_ms=tuned.COSTS_EPOCH_MS, score_every_ms=None)

    def camera_moves(edge: EdgeConfig, camera: str) -> None:
        rows.clear()  # of a field that it will not have
        deployment.settings = settings(edge)

    rows: list[tuple[float, float, float]] = []
    deployment = build_deployment(scenario, settings(read_config(scenario)), data=data, on_motion=camera_moves)
    updates, fit = deployment.updates, deployment.updates.fit

    def timed(selection: Any, budget: Any) -> Any:
        before_s, began_s = getattr(updates.field, "beside_s", 0.0), time.perf_counter()
        done = fit(selection, budget)
        spent_s = time.perf_counter() - began_s - (getattr(updates.field, "beside_s", 0.0) - before_s)
        if done is not None:
            rows.append((done[1].steps, selection.arrivals, 1e3 * spent_s))
        return done

    updates.field.warm_up(len(updates.buffer.cameras))
    updates.fit = timed  # type: ignore[method-assign]
    deployment.run(seconds)
    if len(rows) < 2:
        raise ValueError(f"{scenario.path}: no updates in {seconds:g} s of virtual time")
    return np.array(rows[round(tuned.COSTS_SETTLED_SHARE * len(rows)) :], float)
