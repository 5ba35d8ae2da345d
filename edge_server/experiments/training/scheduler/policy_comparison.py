"""Compares fixed policies and a learnt one in an unchanged scenario, in virtual time with computing charged.

All policies run with the scenario's own seed, for the page; the learnt one and its reference also with other
seeds, each with the same channel, motion and instants for both. To compare policies without learning over
seeds:

    python -m edge_server.experiments.training.scheduler.policy_comparison card all whittle:1 --json FILE

--costs and --slower set the costs of another machine.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from edge_server.config import ComputeConfig, read_config
from edge_server.experiments.common.arguments import add_folders, folders_of
from edge_server.experiments.common.result_store import ResultStore, content_key
from edge_server.experiments.common.source_digest import source_digest
from edge_server.experiments.common.statistics import interval, paired
from edge_server.experiments.common.tables import number
from edge_server.experiments.training.scheduler.deployed import Judged
from edge_server.experiments.training.scheduler.setting import Setting
from edge_server.experiments.training.scheduler.setting import seeds as seeds_of
from edge_server.experiments.training.scheduler.workers import WorkerPool
from edge_server.report.machine import commit, machine
from edge_server.scheduler import STATE_PARTS
from edge_server.scheduler.learned.actor import Actor
from freshfield.files import out_file, write_json
from freshfield.scenario import ScenarioError, load

LEARNT = "learnt"
REFERENCE = "all"
POLICIES = (
    REFERENCE,
    LEARNT,
    "threshold:120",
    "threshold:300",
    "wait:60",
    "freshest-k:6",
    "whittle:1",
    "aoii:1",
    "covariance:1",
    "age-driven",
)
# Decisions have no effect until the layers of a field have begun (``layered_field.PLATE_S``).
LEAD_MS = 5000.0
# For how long shown images are scored, after the lead of an episode.
SPAN_MS = 8000.0
_SHOWN = ("psnr_db", "psnr_moving_db")


def score_policies(
    setting: Setting,
    pool: WorkerPool,
    seeds: range,
    learnt: Actor,
    weights: str,
    known: Path,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The scores of all policies as JSON values (the scenario key ``edge.scores``).

    weights: name of the learnt policy's weights.
    known: file of finished runs, read and appended to.
    """
    setting = dataclasses.replace(setting, span_ms=SPAN_MS)
    own = dataclasses.replace(setting, motions=False)
    own_seed = range(setting.scenario.seed, setting.scenario.seed + 1)
    found: dict[str, Any] = {}
    for name in POLICIES:
        who = learnt if name == LEARNT else name
        found[name] = {"own_seed": _runs(own, pool, own_seed, who, weights, known)[0]}
        shown = number(found[name]["own_seed"]["psnr_db"])
        say(f"{name}: {shown} dB shown with seed {setting.scenario.seed}")
    runs = {
        who: _runs(setting, pool, seeds, learnt if who == LEARNT else who, weights, known)
        for who in (REFERENCE, LEARNT)
    }
    for who, of in _means(runs, seeds, _SHOWN).items():
        found[who] |= of
    found[LEARNT]["omega_ms"] = _by_state([run.get("omega_ms", {}) for run in runs[LEARNT]])
    say(f"{LEARNT} over {REFERENCE}: {found[LEARNT][f'psnr_db_over_{REFERENCE}']} dB over {len(seeds)} seeds")
    return {
        "scenario": setting.scenario.name,
        "seed": setting.scenario.seed,
        "seeds": len(seeds),
        "lead_s": setting.lead_ms / 1e3,
        "seconds": setting.span_ms / 1e3,
        "judged_from": setting.scoring,
        "policies": found,
        "compute": dataclasses.asdict(setting.compute),
        "machine": machine(),
    }


def _runs(
    setting: Setting, pool: WorkerPool, seeds: range, who: Judged, weights: str, known: Path
) -> list[dict[str, Any]]:
    """``WorkerPool.judge`` of each seed; those in ``known`` are not run again."""
    name = weights if isinstance(who, Actor) else str(who)
    keys = {seed: content_key([source_digest(), setting.key, name, seed], 32) for seed in seeds}
    with closing(ResultStore.in_lines(known)) as store:
        missing = [seed for seed in seeds if keys[seed] not in store.results]
        for seed, run in zip(missing, pool.judge(setting, missing, who)):
            store.put(keys[seed], result=run)
        return [store.results[keys[seed]] for seed in seeds]


def _means(runs: Mapping[str, list[dict[str, Any]]], seeds: range, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """For each policy the means of ``names``, and its shown fidelity minus that of the first policy,
    paired."""
    first, found = next(iter(runs)), {}
    for who, of in runs.items():
        found[who] = {m: interval(run[m] for run in of).rounded(4) for m in names}
        for m in _SHOWN:
            mine, base = (dict(zip(seeds, [run[m] for run in r])) for r in (of, runs[first]))
            found[who][f"{m}_over_{first}"] = paired(mine, base).rounded(4)
    return found


def _by_state(runs: list[Mapping[str, float]]) -> dict[str, list[float | None]]:
    """Mean omega in each state of the channel, with the interval over the runs that were in it."""
    states = sorted({state for run in runs for state in run})
    return {state: interval([run.get(state) for run in runs]).rounded(4) for state in states}


def compare(
    setting: Setting, pool: WorkerPool, seeds: range, names: Sequence[str], known: Path
) -> dict[str, dict[str, Any]]:
    """The fidelity that each policy shows, mean and interval over seeds, and minus that of the first one,
    paired.

    names: policies without learning, with their values.
    known: as in ``score_policies``.
    """
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for seed in seeds:  # one motion after the other, so that its images are rendered once
        for name in names:
            runs[name] += _runs(setting, pool, range(seed, seed + 1), name, "", known)
    return _means(runs, seeds, (*_SHOWN, "views", "aaoi_ms"))


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog=f"python -m {__spec__.name}",
        description="Compare what policies without learning show in a scenario in virtual time, over seeds, "
        "each minus the first.",
    )
    parser.add_argument("scenario", help="scenario file, or the name of a shipped one, with edge.compute")
    parser.add_argument("policies", nargs="+", metavar="NAME[:VALUE]", help="as edge.policy")
    parser.add_argument("--seeds", type=int, default=8, metavar="N", help="number of seeds [%(default)s]")
    parser.add_argument(
        "--seconds", type=float, default=SPAN_MS / 1e3, metavar="S", help="seconds that are scored [%(default)g]"
    )
    parser.add_argument(
        "--costs", type=Path, metavar="FILE", help="file written by `edge-server costs` [edge.compute of the scenario]"
    )
    parser.add_argument(
        "--slower",
        type=float,
        default=1.0,
        metavar="K",
        help="an edge on which all computing takes K times as long [%(default)g]",
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of worker processes [%(default)s]")
    parser.add_argument(
        "--json",
        type=out_file,
        required=True,
        metavar="FILE",
        help="write the result to FILE; finished runs are kept beside it",
    )
    add_folders(parser)
    args = parser.parse_args(argv)
    try:
        scenario = load(args.scenario)
        edge = {**scenario.edge, "policy": {"name": "all"}}
        if args.costs:
            edge["compute"] = str(args.costs.resolve())
        scenario = dataclasses.replace(scenario, edge=edge)
        compute = _slower(read_config(scenario).compute, args.slower)
        setting = Setting(scenario, lead_ms=LEAD_MS, span_ms=args.seconds * 1e3, compute=compute, parts=STATE_PARTS)
    except (ScenarioError, ValueError) as error:
        parser.error(str(error))
    args.json.parent.mkdir(parents=True, exist_ok=True)
    with WorkerPool(folders_of(args), args.jobs) as pool:
        seeds = seeds_of(scenario.seed, "test", args.seeds)
        found = compare(setting, pool, seeds, args.policies, args.json.with_suffix(".jsonl"))
    write_json(
        args.json,
        {
            "scenario": scenario.name,
            "seeds": args.seeds,
            "lead_s": LEAD_MS / 1e3,
            "seconds": args.seconds,
            "judged_from": setting.scoring,
            "motions": setting.draws_motions,
            "compute": dataclasses.asdict(compute),
            "commit": commit(),
            "policies": found,
        },
        indent=1,
    )


def _slower(costs: ComputeConfig, times: float) -> ComputeConfig:
    """``costs`` multiplied by ``times``. Raises ValueError if this is invalid or has no effect."""
    charged = dataclasses.asdict(costs)
    if not times > 0.0 or (times != 1.0 and not any(charged.values())):
        raise ValueError(f"--slower {times:g}: expected more than 0, and a scenario or --costs that charge something")
    return ComputeConfig(**{name: times * ms for name, ms in charged.items()})


if __name__ == "__main__":
    main()
