"""``edge-server compare``: what policies show in a scenario, over seeds, in virtual time with computing charged.

All policies run with the same channels, motions and instants, so that differences are paired by seed.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError
from edge_server.command import command_parser, exit_status
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.arguments import (
    OptionError,
    add_folders,
    add_workers,
    at_least,
    check_seconds,
    folders_of,
)
from edge_server.experiments.common.channels import read_channel
from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.common.statistics import discoveries, interval, paired
from edge_server.experiments.engine import Engine, EngineError
from edge_server.experiments.rollouts.rollout import run_rollouts
from edge_server.experiments.rollouts.setting import Setting, seeds
from edge_server.machine import commit, machine
from edge_server.scheduler import STATE_PARTS, make_policy, parse_policy, short_name
from edge_server.settings import read_config
from freshfield.files import out_file, write_json
from freshfield.scenario import Scenario, ScenarioError, load
from freshfield.settings import as_mapping

DESCRIPTION = f"""\
Compare what policies show in a scenario: every policy runs with the same seeds, each of which draws a channel,
a motion (in a synthetic scene) and the instants at which the shown image is scored on the held-out cameras.
Computing is charged as edge.compute says. The first policy is the one that the others are compared with.

  edge-server compare room19 all threshold:120 wait:60 --seeds 8
  edge-server compare card all bandit:runs/card/policy.npz --seeds 14 --json scores.json
  edge-server compare room19 all freshest-k:6 --channel my-channel.yaml
  edge-server compare card all mine.py:Mine --results runs.jsonl   after Ctrl-C run the same command again to resume

Intervals are 95 % (Student's t, over seeds; differences paired by seed). A star marks the differences that are
decided at a false discovery rate of {100 * tuned.FALSE_DISCOVERY_RATE:g} % over all of them (Benjamini-Hochberg).
"""
# metric -> (head of its column, digits, whether it is compared)
COLUMNS = {
    "psnr_db": ("shown (dB)", 2, True),
    "psnr_moving_db": ("moving pixels (dB)", 2, True),
    "ssim": ("SSIM", 3, False),
    "lpips": ("LPIPS", 3, False),
    "views": ("views", 1, False),
    "aaoi_ms": ("their age (ms)", 0, False),
}


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    errors = (ScenarioError, DatasetError, EngineError, ValueError)
    kept = f"finished runs are in {args.results}: run the same command again to resume"
    stopped = kept if args.results else "nothing was kept: with --results FILE the same command would resume"
    return exit_status("edge-server compare", lambda: _run(args), errors, stopped)


def _run(args: argparse.Namespace) -> None:
    setting = setting_of(load(args.scenario), args.seconds, args.channel)
    labels = _labels(args.policies)
    rng = np.random.default_rng(0)
    # Those that cannot be made are rejected before anything is computed.
    made = [make_policy(*parse_policy(policy), rng) for policy in labels.values()]
    if any(policy.embedding[0] for policy in made):
        setting = dataclasses.replace(setting, parts=STATE_PARTS)
    with Engine(args.results, args.jobs, args.ray, threads=1) as engine:
        table = compare(setting, folders_of(args), engine, labels, seeds(setting.scenario.seed, "test", args.seeds))
    print(as_text(table, list(labels)))
    idle = [label for label in labels if not any(table.values("views", policy=label).values())]
    if idle:
        print(f"without an update after the lead: {', '.join(idle)}")
    if args.json is not None:
        about = {"scenario": setting.scenario.name, "channel": setting.scenario.channel, "seeds": args.seeds}
        about |= {"seconds": args.seconds, "lead_s": tuned.COMPARE_LEAD_S}
        about |= {"seed": setting.scenario.seed, "judged_from": setting.rewarding, "motions": setting.draws_motions}
        about |= {"compute": as_mapping(setting.compute), "machine": machine(), "commit": commit()}
        args.json.parent.mkdir(parents=True, exist_ok=True)
        write_json(args.json, {**about, "policies": as_json(table, list(labels))}, indent=1)


def setting_of(scenario: Scenario, seconds: float, channel: str | None = None) -> Setting:
    """The setting of a comparison in a scenario as it stands.

    seconds: scored, after the lead. channel: as in ``read_channel``. Raises ScenarioError or ValueError.
    """
    check_seconds(seconds)
    if seconds * 1e3 < tuned.INSTANT_GRID_MS:
        raise OptionError(f"--seconds {seconds:g}: expected at least {tuned.INSTANT_GRID_MS / 1e3:g}")
    scenario = dataclasses.replace(scenario, edge={**scenario.edge, "policy": {"name": "all"}})
    if channel is not None:
        scenario = dataclasses.replace(scenario, channel=read_channel(channel)[0])
    compute = read_config(scenario).compute
    return Setting(scenario, deployed=True, lead_ms=tuned.COMPARE_LEAD_S * 1e3, span_ms=seconds * 1e3, compute=compute)


def compare(
    setting: Setting, folders: Folders, engine: Engine, policies: Mapping[str, str], seeds: Sequence[int]
) -> SeedTable:
    """A row for each policy and seed with the means of an episode's shown images and updates.

    policies: label -> policy as people write it. Raises ScenarioError, DatasetError, ValueError or EngineError.
    """
    found = run_rollouts(engine, setting, folders, seeds, policies, name="compare")
    return SeedTable(
        [
            {"policy": label, "seed": seed, **dataclasses.asdict(whole)}
            for label, by_seed in found.items()
            for seed, repeats in by_seed.items()
            if (whole := repeats[0][0].whole) is not None
        ]
    )


def as_text(table: SeedTable, labels: Sequence[str]) -> str:
    """The table for people: means with intervals, and differences to the first policy."""
    first, others = labels[0], labels[1:]
    compared = [(label, metric) for label in others for metric, (_, _, of) in COLUMNS.items() if of]
    gaps = {at: paired(table.values(at[1], policy=at[0]), table.values(at[1], policy=first)) for at in compared}
    same = [gap.low == gap.high == 0.0 for gap in gaps.values()]  # decided, but no difference
    p_values = [1.0 if equal else gap.p_value(0.0) for equal, gap in zip(same, gaps.values())]
    stars = dict(zip(gaps, discoveries(p_values)))
    head = ["policy"]
    for name, _, of in COLUMNS.values():
        head += [name, f"minus {first}"] if of else [name]
    lines = [head]
    for label in labels:
        cells = [label]
        for metric, (_, digits, of) in COLUMNS.items():
            cells.append(interval(table.values(metric, policy=label).values()).text(digits))
            if of:
                gap = gaps.get((label, metric))
                cells.append("" if gap is None else gap.text(digits) + " *" * stars[label, metric])
        lines.append(cells)
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths)).rstrip() for line in lines)


def as_json(table: SeedTable, labels: Sequence[str]) -> dict[str, Any]:
    """The comparison as JSON values: [mean, low, high] of each policy's metrics and of their differences to the first
    policy."""
    found: dict[str, Any] = {}
    for label in labels:
        row: dict[str, Any] = {}
        for metric, (_, _, of) in COLUMNS.items():
            values = table.values(metric, policy=label)
            row[metric] = interval(values.values()).rounded(4)
            if of:
                row[f"{metric}_over_{labels[0]}"] = paired(values, table.values(metric, policy=labels[0])).rounded(4)
        found[label] = row
    return found


def _labels(policies: Sequence[str]) -> dict[str, str]:
    """Label -> policy; a learned policy is named without its folder where that tells it apart."""
    short = [short_name(policy) for policy in policies]
    return {label if short.count(label) == 1 else policy: policy for label, policy in zip(short, policies)}


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("edge-server compare", DESCRIPTION)
    add = parser.add_argument
    add("scenario", help="scenario file, or the name of a shipped one; needs a held-out camera")
    add(
        "policies",
        nargs="+",
        metavar="POLICY",
        help="as edge.policy, with its value: all, threshold:120, bandit:FILE, FILE.py:CLASS (docs/scheduling.md)",
    )
    add("--seeds", type=at_least(1), default=8, metavar="N", help="number of seeds [%(default)s]")
    add("--channel", metavar="FILE|PRESET", help="a channel in place of the scenario's: a file, or a preset")
    add(
        "--seconds",
        type=float,
        default=tuned.COMPARE_SPAN_S,
        metavar="S",
        help=f"seconds scored, after {tuned.COMPARE_LEAD_S:g} [%(default)g]",
    )
    add_workers(parser)
    add("--json", type=out_file, metavar="FILE", help="write the comparison to FILE")
    add("--results", type=out_file, metavar="FILE", help="keep finished runs in FILE, and use those it has [none]")
    add_folders(parser)
    return parser
