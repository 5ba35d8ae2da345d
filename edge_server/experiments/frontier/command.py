"""``edge-server frontier``: measures fidelity against computing time, from scratch and of live updates."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError
from camera_node.synthetic.scene import SCENES
from edge_server.edge_defaults import FIELD
from edge_server.experiments.common.arguments import add_lpips, command_parser, parse_options, run_command
from edge_server.experiments.common.result_store import ResultStore, content_key, settings_digest
from edge_server.experiments.frontier import effort_sweep, update_time
from edge_server.experiments.frontier.output import recommendation, write_output
from edge_server.experiments.scenes.multiview_still import MultiviewStill, open_still
from edge_server.experiments.virtual.virtual_deployment import Compute
from edge_server.fidelity.lpips import Lpips
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fields.registry import field_names, make_field
from edge_server.report.machine import machine, versions
from edge_server.scheduler import make_policy, parse_policy
from freshfield.files import out_file, out_folder, write_json
from freshfield.scenario import ScenarioError

DESCRIPTION = """\
Fidelity against time, in two figures.

  edge-server frontier --quick --out runs/frontier
  edge-server frontier --scene room --seeds 3 --lpips ~/data/lpips
  edge-server frontier --scene ~/data/lego --scale 2 --holdout 8 --field all

1. From scratch: PSNR, SSIM and LPIPS on a held-out camera against seconds of fitting, for each effort level
   of the field, with the Pareto front marked. The time of a step on this machine is measured on the way.
2. Live: the scene moves, the network delays, and an update that takes longer shows an older world. The whole
   deployment runs in virtual time, which charges the measured time of an update of the moving scene (a step,
   and the rest), so this figure is the same bit for bit for one seed and one such measurement. It says how
   long an update should take at each speed, judged by what is shown at random instants. One curve is splat in
   layers, updated on arrivals: there the time is that from one update to the next.

The last line says which edge.update_ms figure 2 recommends. The page and the report of a scenario that names
the file (frontier: OUT/frontier.json) draw it, with the run's own point.

Every finished point is saved in OUT/frontier.json. After Ctrl-C the same command continues where it stopped;
with other settings, points are measured anew.
"""


Row = dict[str, Any]


@dataclass(frozen=True)
class Sweep:
    """The range of a measurement.

    seeds: number of seeds.
    planned_s: seconds of fitting from scratch.
    speeds: speeds of the moving scene, m/s.
    update_s: seconds per update.
    run_s: virtual seconds of a moving run; six updates if those take longer.
    efforts: effort levels of the moving runs.
    warm_steps: steps of the warm field before a moving run.
    size: image width and height of the still scene.
    """

    seeds: int
    planned_s: tuple[float, ...]
    speeds: tuple[float, ...]
    update_s: tuple[float, ...]
    run_s: float
    efforts: tuple[str, ...]
    warm_steps: int
    size: int
    moving: update_time.MovingScene


QUICK = Sweep(
    seeds=1,
    planned_s=(0.5, 1.0, 2.0, 4.0, 8.0),
    speeds=(0.3, 1.0, 3.0),
    update_s=(0.1, 0.25, 0.5, 1.0, 2.0),
    run_s=4.0,
    efforts=("low", "medium", "layers"),
    warm_steps=150,
    size=128,
    moving=update_time.MovingScene(cameras=13, size=64),
)
FULL = Sweep(
    seeds=3,
    planned_s=(0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0),
    speeds=(0.3, 1.0, 3.0),
    update_s=(0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0),
    run_s=20.0,
    efforts=("low", "medium", "high", "layers"),
    warm_steps=600,
    size=128,
    moving=update_time.MovingScene(cameras=19, size=128),
)

LAYERS_S = 0.02  # shortest update time of layers, as used in scenarios with layers

# The sweep of the shipped points, for scenarios without a frontier of their own. Unlike --quick, it measures
# the cost of a step with as many and as large views as the runs have.
SHIPPED = replace(
    FULL,
    planned_s=(0.5, 1.0, 2.0, 4.0, 8.0),
    update_s=(0.05, 0.1, 0.2, 0.5, 1.0, 2.0),
    run_s=8.0,
    efforts=("low", "medium", "layers"),
)


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    try:
        frontier = _frontier(args, QUICK if args.quick else SHIPPED if args.shipped else FULL)
    except (DatasetError, ScenarioError, ValueError) as error:
        print(f"edge-server frontier: {error}", file=sys.stderr)
        return 2
    stopped = f"what was measured is in {frontier.file.path}: the same command goes on"
    return run_command("frontier", frontier.run, (), stopped)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("frontier", DESCRIPTION)
    add = parser.add_argument
    size = parser.add_mutually_exclusive_group().add_argument
    size("--quick", action="store_true", help="a smaller sweep: four minutes on two cores, not one to two hours")
    size("--shipped", action="store_true", help="the sweep that is shipped, with --field all --points FILE")
    add("--scene", default="room", metavar="NAME|DATA", help="scene: room, tile or a data set [%(default)s]")
    add("--holdout", default="8", metavar="K|NAME,...", help="views of a data set to test on, as in fit [%(default)s]")
    add("--scale", type=float, default=1.0, metavar="K", help="divide image sizes of a data set by K [%(default)g]")
    add("--frame", type=int, default=0, metavar="N", help="frame of a moving data set, from 0 [%(default)s]")
    add("--field", metavar="NAME,...|all", default=FIELD, help="representations [%(default)s]")
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the field, as in fit; may be repeated",
    )
    add("--policy", default="all", metavar="NAME[:VALUE]", help="update policy in figure 2 [%(default)s]")
    add("--seeds", type=int, metavar="N", help="number of seeds [1 with --quick, else 3]")
    add("--seed", type=int, default=0, metavar="N", help="first random seed [%(default)s]")
    add_lpips(parser)
    add("--points", type=out_file, metavar="FILE", help="also write the points of figure 2 to FILE")
    add("--out", type=out_folder, default="runs/frontier", metavar="DIR", help="folder to write [%(default)s]")
    return parser


def _frontier(args: argparse.Namespace, sweep: Sweep) -> Frontier:
    name, value = parse_policy(args.policy)
    policy = make_policy(name, value, np.random.default_rng(0))
    sweep = replace(sweep, moving=replace(sweep.moving, policy=name, policy_value=policy.value))
    if args.seeds is not None:
        if args.seeds < 1:
            raise ValueError(f"--seeds {args.seeds}: expected 1 or more")
        sweep = replace(sweep, seeds=args.seeds)
    fields = field_names() if args.field == "all" else tuple(args.field.split(","))
    if unknown := set(fields) - set(field_names()):
        raise ValueError(f"no field is called {', '.join(unknown)}; there are: {', '.join(field_names())}")
    options = parse_options(args.option)
    levels = [level for field in fields for level in effort_sweep.efforts(field, options)]
    for level in levels:
        make_field(level.field, level.options)  # rejects wrong options now, not between two measurements
    still = open_still(args.scene, sweep.size, args.holdout, args.scale, args.frame)
    args.out.mkdir(parents=True, exist_ok=True)
    file = FrontierFile(args.out / "frontier.json")
    lpips, missing = open_lpips(args.lpips)
    return Frontier(args.out, file, sweep, still, args.scene, fields, levels, lpips, missing, args.seed, args.points)


class FrontierFile:
    """The file frontier.json: every finished point with its settings, written after each new point."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data: Row = {"points": {}}
        if path.is_file():
            try:
                self.data["points"] = dict(json.loads(path.read_text())["points"])
            except (ValueError, KeyError, TypeError):
                print(f"{path}: not readable, measured anew", flush=True)
        self._store = ResultStore(self.data["points"], lambda *_: self.write())

    def get(self, settings: Row, compute: Callable[[], Row]) -> tuple[Row, bool]:
        """The point with these settings, and whether it had to be measured."""
        key = content_key(settings)
        known = self._store.find(key, settings=settings) is not None
        return self._store.get(key, compute=compute, settings=settings), not known

    def write(self, **more: Any) -> None:
        self.data.update(more)
        write_json(self.path, self.data)


@dataclass
class Frontier:
    """A run of the command: measures the missing points, then writes tables, CSV, figures and conclusion."""

    out: Path
    file: FrontierFile
    sweep: Sweep
    still: MultiviewStill
    scene: str
    fields: tuple[str, ...]
    levels: list[effort_sweep.Effort]
    lpips: Lpips | None
    lpips_missing: str | None
    seed: int
    points: Path | None = None

    def run(self) -> None:
        begun = time.perf_counter()
        print(f"{self.still.describe()}, {len(self.still.held_out)} held out", flush=True)
        rows = effort_sweep.medians(self._from_scratch())
        effort_sweep.mark_front(rows)
        charged: dict[str, Compute] = {}
        if self.scene == "room":
            charged = self._charged()
            updates = self._updates(charged)
        else:
            updates = []
            why = "it needs the exact truth at any instant, which only a synthetic scene has (--scene room)"
            if self.scene in SCENES:
                why = f"nothing moves in {self.scene}"
            print(f"figure 2 left out: {why}", flush=True)
        self.file.write(
            scene=self.still.describe(),
            fields=list(self.fields),
            policy=self.sweep.moving.policy,
            channel=self.sweep.moving.channel,
            lpips_network=self.lpips.network if self.lpips else None,
            lpips_missing=self.lpips_missing,
            machine=machine(),
            versions=versions(),
            ms_per_step=effort_sweep.costs(rows),
            charged={label: asdict(compute) for label, compute in charged.items()},
            from_scratch=rows,
            updates=updates,
        )
        print(write_output(self.out, self.file.data), flush=True)
        if self.points is not None:
            about = {k: self.file.data[k] for k in ("scene", "policy", "channel", "machine")}
            write_json(self.points, {**about, "updates": [*self._other_points(), *updates]})
        print(f"{self.file.path} ({time.perf_counter() - begun:.0f} s)", flush=True)
        print(recommendation(updates), flush=True)

    def _other_points(self) -> list[Row]:
        """Points in the FILE of --points of representations and efforts that are not measured now."""
        assert self.points is not None
        known = json.loads(self.points.read_text())["updates"] if self.points.is_file() else []
        return [row for row in known if f"{row['field']} {row['effort']}" not in {e.label for e in self._live}]

    @property
    def _seeds(self) -> range:
        return range(self.seed, self.seed + self.sweep.seeds)

    def _from_scratch(self) -> list[Row]:
        levels = [e for e in self.levels if e.still]
        todo = [(s, e, p) for s in self._seeds for e in levels for p in self.sweep.planned_s]
        points = []
        for number, (seed, effort, planned_s) in enumerate(todo, 1):
            settings: Row = {
                "figure": 1,
                "scene": self.still.describe(),
                **_settings(effort),
                "seconds": planned_s,
                "seed": seed,
                "lpips": self.lpips is not None,
            }
            measure = partial(effort_sweep.fit_from_scratch, effort, self.still, planned_s, seed, self.lpips)
            point, new = self.file.get(settings, measure)
            points.append({**point, "planned_s": planned_s, "effort": effort.label})
            print(
                f"[{number}/{len(todo)}] {effort.label:22} {planned_s:5.2f} s {point['steps']:6d} steps  "
                f"PSNR {_db(point['psnr_db'])}{_known(new)}",
                flush=True,
            )
        return points

    @property
    def _live(self) -> list[effort_sweep.Effort]:
        return [e for e in self.levels if e.name in self.sweep.efforts]

    def _charged(self) -> dict[str, Compute]:
        """Cost of an update of each effort in virtual time, measured on this machine with the number of
        images of the moving scene and the image size of figure 1."""
        sweep, found = self.sweep, {}
        moving, speed = replace(sweep.moving, size=sweep.size), sweep.speeds[len(sweep.speeds) // 2]
        for effort in self._live:
            settings: Row = {
                "figure": "charged",
                **asdict(moving),
                "speed_m_per_s": speed,
                **_settings(effort),
                "warm_steps": sweep.warm_steps,
            }
            measure = partial(_measured_compute, moving, speed, effort, sweep.warm_steps)
            row, new = self.file.get(settings, measure)
            compute = found[effort.label] = Compute(**{k: v for k, v in row.items() if k != "settings"})
            print(
                f"updates of a moving scene, {effort.label}: {compute.ms_per_step:.1f} ms a step, "
                f"{compute.ms_per_view:.1f} ms a new view, {compute.ms_per_update:.1f} ms for everything "
                f"else{_known(new)}",
                flush=True,
            )
        return found

    def _updates(self, charged: dict[str, Compute]) -> list[Row]:
        """Rows of figure 2 for every update time, effort and speed, as means over the seeds."""
        sweep, rows = self.sweep, []
        runs = list(product(self._live, sweep.speeds, self._seeds))
        times = {e.name: (LAYERS_S, *sweep.update_s) if e.name == "layers" else sweep.update_s for e in self._live}
        count = sum(len(times[effort.name]) for effort, _, _ in runs)
        for effort, speed, seed in runs:
            # Made only for the first new point, so a resumed sweep makes only those that it still needs.
            of = (sweep.moving, speed, effort.field, effort.options, seed, sweep.warm_steps)
            start = cache(partial(update_time.WarmStart, *of))
            compute = charged[effort.label]
            for update_s in times[effort.name]:
                seconds, layers = max(sweep.run_s, 6.0 * update_s), effort.name == "layers"
                steps = update_time.static_steps(update_s) if layers else update_time.steps_for(update_s, compute)
                every_s = update_s if layers else 0.0
                settings: Row = {
                    "figure": 2,
                    **asdict(sweep.moving),
                    "speed_m_per_s": speed,
                    **_settings(effort),
                    "warm_steps": sweep.warm_steps,
                    "steps": steps,
                    "seed": seed,
                    "seconds": seconds,
                    "compute": asdict(compute),
                    "lpips": self.lpips is not None,
                    "every_s": every_s,
                }
                point, new = self.file.get(
                    settings, partial(_moving_run, start, steps, compute, seconds, self.lpips, every_s)
                )
                rows.append(
                    {
                        **point,
                        "field": effort.field,
                        "effort": effort.name,
                        "options": effort.options,
                        "speed_m_per_s": speed,
                        "planned_update_s": update_s,
                        "seed": seed,
                    }
                )
                print(
                    f"[{len(rows)}/{count}] {effort.label:16} {speed:g} m/s, "
                    f"update {point['update_s']:5.2f} s  shown {_db(point['shown_psnr_db'])}  "
                    f"moving {_db(point['shown_psnr_moving_db'])}{_known(new)}",
                    flush=True,
                )
        return update_time.mean_over_seeds(rows)


def _settings(effort: effort_sweep.Effort) -> Row:
    """Settings of an effort that determine a result."""
    digest = settings_digest(effort.field, effort.options)
    return {"field": effort.field, "options": effort.options, "defaults": digest}


def _moving_run(start: Callable[[], update_time.WarmStart], *how: Any) -> Row:
    return start().run(*how)


def _measured_compute(
    moving: update_time.MovingScene, speed: float, effort: effort_sweep.Effort, warm_steps: int
) -> Row:
    return asdict(update_time.measure_compute(moving, speed, effort.field, effort.options, warm_steps))


def _known(new: bool) -> str:
    return "" if new else "  (known)"


def _db(value: float | None) -> str:
    return "   -   " if value is None else f"{value:5.2f} dB"
