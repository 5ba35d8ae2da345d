"""Episodes in which the scheduler decides in a running deployment in virtual time, with computing charged.

A decision holds for ``Spec.hold_ms``. Its outcome is the fidelity of the images shown until the next
decision; it also depends on all earlier decisions, because the field is not reset. Several tries of an
episode share channel, motion and instants, so that the outcomes of one instant are comparable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.channel import Channel
from channel_emu.model.config import channel_from_mapping
from edge_server.config import read_config
from edge_server.experiments.common.tables import mean_or_none
from edge_server.experiments.training.scheduler.choices import named
from edge_server.experiments.training.scheduler.episode import SCORES, EpisodeFactory, Outcome
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.virtual_deployment import RunSettings, VirtualDeployment
from edge_server.live.state import Publication
from edge_server.scheduler import Policy
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.scheduler.learned.decision import Decision
from freshfield.scenario import Scenario

# Period of the instants at which the shown image is scored.
SHOWN_EVERY_MS = 125.0


Judged = str | Actor
"""A policy's name and value; or an actor, which takes its most probable actions."""


@dataclass(frozen=True)
class Decided:
    """A decision, the outcome that followed, and the name of the channel's state then."""

    decision: Decision
    outcome: Outcome
    channel_state: str


def play(factory: EpisodeFactory, seed: int, actor: Actor, turn: int) -> list[Decided]:
    """The decisions of one try of an episode, in order; actions are drawn. turn: number of the try."""
    policy = BanditPolicy(actor, "learner", np.random.default_rng([seed, turn]), explore=True)
    return _run(factory, seed, policy)[1]


def judge(factory: EpisodeFactory, seed: int, who: Judged) -> dict[str, Any]:
    """Means over an episode after its lead, under one policy, as plain values; of an actor with omegas also
    its mean omega by the channel's state."""
    rng = np.random.default_rng([seed, 0])
    policy: Policy
    if isinstance(who, Actor):
        policy = BanditPolicy(who, "learnt", rng)
    else:
        policy = named(who)(rng)
    deployment, decided = _run(factory, seed, policy)
    outcome = _outcome(deployment, round(factory.setting.lead_ms * 1e6), deployment.clock.now_ns())
    found: dict[str, Any] = {
        "psnr_db": outcome.psnr_db,
        "psnr_moving_db": outcome.psnr_moving_db,
        "ssim": outcome.ssim,
        "views": outcome.views,
        "aaoi_ms": outcome.aaoi_ms,
    }
    if isinstance(who, Actor) and who.spec.omegas_ms:
        by_state: dict[str, list[float]] = {}
        for d in decided:
            by_state.setdefault(d.channel_state, []).append(who.spec.omegas_ms[int(d.decision.action)])
        found["omega_ms"] = {state: float(np.mean(omegas)) for state, omegas in sorted(by_state.items())}
    return found


def _run(factory: EpisodeFactory, seed: int, policy: Policy) -> tuple[VirtualDeployment, list[Decided]]:
    """Run an episode under ``policy``. Returns the deployment, and the decisions after the lead of a learned
    policy."""
    setting, scenario = factory.setting, factory.scenario(seed)
    edge, stage, field = read_config(scenario), factory.stage(seed), factory.field(seed)
    field.reset()
    decisions: list[Decision] = []

    def published(publication: Publication) -> None:
        last = policy.last_decision
        if last is not None and (not decisions or decisions[-1].now_ns != last.now_ns):
            decisions.append(last.without_frames())

    settings = RunSettings(
        steps=edge.steps,
        compute=setting.compute,
        grace_ms=edge.grace_ms,
        epoch_ms=edge.update_ms,
        score_every_ms=None,
        shown_every_ms=SHOWN_EVERY_MS,
    )
    deployment = build_deployment(
        scenario,
        settings,
        field=field,
        cameras=stage.cameras,
        truth=stage.truth,
        embedder=factory.embedder,
        on_published=published,
    )
    deployment.updates.policy = policy
    deployment.run((setting.lead_ms + setting.span_ms) / 1e3)
    kept = [d for d in decisions if d.now_ns >= setting.lead_ms * 1e6]
    ends = [*(d.now_ns for d in kept[1:]), deployment.clock.now_ns()]
    states = channel_states(scenario, [d.now_ns for d in kept])
    return deployment, [
        Decided(d, _outcome(deployment, d.now_ns, end), state) for d, end, state in zip(kept, ends, states)
    ]


def _outcome(deployment: VirtualDeployment, begin_ns: int, end_ns: int) -> Outcome:
    """Means of the images shown and of the updates published in [begin, end)."""
    shown = [s for s in deployment.shown if begin_ns <= s.published_ns < end_ns]
    updates = [p for p in deployment.publications if begin_ns <= p.published_ns < end_ns]
    return Outcome(
        **{name: mean_or_none([getattr(s, name) for s in shown]) for name in SCORES},
        aaoi_ms=mean_or_none([p.aaoi_ms for p in updates]),
        views=mean_or_none([p.views for p in updates]) or 0.0,
        wait_ms=mean_or_none([p.update_ms for p in updates]) or 0.0,
    )


def channel_states(scenario: Scenario, at_ns: list[int]) -> list[str]:
    """Names of the states of the Markov chain that all cameras share, at given instants; "" without a
    chain."""
    config = channel_from_mapping(scenario.channel, f"{scenario.path}: channel", scenario.path.parent)
    chain = Channel(config, scenario.seed).chain
    return ["" if chain is None else config.state_names[chain.state(t)] for t in at_ns]


def sibling_advantages(
    tries: Sequence[Sequence[Decided]], hold_ms: float, rewards: Sequence[Sequence[float]]
) -> list[NDArray[np.float64]]:
    """For each try of one episode its rewards minus the mean of the other tries at the same instant; NaN if
    no other try has a reward there. With a single try the unchanged rewards."""
    if len(tries) == 1:
        return [np.array(rewards[0])]
    slots = [[d.decision.now_ns // round(hold_ms * 1e6) for d in one] for one in tries]
    known = [{s: r for s, r in zip(*one) if np.isfinite(r)} for one in zip(slots, rewards)]
    found = []
    for k, mine in enumerate(slots):
        others = [[o[s] for j, o in enumerate(known) if j != k and s in o] for s in mine]
        found.append(np.array(rewards[k]) - [np.mean(o) if o else np.nan for o in others])
    return found
