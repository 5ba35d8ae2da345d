"""``edge-server study``: the thesis's figures as commands, each with a verdict."""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Sequence
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.common.arguments import add_folders, command_parser, folders_of, run_command
from edge_server.experiments.studies.engine import Engine, StudyError
from edge_server.experiments.studies.study import StudyRequest, run_study
from edge_server.experiments.studies.trial import SCENARIOS, scenario_of
from edge_server.experiments.training.scheduler.setting import SEEDS_A_PURPOSE
from edge_server.experiments.training.scheduler.trainer import TrainingError
from edge_server.fields.registry import field_names
from edge_server.viewpoints.candidates import ViewpointError
from freshfield.files import out_folder
from freshfield.machine_load import usable_cores
from freshfield.scenario import ScenarioError

# name -> (module, class, one line of help)
STUDIES = {
    "metrics": ("metric_distortions", "Metrics", "figure 3.6: what PSNR, SSIM and LPIPS say about three artifacts"),
    "mat": ("age.max_age", "Mat", "figures 5.6, 5.7: fidelity against the maximum age of used views"),
    "mat-delay": ("age.max_age_by_delay", "MatDelay", "figure 5.8: the best maximum age against the mean delay"),
    "lambda": ("age.age_weight", "Weighing", "equation 5.8: fidelity against the weight of timeliness"),
    "omega": (
        "age.omega",
        "Omega",
        "figures 6.3, 6.4: threshold and wait in both interpretations, by traffic and queue; flush",
    ),
    "images": ("age.image_count", "Images", "figures 6.5, 6.6: LPIPS and age against the number of images"),
    "representations": (
        "age.representations",
        "Representations",
        "figure 6.7: the same trade-off with other representations",
    ),
    "phase": ("age.trade_map", "Phase", "where the trade-off exists: speed x delay x memory x compute"),
    "viewpoints": (
        "viewpoints",
        "Viewpoints",
        "tables 4.1, 4.3, figures 4.7, 4.8: which views to take of a static object",
    ),
    "preferences": (
        "preferences",
        "Preferences",
        "figure 4.6, tables 4.2, 4.3: what is learned from simulated experts' preferences",
    ),
    "ppo-select": (
        "learning.ppo_select",
        "PpoSelect",
        "figure 5.9: a scheduler that learns which views to use, against all other policies",
    ),
    "ppo-wait": (
        "learning.ppo_wait",
        "PpoWait",
        "figure 6.8: a scheduler that learns how long to wait, or a maximum age, by traffic",
    ),
    "ablation": (
        "learning.state_ablation",
        "Ablation",
        "how much ages, poses and semantics in the state contribute to a learned policy",
    ),
    "weights": (
        "learning.reward_weights",
        "Weights",
        "policies learned with other weights of the reward, judged by all of them",
    ),
    "drift": (
        "learning.channel_drift",
        "Drift",
        "the channel changes during use: a fixed policy, and ones learned before and after",
    ),
    "semantics": (
        "learning.semantics",
        "Semantics",
        "where image embeddings in the state help, and their cost where they do not",
    ),
}
# Studies that consist of cases: --case selects some of them.
CASED = ("ppo-select", "ppo-wait", "drift", "semantics", "ablation")
# Studies that train: they take long and are not part of "all".
LEARNING = tuple(name for name, (module, *_) in STUDIES.items() if module.startswith("learning."))
# Studies of captures: they run in this process, and are not part of "all" either.
CAPTURING = ("viewpoints", "preferences")
DESCRIPTION = f"""\
Reproduce the thesis's figures, each with a table (CSV), a figure (PNG) and a verdict: the claim, what was
found here with 95 % intervals over seeds, and whether it holds.

  edge-server study mat --quick --out runs/study
  edge-server study all --quick --data ~/data
  edge-server study omega --seeds 20 --jobs 8 --scene kitchen --data ~/data
  edge-server study phase --ray auto

{"".join(f"  {name:17} {line}{chr(10)}" for name, (_, _, line) in STUDIES.items())}
Studies that train policies, ppo-select and below, take half an hour to an hour each with --quick on two
cores, with one training per variant; without it, with three or more, most of a day or more. In between:

  edge-server study ppo-select --quick --case priced --episodes 600
  edge-server study drift --quick --case bursts --case dies
  edge-server study ablation --quick --case flush --episodes 60

Everything runs in virtual time from seeds: a trial gives the same figures bit for bit wherever it runs on one
kind of processor. Results are kept in OUT/trials by settings and processor; after Ctrl-C the same command
continues.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    folders = folders_of(args)
    scenes = tuple(args.scene.split(",")) if args.scene else None
    request = StudyRequest(
        quick=args.quick,
        out=args.out,
        folders=folders,
        seeds=args.seeds,
        scenes=scenes,
        jobs=args.jobs,
        cases=tuple(args.case),
        episodes=args.episodes,
        field=args.field,
    )
    engine = Engine(args.out / "trials", folders, args.jobs, args.ray)

    def work() -> None:
        names = {"all": [n for n in STUDIES if n not in (*CAPTURING, *LEARNING)], "learning": list(LEARNING)}
        for name in _checked(names.get(args.study, [args.study]), request, args.ray):
            _run(name, request, engine)

    errors = (ScenarioError, DatasetError, StudyError, TrainingError, ViewpointError)
    stopped = f"what is finished is in {engine.folder}: the same command goes on"
    return run_command("study", work, errors, stopped)


def make_study(name: str) -> Any:
    """Import and make the study of that name."""
    module, cls, _ = STUDIES[name]
    return getattr(importlib.import_module(f"edge_server.experiments.studies.{module}"), cls)()


def _run(name: str, request: StudyRequest, engine: Engine) -> None:
    study, began = make_study(name), time.monotonic()
    print(f"== {name}: {study.title}", flush=True)
    for verdict in run_study(study, request, engine):
        print("  " + verdict.line())
    print(f"  {time.monotonic() - began:.0f} s; {request.out / name}.csv, .md, .json and figures", flush=True)


def _checked(names: list[str], request: StudyRequest, ray: str | None) -> list[str]:
    """Return the names of studies. Raises StudyError if the request does not suit all of them."""
    if request.seeds is not None and not 1 <= request.seeds <= 10_000:
        raise StudyError(f"--seeds: expected 1 to 10000, got {request.seeds}")
    if request.episodes is not None and not 1 <= request.episodes <= SEEDS_A_PURPOSE:
        raise StudyError(f"--episodes: expected 1 to {SEEDS_A_PURPOSE}, got {request.episodes}")
    if request.jobs < 1:
        raise StudyError(f"--jobs: expected at least 1, got {request.jobs}")
    for scene in request.scenes or ():
        try:
            found = scenario_of(scene)
        except ScenarioError as error:
            raise StudyError(f"--scene: {error}") from None
        if scene != found.path.stem and scene not in SCENARIOS:
            raise StudyError(f"--scene {scene}: expected the name of a shipped scenario")
        if {"arm", "host"} & set(found.source) and not set(names) <= set(CAPTURING):
            raise StudyError(f"--scene {scene}: its camera moves, which studies do not simulate")
    if set(names) <= set(LEARNING) and (request.scenes or ray):
        raise StudyError("--scene and --ray: studies that learn have scenes of their own and train here")
    if set(names) <= set(CAPTURING) and ray:
        raise StudyError("--ray: captures are made in this process")
    own = {*LEARNING, *CAPTURING, "metrics", "representations"}
    if set(names) <= own and request.field != "splat":
        raise StudyError(f"--field: {', '.join(names)} has representations of its own, or none")
    if request.cases and not set(names) <= set(CASED):
        raise StudyError(f"--case is for {', '.join(CASED)}")
    if request.episodes is not None and not set(names) <= set(LEARNING):
        raise StudyError(f"--episodes is for {', '.join(LEARNING)}")
    return names


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("study", DESCRIPTION)
    add = parser.add_argument
    add(
        "study",
        choices=[*STUDIES, "all", "learning"],
        metavar="NAME",
        help=f"{', '.join(STUDIES)}; all: up to phase; learning: from ppo-select on",
    )
    add(
        "--quick",
        action="store_true",
        help="small images, few points and seeds: a quarter of an hour for all, half an hour to an hour for "
        "each study that trains",
    )
    add("--seeds", type=int, metavar="N", help="seeds per point [the study's own]")
    add("--jobs", type=int, default=usable_cores(), metavar="N", help="number of worker processes [%(default)s]")
    add(
        "--case",
        action="append",
        default=[],
        metavar="WORDS",
        help=f"only cases with these words in their name, in {', '.join(CASED)}; words that no name has list all cases",
    )
    add("--episodes", type=int, metavar="N", help="episodes of each training [the study's own]")
    add("--ray", metavar="ADDRESS", help="run on a Ray cluster instead: auto, local, or host:port")
    add(
        "--scene",
        metavar="NAME,...",
        help="shipped scenarios with fixed cameras, such as kitchen or dynerf (viewpoints and preferences: "
        "cell, too); room means room19 [the study's own]",
    )
    add(
        "--field",
        choices=field_names(),
        default="splat",
        help="representation, unless the study names its own [%(default)s]",
    )
    add_folders(parser)
    add("--out", type=out_folder, default="runs/study", metavar="DIR", help="folder to write [%(default)s]")
    return parser
