"""``edge-server study``: the thesis's figures as commands, each with a verdict."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

from camera_node.sources.datasets.records import DatasetError
from edge_server.command import command_parser, exit_status
from edge_server.embed import EmbeddingError
from edge_server.experiments.common.arguments import add_folders, add_workers, at_least, folders_of
from edge_server.experiments.common.channels import read_channel
from edge_server.experiments.engine import EngineError
from edge_server.experiments.studies.registry import CAPTURING, CASED, DEPLOYED, LEARNING, ON_A_CHANNEL, STUDIES
from edge_server.experiments.studies.study import StudyError, StudyRequest, run_study
from edge_server.experiments.studies.trial import scenario_of, scene_label
from edge_server.experiments.training.trainer import TrainingError
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.viewpoints.candidates import ViewpointError
from freshfield.files import out_folder
from freshfield.scenario import ScenarioError

DESCRIPTION = f"""\
Reproduce the thesis's figures, each with a table (CSV), figures (PNG) and a page of verdicts (Markdown): the
claim, what was found here with 95 % intervals over seeds, and whether it holds, corrected for the number of
verdicts.

  edge-server study mat --quick --out runs/study
  edge-server study all --quick --data ~/data
  edge-server study omega --quick --channel my-channel.yaml --scene my-scene.yaml
  edge-server study omega --seeds 20 --jobs 8 --scene kitchen --data ~/data
  edge-server study mat --ray auto

{"".join(f"  {name:17} {study.title}{chr(10)}" for name, study in STUDIES.items())}
Studies that train policies, ppo-select and below, take half an hour to an hour each with --quick on two
cores, with one training per variant; without it, with three, most of a day or more. In between:

  edge-server study ppo-select --quick --case priced --episodes 600

Everything runs in virtual time from seeds: a trial gives the same figures bit for bit wherever it runs on one
kind of processor. Results are kept in OUT/results by what determines them; after Ctrl-C the same command
continues.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)

    def work() -> None:
        channel, channel_name = (None, "") if args.channel is None else read_channel(args.channel)
        request = StudyRequest(
            quick=args.quick,
            out=args.out,
            folders=folders_of(args),
            seeds=args.seeds,
            scenes=tuple(args.scene.split(",")) if args.scene else None,
            channel=channel,
            channel_name=channel_name,
            channel_given=args.channel or "",
            jobs=args.jobs,
            ray=args.ray,
            cases=tuple(args.case),
            episodes=args.episodes,
        )
        names = {"all": [n for n in STUDIES if n not in (*CAPTURING, *LEARNING, *DEPLOYED)], "learning": list(LEARNING)}
        chosen = checked(names.get(args.study, [args.study]), request)
        judged = {metric for name in chosen for metric in STUDIES[name].metrics}
        if judged & {"lpips", "f_w"} and (missing := open_lpips(request.folders.lpips)[1]):
            print(f"without LPIPS and what is computed from it: {missing}", flush=True)
        for name in chosen:
            study, began = STUDIES[name], time.monotonic()
            print(f"== {name}: {study.title}", flush=True)
            for verdict in run_study(study, request):
                print("  " + verdict.line())
            print(f"  {time.monotonic() - began:.0f} s; {request.out / name}.md, .csv and figures", flush=True)

    errors = (ScenarioError, DatasetError, StudyError, EngineError, TrainingError, ViewpointError, EmbeddingError)
    stopped = f"what is finished is in {args.out}: run the same command again to resume"
    return exit_status("edge-server study", work, errors, stopped)


def checked(names: list[str], request: StudyRequest) -> list[str]:
    """The names of studies. Raises StudyError if the request does not suit all of them, ScenarioError for a scene
    that cannot be read."""
    for scene in request.scenes or ():
        try:
            found = scenario_of(scene)
        except ScenarioError as error:
            raise StudyError(f"--scene: {error}") from None
        if {"arm", "host"} & set(found.source) and not set(names) <= set(CAPTURING):
            raise StudyError(f"--scene {scene}: its camera moves, which studies do not simulate")
        if not found.held_out and not set(names) <= set(CAPTURING):
            raise StudyError(f"--scene {scene}: no camera is held out (cameras.held_out), so that nothing is scored")
    labels = [scene_label(scene) for scene in request.scenes or ()]
    if twice := [label for label in labels if labels.count(label) > 1]:
        raise StudyError(f"--scene: two are called {twice[0]} and would be taken for one: give the files other names")
    limits = [
        (request.scenes, {*STUDIES} - {*LEARNING}, "--scene: it has scenes of its own"),
        (request.ray, {*STUDIES} - {*CAPTURING}, "--ray: captures are made on this machine"),
        (request.channel is not None, {*ON_A_CHANNEL}, f"--channel is for {', '.join(ON_A_CHANNEL)}"),
        (request.cases, {*CASED}, f"--case is for {', '.join(CASED)}"),
        (request.episodes is not None, {*LEARNING}, f"--episodes is for {', '.join(LEARNING)}"),
    ]
    for given, suited, why in limits:
        if given and not set(names) & suited:
            raise StudyError(f"{', '.join(names)}: {why}")
    return names


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("edge-server study", DESCRIPTION)
    add = parser.add_argument
    add(
        "study",
        choices=[*STUDIES, "all", "learning"],
        metavar="NAME",
        help=f"{', '.join(STUDIES)}; all: up to representations; learning: from ppo-select on",
    )
    add("--quick", action="store_true", help="small images, few points and seeds: a quarter of an hour for all")
    add("--seeds", type=at_least(1), metavar="N", help="seeds per point [the study's own]")
    add_workers(parser)
    add(
        "--case",
        action="append",
        default=[],
        metavar="WORDS",
        help=f"only cases with these words in their name, in {', '.join(CASED)}; words that no name has list all cases",
    )
    add("--episodes", type=at_least(1), metavar="N", help="episodes of each training [the study's own]")
    add(
        "--scene",
        metavar="NAME|FILE,...",
        help="scenarios with fixed cameras of which some are held out, such as kitchen, dynerf or my-scene.yaml "
        "(viewpoints and preferences: cell, too); room means room19; depth keeps their channels, the others take "
        "them where --channel names them [the study's own]",
    )
    add(
        "--channel",
        metavar="FILE|PRESET",
        help="the channel, in place of the study's: a preset, a scenario's file, or one of its channel section alone",
    )
    add_folders(parser)
    add("--out", type=out_folder, default="runs/study", metavar="DIR", help="folder to write [%(default)s]")
    return parser
