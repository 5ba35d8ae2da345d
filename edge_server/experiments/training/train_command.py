"""``edge-server train-scheduler``: trains a scheduler in virtual time, with real field fits as reward."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from functools import partial

from camera_node.sources.datasets.records import DatasetError
from camera_node.synthetic.scene_parameters import BaseParams
from edge_server.command import command_parser, exit_status
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.arguments import add_folders, add_workers, folders_of
from edge_server.experiments.common.folders import Folders
from edge_server.experiments.engine import EngineError
from edge_server.experiments.rollouts.setting import Setting, layout_of, reward_of, seeds
from edge_server.experiments.training.learning_curve import draw_curve
from edge_server.experiments.training.trainer import TrainingConfig, TrainingError, read_log, train
from edge_server.scheduler import BANDIT, STATE_PARTS
from edge_server.scheduler.learned.learner_spec import ACTIONS, Spec
from edge_server.scheduler.learned.learning_constants import OMEGAS_MS
from edge_server.scheduler.learned.rewards import REWARDS
from edge_server.settings import read_config
from freshfield.files import out_folder, write_csv
from freshfield.scenario import Scenario, ScenarioError, load
from freshfield.settings import read_settings

DESCRIPTION = """\
Learn when to update the field and from which views: decisions are drawn from the scenario in virtual time,
each action is carried out by a real field fit and rewarded on a held-out camera at the instant of
publication.

  edge-server train-scheduler room19 --out runs/select
  edge-server train-scheduler room19 --kind wait --reward corrected --episodes 200 --out runs/wait
  edge-server run room --policy bandit:runs/select/policy.npz

  --kind select      a set of cameras, Bernoulli each (thesis 5.4, algorithm 1)
  --kind threshold   how old a view may be (6.3)
  --kind wait        how long to wait for views generated meanwhile (6.3)
  --kind wait-arrived   the same for views that arrive meanwhile, however old (6.16, algorithm 2)

  --on whole | moving   pixels that the reward's PSNR is over. In a scene that hardly moves, the whole image
                        teaches to ignore how old views are; where nothing moves there are no moving pixels

  --reward set        0.02 PSNR + 0.5 SSIM - LPIPS (5.19); default for select
  --reward corrected  -F_w (6.36-6.38) with the sign of SSIM corrected; default for threshold and wait
  --reward thesis     -F_w as printed, which rewards a worse SSIM

An episode is --decisions decisions at random instants. At each, --samples actions are carried out from copies
of the same field, so that they can be compared: a field that knows the scene, or an empty one (--scratch, as in
the thesis, whose algorithms update after each decision: --decisions 1 --batch 1 --samples 1). In a synthetic
scene each episode has its own motion. Images are small (--size) and the field is a small splat, so that there
are many decisions. Without weights of LPIPS, or where edge.lpips is none, the reward has no term of LPIPS.

OUT/policy.npz is the learned policy, OUT/actor.npz the part of it that decides, OUT/training.csv and .png the
learning curve with each term of the reward. edge-server compare says what it shows, on seeds it was not trained
on. After Ctrl-C the same command continues, bit for bit, whatever --jobs and --ray are.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    errors = (ScenarioError, DatasetError, EngineError, ValueError)
    stopped = f"what is finished is in {args.out}: run the same command again to resume"
    return exit_status("edge-server train-scheduler", lambda: _train(args), errors, stopped)


def _train(args: argparse.Namespace) -> None:
    folders, setting = folders_of(args), setting_of(args, load(args.scenario))
    config = _config(args, setting, folders)
    args.out.mkdir(parents=True, exist_ok=True)  # first, so that an error does not waste the work
    print(f"  rewarded from {', '.join(setting.rewarding)}")
    say = partial(print, " ", flush=True)
    learner = train(setting, config, folders, args.jobs, args.out, say, args.ray)
    rows = read_log(args.out)
    write_csv(args.out / "training.csv", rows)
    learner.actor.save(args.out / "actor.npz")
    print(f"  {config.episodes} episodes; trained for {sum(row['seconds'] for row in rows):.0f} s in all", flush=True)
    draw_curve(args.out / "training.png", rows)
    policy = f"{BANDIT}{args.out / 'policy.npz'}"
    print(f"  edge-server run {args.scenario} --policy {policy}")
    print(f"  edge-server compare {args.scenario} all {policy} --seeds 8    # what it is worth")


def setting_of(args: argparse.Namespace, scenario: Scenario) -> Setting:
    """The setting that decisions are drawn from: the scenario with small images and a quick field. Raises
    ScenarioError or ValueError."""
    source, edge = dict(scenario.source), dict(scenario.edge)
    if source.get("kind") == "world" and args.size:
        size = {"width": args.size, "height": args.size}
        read_settings(BaseParams, size, "--size")  # before the work: a scene is made in the first episode
        source |= size
    edge["field"], edge["updates"], edge["field_options"] = "splat", "cycle", tuned.QUICK_SPLAT
    edge["policy"] = {"name": "all"}
    asked = args.parts.split(",")
    given = dataclasses.replace(scenario, source=source, edge=edge)
    return Setting(
        given,
        steps=tuned.SCRATCH_STEPS if args.scratch else tuned.TRAINING_STEPS,
        scratch=args.scratch,
        decisions=args.decisions,
        compute=read_config(given).compute,
        # In one order, however asked for; ``Layout`` refuses the unknown ones.
        parts=tuple(dict.fromkeys(part for part in (*STATE_PARTS, *asked) if part in asked)),
    )


def _config(args: argparse.Namespace, setting: Setting, folders: Folders) -> TrainingConfig:
    name = args.reward or ("set" if args.kind == "select" else "corrected")
    network = read_config(setting.scenario).lpips
    reward, missing = reward_of(name, args.on, folders.lpips, network)
    if missing:
        print(f"  {missing}")
    seeds(args.seed, "train", args.episodes)
    if not 0.0 <= args.price < math.inf:
        raise TrainingError(f"--price: expected 0 or more, got {args.price:g}")
    if args.price:
        reward = dataclasses.replace(reward, views=-args.price)
    spec = Spec(args.kind, layout_of(setting, setting.parts), _omegas(args))
    return TrainingConfig(spec, reward, args.episodes, args.batch, args.samples, args.seed)


def _omegas(args: argparse.Namespace) -> tuple[float, ...]:
    if args.omegas is None:
        return OMEGAS_MS.get(args.kind, ())
    try:
        return tuple(float(v) for v in args.omegas.split(","))
    except ValueError:
        raise ValueError(f"--omegas: expected milliseconds such as 20,60,120, got {args.omegas!r}") from None


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("edge-server train-scheduler", DESCRIPTION)
    add = parser.add_argument
    add("scenario", help="scenario file, or the name of a shipped one; needs a held-out camera")
    add("--kind", choices=ACTIONS, default="select", help="what the policy decides [%(default)s]")
    add("--episodes", type=int, default=tuned.EPISODES, metavar="N", help="episodes of training [%(default)s]")
    add("--decisions", type=int, default=tuned.DECISIONS, metavar="N", help="decisions of an episode [%(default)s]")
    add(
        "--batch",
        type=int,
        default=tuned.EPISODES_A_BATCH,
        metavar="N",
        help="episodes in one policy update [%(default)s]",
    )
    add(
        "--samples",
        type=int,
        default=tuned.ACTION_SAMPLES,
        metavar="N",
        help="actions tried at each decision [%(default)s]",
    )
    add("--reward", choices=tuple(REWARDS), help="reward, see above [set for select, else corrected]")
    add(
        "--on", choices=("whole", "moving"), default="whole", help="pixels that the reward's PSNR is over [%(default)s]"
    )
    add(
        "--price",
        type=float,
        default=0.0,
        metavar="R",
        help="cost of each used view, taken off the reward; at 0, policies tend to use all [0]",
    )
    add(
        "--parts",
        default="age,pose",
        metavar="P,...",
        help=f"parts of the state that the policy sees: {', '.join(STATE_PARTS)} [%(default)s]",
    )
    add("--omegas", metavar="MS,...", help="ms that threshold and wait choose from: 20,60,120")
    add("--scratch", action="store_true", help="each update starts from an empty field, as in the thesis")
    add(
        "--size",
        type=int,
        default=tuned.TRAINING_SIDE_PX,
        metavar="PX",
        help="pixels a side in synthetic scenes; 0: the scenario's [%(default)s]",
    )
    add("--seed", type=int, default=0, metavar="N", help="random seed [%(default)s]")
    add_workers(parser)
    add_folders(parser)
    add("--out", type=out_folder, required=True, metavar="DIR", help="folder to write")
    return parser
