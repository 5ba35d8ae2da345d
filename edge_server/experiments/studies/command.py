"""``edge-server study``: the thesis's figures as commands, each with a verdict."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.studies.engine import Engine, StudyError
from edge_server.experiments.studies.study import Ask, Verdict, run_study
from edge_server.experiments.studies.trial import SCENARIOS, Folders
from edge_server.experiments.training.scheduler.setting import SEEDS_A_PURPOSE
from edge_server.experiments.training.scheduler.trainer import TrainingError
from edge_server.fidelity.lpips_weights import weights_folder
from freshfield.files import write_json
from freshfield.machine_load import usable_cores
from freshfield.scenario import ScenarioError

# name -> (module, class)
STUDIES = {
    "metrics": ("metric_distortions", "Metrics"),
    "mat": ("age.max_age", "Mat"),
    "mat-delay": ("age.max_age_by_delay", "MatDelay"),
    "lambda": ("age.age_weight", "Weighing"),
    "omega": ("age.omega", "Omega"),
    "images": ("age.image_count", "Images"),
    "representations": ("age.representations", "Representations"),
    "phase": ("age.trade_map", "Phase"),
    "ppo-select": ("learning.ppo_select", "PpoSelect"),
    "ppo-wait": ("learning.ppo_wait", "PpoWait"),
    "ablation": ("learning.state_ablation", "Ablation"),
    "weights": ("learning.reward_weights", "Weights"),
    "drift": ("learning.channel_drift", "Drift"),
    "transfer": ("learning.transfer", "Transfer"),
    "semantics": ("learning.semantics", "Semantics"),
    "reward-cost": ("learning.reward_cost", "RewardCost"),
}
# Those of them that are made of cases, of which some can be asked for.
CASED = ("ppo-select", "ppo-wait", "drift", "semantics", "reward-cost")
# Trainings, which go through no heap of trials: they take long, and are not part of "all".
LEARNING = (
    "ppo-select", "ppo-wait", "ablation", "weights", "drift", "transfer", "semantics", "reward-cost"
)  # fmt: skip
DESCRIPTION = """\
The thesis's figures, each with a table (CSV), a figure (PNG) and a verdict: the claim, what was found here
with 95 % intervals over seeds, and whether it holds.

  edge-server study mat --quick --out runs/study
  edge-server study all --quick --data ~/data
  edge-server study omega --seeds 20 --jobs 8 --scene kitchen --data ~/data
  edge-server study phase --ray auto

  metrics           figure 3.6: what PSNR, SSIM and LPIPS say of three artefacts
  mat               figures 5.6, 5.7: fidelity against the maximum age of used views
  mat-delay         figure 5.8: the best maximum age against the mean delay
  lambda            equation 5.8: the weight of timeliness
  omega             figures 6.3, 6.4: threshold and wait, two traffic states, with and without flush
  images            figures 6.5, 6.6: LPIPS and age against the number of images
  representations   figure 6.7: the same trade with other representations
  phase             where the trade exists: speed x delay x memory x compute, and what mask and freshen gain

  ppo-select        figure 5.9: a scheduler that learns which views to use, against everything else
  ppo-wait          figure 6.8: one that learns how long to wait, or how old is too old, by traffic
  ablation          what ages, poses and semantics in the state are worth to what is learnt
  weights           what is learnt by other weights of the reward, judged by all of them
  drift             the channel changes during use: fixed, learnt, and still learning
  transfer          learnt on one scene and channel, used on another
  semantics         where it helps to look at the pictures, and what it costs where it does not
  reward-cost       what is learnt against the time it takes, by the effort of a fit and the embedding

Studies of what learns, ppo-select and below, take half an hour to an hour each with --quick on two cores,
with one training an arm; without it, with three and more episodes, most of a day and more. In between:

  edge-server study ppo-select --quick --case priced --episodes 600
  edge-server study drift --quick --case bursts --case dies

Everything runs in virtual time from seeds: a trial gives the same figures bit for bit wherever it runs.
Results are kept in OUT/trials by content; after Ctrl-C the same command goes on with what is missing.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    base = args.data or (Path(d) if (d := os.environ.get("FRESHFIELD_DATA")) else None)
    folders = Folders(base, weights_folder(args.lpips, base))
    scenes = tuple(args.scene.split(",")) if args.scene else None
    ask = Ask(args.quick, args.out, folders, args.seeds, scenes, args.jobs, tuple(args.case), args.episodes)
    names = [n for n in STUDIES if n not in LEARNING] if args.study == "all" else [args.study]
    if args.study == "learning":
        names = list(LEARNING)
    engine = Engine(args.out / "trials", folders, args.jobs, args.ray)
    try:
        _check(ask, args.jobs)
        if set(names) <= set(LEARNING) and (scenes or args.ray):
            raise StudyError("--scene and --ray: studies that learn have scenes of their own and train here")
        if args.case and not set(names) <= set(CASED):
            raise StudyError(f"--case is for {', '.join(CASED)}")
        if args.episodes is not None and not set(names) <= set(LEARNING):
            raise StudyError(f"--episodes is for {', '.join(LEARNING)}")
        for name in names:
            _run(name, ask, engine)
    except (ScenarioError, DatasetError, StudyError, TrainingError) as error:
        print(f"edge-server study: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\nstopped; what is finished is in {engine.folder}: the same command goes on", flush=True)
        return 130
    return 0


def make_study(name: str) -> Any:
    """The study of that name; its module is imported only now."""
    module, cls = STUDIES[name]
    return getattr(importlib.import_module(f"edge_server.experiments.studies.{module}"), cls)()


def _run(name: str, ask: Ask, engine: Engine) -> list[Verdict]:
    study, began = make_study(name), time.monotonic()
    ask.out.mkdir(parents=True, exist_ok=True)
    print(f"== {name}: {study.title}", flush=True)
    verdicts = run_study(study, ask, engine)
    for verdict in verdicts:
        print("  " + verdict.line())
    seconds = time.monotonic() - began
    found = {
        "study": name, "title": study.title, "quick": ask.quick, "seconds": round(seconds, 1),
        "verdicts": [vars(v) for v in verdicts],
    }  # fmt: skip
    write_json(ask.out / f"{name}.json", found)
    print(f"  {seconds:.0f} s; {ask.out / name}.csv, .md, .json and figures", flush=True)
    return verdicts


def _check(ask: Ask, jobs: int) -> None:
    if ask.seeds is not None and not 1 <= ask.seeds <= 10_000:
        raise StudyError(f"--seeds: expected 1 to 10000, got {ask.seeds}")
    if ask.episodes is not None and not 1 <= ask.episodes <= SEEDS_A_PURPOSE:
        raise StudyError(f"--episodes: expected 1 to {SEEDS_A_PURPOSE}, got {ask.episodes}")
    if jobs < 1:
        raise StudyError(f"--jobs: expected at least 1, got {jobs}")
    for scene in ask.scenes or ():
        if scene not in SCENARIOS:
            raise StudyError(f"--scene {scene}: expected {', '.join(SCENARIOS)}")


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("edge-server study", description=DESCRIPTION, formatter_class=raw)
    cores = usable_cores()
    add = parser.add_argument
    add("study", choices=[*STUDIES, "all", "learning"], metavar="NAME",
        help=f"{', '.join(STUDIES)}; all: those before ppo-select; learning: those from it on")  # fmt: skip
    add(
        "--quick",
        action="store_true",
        help="small pictures, few points and seeds: all in a quarter of an hour, and each of those that "
        "learn in half an hour to an hour",
    )
    add("--seeds", type=int, metavar="N", help="repetitions of every point [the study's own]")
    add("--jobs", type=int, default=cores, metavar="J", help="processes [%(default)s]")
    add(
        "--case",
        action="append",
        default=[],
        metavar="WORDS",
        help=f"of {', '.join(CASED)}: only cases with these words in their name; words that no name has list "
        "them all",
    )
    add("--episodes", type=int, metavar="N", help="of one training, where there is one [the study's own]")
    add("--ray", metavar="ADDRESS", help="run on a Ray cluster instead: auto, local, or host:port")
    add("--scene", metavar="NAME,...", help=f"{', '.join(SCENARIOS)} [the study's own]")
    add("--data", type=Path, metavar="DIR", help="folder of recorded data sets [$FRESHFIELD_DATA]")
    add(
        "--lpips",
        type=Path,
        metavar="DIR",
        help="LPIPS weights [$FRESHFIELD_LPIPS, or lpips/ below the data]",
    )
    add("--out", type=Path, default=Path("runs/study"), metavar="DIR", help="[%(default)s]")
    return parser
