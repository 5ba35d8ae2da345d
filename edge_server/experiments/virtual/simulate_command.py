"""``edge-server simulate``: a scenario's whole deployment in virtual time, repeatable bit for bit."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import itertools
import json
import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import asdict

from camera_node.capture import build_cameras
from camera_node.settings import source_config
from edge_server.command import command_parser, exit_status
from edge_server.experiments.common.arguments import add_folders, at_least, check_seconds, folders_of
from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.tables import mean_or_none, number
from edge_server.experiments.engine import processor
from edge_server.experiments.experiment_constants import CYCLE_MS, PROGRESS_EVERY_S, SCORED_EVERY_MS
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.now_and_all import NowAndAll
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import SHOWN, Score, Scorer
from edge_server.live.output.journal import shown_line
from edge_server.live.state import Publication
from edge_server.machine import run_facts, versions
from edge_server.report.report_constants import FINAL_PART, FINAL_SHARE
from edge_server.scheduler import parse_policy, short_name
from edge_server.scheduler.learned.decision_record import DecisionWriter
from edge_server.settings import (
    ComputeConfig,
    EdgeConfig,
    PolicyConfig,
    cameras_move,
    described,
    embedding_for,
    read_config,
)
from freshfield.files import out_folder, write_json, write_text
from freshfield.scenario import Scenario, ScenarioError, load
from freshfield.settings import as_mapping, read_settings

DESCRIPTION = """\
Run cameras, emulated network, buffer, policy and field of a scenario in virtual time: no ports, no waiting.

  edge-server simulate room --seconds 10
  edge-server simulate room19 --policy threshold:120 --seed 3 --json
  edge-server simulate room --compute 4:30 --steps 60 --out runs/virtual

The parts are the live ones, faults included; only the clock differs. An update takes a number of optimizer
steps, and they take virtual time: none, as in the thesis, or ms per step and ms per update (edge.compute of
the scenario, or --compute; edge-server costs measures them). The same seed gives the same result on the same
kind of processor: the printed digest covers every publication and the field's parameters.
"""
_METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips", "aaoi_ms")


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    return exit_status("edge-server simulate", lambda: _simulate(args), ValueError)


def _simulate(args: argparse.Namespace) -> None:
    folders = folders_of(args)
    decisions: DecisionWriter | None = None
    chosen: list[str] = []

    def published(publication: Publication) -> None:
        if decisions is not None:
            decisions.record(deployment.updates.policy, publication.number)

    def say(line: str) -> None:
        chosen.append(line)
        if not args.json:
            print(line, flush=True)

    scenario = _scenario(args)
    config = read_config(scenario)
    deployment, missing = open_simulation(scenario, folders, lambda new: _settings(new, args), say, published)
    if args.out is not None:
        for earlier in (args.out / "decisions").glob("*.npz"):  # of another run in this folder: explain would take them
            if earlier.stem.isdigit() or earlier.stem.startswith("policy-"):
                earlier.unlink()
        decisions = DecisionWriter(args.out, embedding_for(config, deployment.updates.policy))
    watched = None
    if scenario.held_out_every:
        kept = build_cameras(scenario, source_config(scenario), scenario.held_out, folders.data)
        watched = NowAndAll(deployment, kept, args.seconds, config.background)
    _run(deployment, args.seconds, quiet=args.json)
    found = {**summary(scenario, deployment, args.seconds), "field": config.field, "chosen": chosen[-1]}
    if missing:
        found["lpips_missing"] = missing
    elif config.lpips != "none":
        found["lpips_network"] = config.lpips
    if watched is not None:
        found["now_and_all"] = watched.means()
    if args.out is not None:
        write_output(args.out, found, deployment, scenario.channel.get("preset"), watched)
    print(json.dumps(found) if args.json else "\n  ".join([show(found), *deployment.updates.troubles]))


def open_simulation(
    scenario: Scenario,
    folders: Folders,
    settings_of: Callable[[EdgeConfig], RunSettings],
    say: Callable[[str], None] = lambda line: None,
    on_published: Callable[[Publication], None] | None = None,
) -> tuple[VirtualDeployment, str | None]:
    """A scenario's deployment in virtual time, ready to run, and why LPIPS is not measured, if so.

    settings_of: how it runs, by the edge's configuration, which is another one once a camera is seen to move.
    say: gets one line on what the configuration chose.
    on_published: see ``build_deployment``.
    Raises ScenarioError or DatasetError.
    """
    config = read_config(scenario)
    say(described(scenario, config, "a camera" if cameras_move(scenario) else ""))
    metric, missing = None, None
    if config.lpips != "none":
        metric, missing = open_lpips(folders.lpips)

    def camera_moves(new: EdgeConfig, camera: str) -> None:
        deployment.settings = settings_of(new)
        say(described(scenario, new, camera))

    deployment = build_deployment(
        scenario,
        settings_of(config),
        scorer=Scorer(metric, config.background),
        data=folders.data,
        on_published=on_published,
        on_motion=camera_moves,
    )
    return deployment, missing


def with_policy(scenario: Scenario, text: str) -> Scenario:
    """A scenario with a policy as people write it, such as ``threshold:120``, in place of its own. Raises
    ScenarioError where its value is not a number."""
    try:
        policy = as_mapping(PolicyConfig(*parse_policy(text)))
    except ValueError as error:
        raise ScenarioError(f"--policy {error}") from None
    return dataclasses.replace(scenario, edge={**scenario.edge, "policy": policy})


def summary(scenario: Scenario, deployment: VirtualDeployment, seconds: float) -> dict[str, Any]:
    """A run's frame counts, means over its last fifth, and a digest for comparing runs, as plain values.

    last_fifth: scores at publication, the thesis's measure. shown: scores of the images at random instants.
    shown_curve_db: [seconds, PSNR of the image shown, of its moving pixels], means of half a second each.
    seconds_to_1_db: the first of them from which on a second's mean is within 1 dB of the last fifth's.
    """
    publications = deployment.publications
    from_s = (1.0 - FINAL_SHARE) * seconds
    shown = [s for s in deployment.shown if s.published_ns >= 1e9 * from_s]
    late = [p for p in publications if p.t_s >= from_s]
    curve, end_db = shown_curve(deployment.shown), mean_or_none([s.psnr_db for s in shown])
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "seconds": seconds,
        "policy": deployment.updates.policy.name,
        "value": deployment.updates.policy.value,
        "steps": deployment.settings.steps,
        "compute": as_mapping(deployment.settings.compute),
        "updates": len(publications),
        "frames": deployment.frames(),
        "last_fifth": {name: mean_or_none([getattr(p, name) for p in late]) for name in _METRICS},
        "shown": {name: mean_or_none([getattr(s, name) for s in shown]) for name in SHOWN},
        "shown_curve_db": curve,
        "seconds_to_1_db": None if end_db is None else seconds_to(end_db - 1.0, curve),
        "views": mean_or_none([float(len(p.selected)) for p in publications]),
        "update_ms": mean_or_none([p.update_ms for p in publications]),
        "digest": digest(deployment),
        "processor": processor(),
        "versions": versions(),
    }


def shown_curve(shown: Sequence[Score]) -> list[tuple[float, float | None, float | None]]:
    """See ``summary``. shown: in the order of their instants."""
    out = []
    for half, scores in itertools.groupby(shown, lambda score: int(score.published_ns // 500_000_000)):
        kept = list(scores)
        whole, moving = (mean_or_none([getattr(s, name) for s in kept]) for name in SHOWN[:2])
        out.append((half / 2, whole, moving))
    return out


def seconds_to(least_db: float, curve: Sequence[tuple[float, float | None, float | None]]) -> float | None:
    """The instant of a curve, see ``summary``, from which on a second's mean is ``least_db``; None: never."""
    for (begin_s, now_db, _), (_, next_db, _) in itertools.pairwise(curve):
        if now_db is not None and next_db is not None and (now_db + next_db) / 2 >= least_db:
            return begin_s
    return None


def digest(deployment: VirtualDeployment) -> str:
    """SHA-256 of all publications and of the field's state, in hexadecimal."""
    found = hashlib.sha256()
    for publication in deployment.publications:
        found.update(json.dumps(dataclasses.asdict(publication), sort_keys=True).encode())
    for name, array in sorted(deployment.updates.field.state().items()):
        found.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def write_output(
    out: Path,
    found: dict[str, Any],
    deployment: VirtualDeployment,
    channel: str | None = None,
    watched: NowAndAll | None = None,
) -> None:
    """Write OUT/simulation.json, and what a live run writes for its report: edge.json, channel.json, and lines for each
    publication and each scored instant (series.jsonl, shown.jsonl). channel: its preset. watched: of held-out cameras
    that move. Raises OSError."""
    publications = deployment.publications
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "simulation.json", found)
    names = ("scenario", "seed", "seconds", "policy", "value", "chosen", "lpips_missing", "lpips_network")
    write_json(
        out / "edge.json",
        {
            "kind": "simulated",
            "run": run_facts(),
            "field": found["field"],
            "troubles": deployment.updates.troubles,
            "so_far": asdict(watched.rows[-1][1]) if watched is not None and watched.rows else None,
            **{name: found[name] for name in names if name in found},
        },
    )
    write_json(out / "channel.json", {"preset": channel})
    lines = [json.dumps(dataclasses.asdict(p)) for p in publications]
    write_text(out / "series.jsonl", "".join(line + "\n" for line in lines))
    instants = [p.published_ns for p in publications]
    lines = []
    for score in deployment.shown:
        behind = publications[bisect_right(instants, score.published_ns) - 1]
        t_s = behind.t_s + (score.published_ns - behind.published_ns) / 1e9
        lines.append(shown_line(t_s, score, behind, None if watched is None else watched.at(t_s)))
    write_text(out / "shown.jsonl", "".join(line + "\n" for line in lines))


def show(found: dict[str, Any]) -> str:
    """The summary for a terminal."""
    value = "" if found["value"] is None else f" {found['value']:g}"
    cost = found["compute"]
    charged = f"{cost['ms_per_step']:g} ms a step, {cost['ms_per_update']:g} ms an update"
    cost_text = charged if any(cost.values()) else "free of charge"
    now_and_all = found.get("now_and_all") or {}
    lines = [
        f"{found['scenario']}, seed {found['seed']}, {found['seconds']:g} s of virtual time, "
        f"{short_name(found['policy'])}{value}",
        f"  updates     {found['updates']} of {found['steps']} steps, {cost_text}",
        f"  views       {number(found['views'], 1)} an update",
        f"  {FINAL_PART}  " + ", ".join(f"{k} {number(v, 3)}" for k, v in found["last_fifth"].items()),
        "  shown       " + ", ".join(f"{k} {number(v, 3)}" for k, v in found["shown"].items()),
        *(["  since 4 s   " + ", ".join(f"{k} {number(v, 3)}" for k, v in now_and_all.items())] if now_and_all else []),
        f"  seconds until within 1 dB of that: {number(found['seconds_to_1_db'], 1)}",
        "  frames      " + ", ".join(f"{k} {v}" for k, v in found["frames"].items() if v),
        f"  digest      {found['digest'][:32]} on {found['processor']}",
    ]
    return "\n".join(lines)


def _run(deployment: VirtualDeployment, seconds: float, quiet: bool) -> None:
    began, done_s = time.monotonic(), 0.0
    while done_s < seconds:
        step_s = min(PROGRESS_EVERY_S, seconds - done_s)
        deployment.run(step_s)
        done_s += step_s
        if not quiet:
            spent = time.monotonic() - began
            left = spent / done_s * (seconds - done_s)
            found = deployment.publications
            psnr = f", PSNR {number(found[-1].psnr_db, 2)}" if found else ""
            print(f"  {done_s:g} of {seconds:g} s: {len(found)} updates{psnr}; {left:.0f} s left", flush=True)


def _scenario(args: argparse.Namespace) -> Scenario:
    scenario = load(args.scenario, args.seed)
    if args.policy:
        scenario = with_policy(scenario, args.policy)
    edge = dict(scenario.edge)
    if args.compute:
        edge["compute"] = as_mapping(_compute(args.compute))
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)  # before the work, not after it
    check_seconds(args.seconds)
    return dataclasses.replace(scenario, edge=edge)


def usual_settings(config: EdgeConfig) -> RunSettings:
    """What an ``edge:`` section says of a run, scored at random instants. Two decisions are a live update's time apart
    if updates follow arrivals, else at most CYCLE_MS."""
    return RunSettings(
        steps=config.steps,
        compute=config.compute,
        epoch_ms=config.update_ms if config.updates == "arrivals" else min(config.update_ms, CYCLE_MS),
        grace_ms=config.grace_ms,
        score_every_ms=SCORED_EVERY_MS,
        shown_every_ms=SCORED_EVERY_MS,
    )


def _settings(config: EdgeConfig, args: argparse.Namespace) -> RunSettings:
    found = usual_settings(config)
    return found if args.steps is None else dataclasses.replace(found, steps=args.steps)


def _compute(text: str) -> ComputeConfig:
    if text == "zero":
        return ComputeConfig()
    step, _, update = text.partition(":")
    try:
        found = {"ms_per_step": float(step), "ms_per_update": float(update or 0.0)}
        return read_settings(ComputeConfig, found, "--compute")
    except ValueError:
        raise ScenarioError(f"--compute {text}: expected zero, or ms a step and ms an update such as 4:30") from None


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("edge-server simulate", DESCRIPTION)
    add = parser.add_argument
    add("scenario", help="scenario file, or the name of a shipped one")
    add("--seconds", type=float, default=10.0, metavar="S", help="seconds of virtual time [%(default)g]")
    add("--seed", type=int, metavar="N", help="random seed, in place of the scenario's")
    add(
        "--policy",
        metavar="NAME[:VALUE]",
        help="in place of the scenario's: all, threshold:120, bandit:FILE, FILE.py:CLASS (docs/scheduling.md)",
    )
    add("--steps", type=at_least(1), metavar="N", help="optimizer steps of an update [edge.steps, else 100]")
    add("--compute", metavar="zero|MS:MS", help="ms per step and ms per update [edge.compute, else zero]")
    add_folders(parser)
    add(
        "--out",
        type=out_folder,
        metavar="DIR",
        help="folder to write simulation.json, what edge-server report reads and a learned policy's decisions to",
    )
    add("--json", action="store_true", help="print the result as one JSON object")
    return parser
