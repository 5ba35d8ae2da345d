"""``edge-server viewpoints``: plans the capture of a scenario within a budget of views or meters of path."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

from camera_node.sources.datasets.records import DatasetError
from edge_server.command import command_parser, exit_status
from edge_server.experiments.common.arguments import OptionError, add_folders, at_least, folders_of
from edge_server.experiments.viewpoints import capture_constants as tuned
from edge_server.experiments.viewpoints.asking import ANSWERS, check_page, compare
from edge_server.experiments.viewpoints.drawing import draw_plan
from edge_server.experiments.viewpoints.stage import open_embedder, open_stage
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Scorer
from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.capture_planner import Budget, plan_capture
from edge_server.viewpoints.experts import TASTES
from edge_server.viewpoints.policy import CandidatePolicy, PolicyConfig, train_policy
from edge_server.viewpoints.preference_session import PERSON
from edge_server.viewpoints.registry import SELECTORS, make_selector
from freshfield import transport
from freshfield.files import out_folder, write_json
from freshfield.scenario import ScenarioError
from freshfield.transport import TransportError

DESCRIPTION = """\
Chooses where a camera goes next around an object, view by view, within a budget (thesis 4.5).

  edge-server viewpoints tile --budget 8
  edge-server viewpoints cell --budget 2.5m --selector fisher --travel .3
  edge-server viewpoints lego --budget 12 --selector coverage --data ~/data

The candidates of a synthetic scene lie on a half-hemisphere around its object; if the scenario has an arm,
only those that it reaches count. The candidates of a recording are its views. Writes OUT/plan.json (the
stops with their poses, values and reasons) and OUT/plan.png (the candidates by value, and the path). The
printed quality is that of a splat field fitted to the chosen views, on held-out viewpoints.

--ask plans by preferences instead of --selector: a page shows pairs of reconstructions from different views,
a person (or a simulated expert) says which is better, a reward model learns from the answers and a policy
from the reward. Writes OUT/answers.json after each answer, from which the next call continues, and
OUT/policy.npz for --selector ppo:OUT/policy.npz.

  edge-server viewpoints tile --budget 8 --ask

selectors:
""" + "\n".join(f"  {name:10} {text}" for name, (_, _, text) in SELECTORS.items())


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    args = _parser().parse_args(argv)
    errors = (ScenarioError, DatasetError, ViewpointError, OptionError, TransportError)
    stopped = f"answers are kept in {args.out / ANSWERS}" if args.ask else "nothing was written"
    return exit_status("edge-server viewpoints", lambda: _run(args), errors, stopped)


def _run(args: argparse.Namespace) -> None:
    folders = folders_of(args)
    budget = read_budget(args.budget)
    selector = make_selector(args.selector)  # refused before anything is rendered
    if not 0.0 <= args.travel < math.inf:
        raise OptionError(f"--travel {args.travel:g}: expected 0 or more")
    page, secured = (args.page_host, args.page_port), transport.from_arguments(args)
    if args.ask == PERSON:
        check_page(page, secured)
    stage = open_stage(args.scenario, args.candidates, data=folders.data)
    if isinstance(selector, CandidatePolicy):
        selector.embed = open_embedder(stage.background)[0]
    show = None
    if args.ask:
        args.out.mkdir(parents=True, exist_ok=True)
        views = min(budget.views or tuned.PLANNED_VIEWS, int(stage.candidates.reachable.sum()))
        if views < 2:
            raise OptionError(
                f"--budget {args.budget}: --ask compares reconstructions from at least 2 views, got {views}"
            )
        session, show = compare(
            stage,
            args.ask,
            views=views,
            count=args.reconstructions,
            questions=args.questions,
            steps=args.steps,
            seed=args.seed,
            out=args.out,
            page=page,
            transport=secured,
        )
        agreed, repeated = session.agreement
        print(f"answered by {session.by}: {session.model.says()}; repeated pairs alike: {agreed} of {repeated}")
        if session.model.knows:
            selector, _ = train_policy(stage.candidates, session.model.reward, PolicyConfig(views=views), args.seed)
            selector.save(args.out / "policy.npz")
        else:
            print(f"planned by {selector.name} instead")
    plan = plan_capture(
        stage.candidates,
        selector,
        budget,
        stage.take,
        seed=args.seed,
        travel_weight=args.travel,
        fit=lambda views: stage.fit(views, args.steps, args.seed),
    )
    scorer = Scorer(open_lpips(folders.lpips)[0], background=stage.background)
    score = stage.score(stage.fit(plan.views, args.steps, args.seed), scorer)
    args.out.mkdir(parents=True, exist_ok=True)
    quality = {"psnr_db": score.psnr_db, "ssim": score.ssim, "lpips": score.lpips}
    about = {"scenario": stage.name, "seed": args.seed, "travel_weight": args.travel, "steps": args.steps}
    write_json(args.out / "plan.json", {**about, **plan.as_json(stage.candidates), "held_out": quality})
    draw_plan(args.out / "plan.png", stage, plan)
    for n, stop in enumerate(plan.stops, 1):
        print(f"{n:3}  candidate {stop.candidate:3}  {1e3 * stop.seconds:6.0f} ms  {stop.why}")
    if plan.note:
        print(plan.note)
    print(
        f"{len(plan.stops)} views, {plan.path_m:.2f} m of path; held out: PSNR {score.psnr_db:.2f} dB"
        + (f", SSIM {score.ssim:.3f}" if score.ssim is not None else "")
        + (f", LPIPS {score.lpips:.3f}" if score.lpips is not None else "")
    )
    print(f"{args.out / 'plan.json'} and plan.png", flush=True)
    if show is not None:
        lines = [f"candidate {stop.candidate}: {stop.why}" for stop in plan.stops]
        show([*lines, *([plan.note] if plan.note else [])], (args.out / "plan.png").read_bytes())


def read_budget(text: str) -> Budget:
    """Parse a budget: ``8`` is views, ``2.5m`` meters of path, ``8,2.5m`` both. Raises OptionError or
    ViewpointError."""
    words = text.split(",")
    try:
        views = [int(word) for word in words if not word.endswith("m")]
        paths_m = [float(word[:-1]) for word in words if word.endswith("m")]
        if len(views) > 1 or len(paths_m) > 1:
            raise ValueError("two of a kind")
    except ValueError:
        raise OptionError(f"--budget {text}: expected views (8), meters (2.5m) or both (8,2.5m)") from None
    return Budget(views[0] if views else None, paths_m[0] if paths_m else None)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("edge-server viewpoints", DESCRIPTION)
    add = parser.add_argument
    add("scenario", help="scenario file, or the name of a shipped one")
    add(
        "--budget", required=True, metavar="N|Dm|N,Dm", help="number of views, meters of path, or both: 8, 2.5m, 8,2.5m"
    )
    add("--selector", default="coverage", metavar="NAME", help="how to choose, see above [%(default)s]")
    add(
        "--travel",
        type=float,
        default=tuned.TRAVEL_WEIGHT,
        metavar="W",
        help="weight of path length against value, each over its range; 0: none [%(default)g]",
    )
    add(
        "--candidates",
        type=int,
        default=tuned.PLAN_CANDIDATES,
        metavar="N",
        help="number of candidates in a synthetic scene [%(default)s]",
    )
    add(
        "--steps",
        type=at_least(1),
        default=tuned.PLAN_FIT_STEPS,
        metavar="N",
        help="optimizer steps of each fit [%(default)s]",
    )
    add("--seed", type=at_least(0), default=0, metavar="N", help="random seed, also of the first view [%(default)s]")
    add(
        "--ask",
        nargs="?",
        const=PERSON,
        choices=[PERSON, *TASTES],
        metavar="WHO",
        help=f"compare reconstructions first, by a {PERSON} on the page (if WHO is left out) or a simulated "
        f"expert: {', '.join(TASTES)}",
    )
    add(
        "--questions",
        type=at_least(1),
        default=tuned.QUESTIONS,
        metavar="N",
        help="pairs that --ask shows [%(default)s]",
    )
    add(
        "--reconstructions",
        type=at_least(2),
        default=tuned.RECONSTRUCTIONS,
        metavar="N",
        help="reconstructions that --ask compares [%(default)s]",
    )
    add("--page-port", type=int, default=8080, metavar="PORT", help="port of --ask's page [%(default)s]")
    add("--page-host", default="127.0.0.1", metavar="HOST", help="address of --ask's page [%(default)s]")
    transport.add_arguments(parser)
    add_folders(parser)
    add("--out", type=out_folder, default="runs/viewpoints", metavar="DIR", help="folder to write [%(default)s]")
    return parser
