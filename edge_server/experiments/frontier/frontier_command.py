"""``edge-server frontier``: measures fidelity against computing time, from scratch and of live updates."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.command import command_parser, exit_status
from edge_server.experiments.common.arguments import add_lpips, add_workers, at_least, parse_options
from edge_server.experiments.engine import Engine, EngineError
from edge_server.experiments.experiment_constants import LAYERS_S
from edge_server.experiments.frontier import from_scratch, update_time
from edge_server.experiments.frontier.from_scratch import Fit, Still
from edge_server.experiments.frontier.output import recommendation, write_output
from edge_server.experiments.frontier.update_time import (
    CHANNEL,
    POLICY,
    Charged,
    MovingRun,
    MovingScene,
    field_label,
    variants,
)
from edge_server.fidelity.lpips_weights import open_lpips, weights_folder
from edge_server.fields.registry import FIELD, field_names, make_field
from edge_server.machine import machine, versions
from edge_server.settings import ComputeConfig
from freshfield.files import out_folder, write_json
from freshfield.scenario import ScenarioError

DESCRIPTION = """\
Fidelity against time, in two figures.

  edge-server frontier --quick --out runs/frontier
  edge-server frontier --scene room --seeds 3 --lpips ~/data/lpips
  edge-server frontier --scene ~/data/lego --scale 2 --field all

1. From scratch: PSNR, SSIM and LPIPS on a held-out camera against seconds of fitting, for each
   representation, with the Pareto front marked. The time of a step on this machine is measured on the way.
2. Live: the scene moves, the network delays, and an update that takes longer shows an older world. The whole
   deployment runs in virtual time, which charges the measured time of an update of the moving scene (a step,
   and the rest), so this figure is the same bit for bit for one seed and one such measurement. It says how
   long an update should take at each speed, judged by what is shown at random instants. One curve is splat in
   layers, updated on arrivals: there the time is that from one update to the next.

The last line says which edge.update_ms figure 2 recommends. The page and the report of a scenario that names
the file (frontier: OUT/frontier.json) draw it, with the run's own point.

Times are measured one after another in this process; --jobs and --ray share out the runs of figure 2.
Every finished point is kept in OUT/results.jsonl. After Ctrl-C the same command continues where it stopped;
with other settings or other code, points are measured anew.
"""


Row = dict[str, Any]


@dataclass(frozen=True)
class Sweep:
    """The range of a measurement.

    seeds: number of seeds.
    planned_s: seconds of fitting from scratch.
    speeds: speeds of the moving scene, m/s.
    update_s: seconds per update.
    run_s: virtual seconds of a moving run that count; six updates if those take longer.
    size: image width and height of the still scene.
    """

    seeds: int
    update_s: tuple[float, ...]
    run_s: float
    moving: MovingScene
    planned_s: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)
    speeds: tuple[float, ...] = (0.3, 1.0, 3.0)
    size: int = 128


QUICK = Sweep(seeds=1, update_s=(0.1, 0.25, 0.5, 1.0, 2.0), run_s=4.0, moving=MovingScene(cameras=13, size=64))
# Unlike QUICK, it measures the cost of a step with as many and as large views as the runs have.
FULL = Sweep(seeds=3, update_s=(0.05, 0.1, 0.2, 0.5, 1.0, 2.0), run_s=8.0, moving=MovingScene(cameras=19, size=128))


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    errors = (DatasetError, EngineError, ScenarioError, ValueError)
    stopped = f"what was measured is in {args.out}: run the same command again to resume"
    return exit_status("edge-server frontier", lambda: _run(args), errors, stopped)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("edge-server frontier", DESCRIPTION)
    add = parser.add_argument
    add("--quick", action="store_true", help="a smaller sweep: four minutes on two cores, not half an hour")
    add("--scene", default="room", metavar="NAME|DATA", help="scene: room, tile or a data set [%(default)s]")
    add("--scale", type=float, default=1.0, metavar="K", help="divide image sizes of a data set by K [%(default)g]")
    add("--field", metavar="NAME,...|all", default=FIELD, help="representations [%(default)s]")
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the field, as in fit; may be repeated",
    )
    add("--seeds", type=at_least(1), metavar="N", help="number of seeds [1 with --quick, else 3]")
    add_workers(parser)
    add_lpips(parser)
    add("--out", type=out_folder, default="runs/frontier", metavar="DIR", help="folder to write [%(default)s]")
    return parser


def _run(args: argparse.Namespace) -> None:
    """Measure the missing points, then write tables and figures."""
    sweep = QUICK if args.quick else FULL
    if args.seeds is not None:
        sweep = replace(sweep, seeds=args.seeds)
    fields = field_names() if args.field == "all" else tuple(args.field.split(","))
    options = parse_options(args.option)
    for field in fields:
        make_field(field, options)  # rejects wrong options now, not between two measurements
    scene = Still(args.scene, sweep.size, args.scale)
    begun, still = time.perf_counter(), from_scratch.views_of(scene)
    lpips, missing = open_lpips(args.lpips)
    weights = None if lpips is None else weights_folder(args.lpips)
    print(f"{still.describe()}, {len(still.held_out)} held out", flush=True)
    results = args.out / "results.jsonl"
    # Times are measured one after another in this process; runs in virtual time are shared out.
    with Engine(results) as engine, Engine(results, args.jobs, args.ray, threads=1) as workers:
        rows = _from_scratch(engine, sweep, scene, fields, options, weights)
        moves = args.scene == "room"
        charged, updates = _live(engine, workers, sweep, fields, options, weights) if moves else ({}, [])
    if not moves:
        print("figure 2 left out: it needs a scene that moves, and its truth at any instant (--scene room)", flush=True)
    data = {
        "scene": still.describe(),
        "policy": POLICY,
        "channel": CHANNEL,
        "machine": machine(),
        "versions": versions(),
        "fields": list(fields),
        "lpips_network": "alex" if weights else None,
        "lpips_missing": missing,
        "ms_per_step": from_scratch.costs(rows),
        "charged": charged,
        "from_scratch": rows,
        "updates": updates,
    }
    write_json(args.out / "frontier.json", data)
    print(write_output(args.out, data), flush=True)
    print(f"{args.out / 'frontier.json'} ({time.perf_counter() - begun:.0f} s)", flush=True)
    print(recommendation(updates), flush=True)


def _from_scratch(
    engine: Engine, sweep: Sweep, scene: Still, fields: Sequence[str], options: Row, weights: Path | None
) -> list[Row]:
    """Rows of figure 1."""
    every = product(range(sweep.seeds), fields, sweep.planned_s)
    fits = [Fit(scene, field, seconds, seed, options) for seed, field, seconds in every]
    points = engine.run(
        partial(from_scratch.fit_from_scratch, weights=weights),
        fits,
        "from scratch",
        files=lambda fit: [*fit.still.files, weights],
    )
    return from_scratch.curves(fits, points)


def _live(
    engine: Engine, workers: Engine, sweep: Sweep, fields: Sequence[str], options: Row, weights: Path | None
) -> tuple[Row, list[Row]]:
    """What updates are charged, and the rows of figure 2 as means over the seeds."""
    measured_of = variants(fields, options)
    # With the number of images of the moving scene and the image size of figure 1.
    moving, speed = replace(sweep.moving, size=sweep.size), sweep.speeds[len(sweep.speeds) // 2]
    asked = [Charged(moving, speed, variant) for variant in measured_of]
    measured = engine.run(update_time.measure_compute, asked, "cost of updates")
    runs = []
    for (variant, row), speed, seed in product(zip(measured_of, measured), sweep.speeds, range(sweep.seeds)):
        times = (LAYERS_S, *sweep.update_s) if variant.layers else sweep.update_s
        compute = ComputeConfig(**row)
        runs += [MovingRun(sweep.moving, speed, variant, seed, s, max(sweep.run_s, 6.0 * s), compute) for s in times]
    points = workers.run(
        partial(update_time.run_updates, weights=weights),
        runs,
        "updates",
        files=lambda run: [weights],
        group=lambda run: (run.variant.field, run.variant.layers, run.speed),  # they share their renderings
    )
    rows = [{**point, **run.facts()} for run, point in zip(runs, points)]
    charged = {field_label(variant.field, variant.layers): row for variant, row in zip(measured_of, measured)}
    return charged, update_time.mean_over_seeds(rows)
