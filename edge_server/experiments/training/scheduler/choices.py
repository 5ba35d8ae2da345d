"""What policies choose at a drawn decision: the ones that run live, and a learner's actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from edge_server.experiments.training.scheduler.episode import Choice, DecisionPoint
from edge_server.scheduler import BANDIT, Epoch, Policy, make_policy
from edge_server.scheduler.learned.learner_spec import Spec

Maker = Callable[[np.random.Generator], Policy]
"""Makes a policy as new, from its stream of random numbers."""


def choose(policy: Policy, moment: DecisionPoint, number: int | None = None) -> Choice:
    """What ``policy`` does at a decision: it plans, waits for as long as it likes and selects, as the live
    loop has it. One that would wait longer than is known of the channel uses all that there is then. number:
    of the decision, for policies that go on from one to the next; None takes the moment's own."""
    number = moment.number if number is None else number
    plan = policy.plan(_epoch(moment, moment.now_ns, number))
    at_ns = min(max(moment.now_ns, plan.wait_until_ns), moment.until_ns)
    cameras = policy.select(_epoch(moment, at_ns, number), plan)
    while not cameras:
        arrives_ns = moment.next_arrival_ns(at_ns)
        if arrives_ns is None:
            at_ns = moment.until_ns
            cameras = tuple(moment.newest(at_ns))
            break
        at_ns = arrives_ns
        cameras = policy.select(_epoch(moment, at_ns, number), plan)
    treatment = policy.treatment
    return Choice(tuple(cameras), at_ns, treatment.name if treatment else "")


def choice_of_action(spec: Spec, action: Any, moment: DecisionPoint) -> Choice:
    """What a learner's action means at a decision: action (N,) bool, or an index of the specification's
    omegas."""
    if spec.action != "select":
        omega_ms = spec.omegas_ms[int(action)]
        return choose(make_policy(spec.action, omega_ms, np.random.default_rng(0)), moment)
    cameras = tuple(c for c, chosen in zip(moment.cameras, action) if chosen)
    # Where nothing has been reported there is nothing to choose: the first frame that comes is used.
    return Choice(cameras, moment.now_ns) if cameras else choose(_use_all(), moment)


def choices(make: Maker, moments: Sequence[DecisionPoint], purpose: int = 0) -> list[Choice]:
    """What a policy does at the decisions of one episode, in their order, from its beginning. purpose: keeps
    the random numbers of several policies apart."""
    policy = make(np.random.default_rng([moments[0].seed, purpose]))
    return [choose(policy, moment) for moment in moments]


def named(name: str) -> Maker:
    """The policy of a name with a value, such as ``threshold:120``, as ``make_policy`` knows it."""
    kind, _, value = (name, "", "") if name.startswith(BANDIT) else name.partition(":")
    return lambda rng: make_policy(kind, float(value) if value else None, rng)


def _use_all() -> Policy:
    return make_policy("all", None, np.random.default_rng(0))


def _epoch(moment: DecisionPoint, at_ns: int, number: int) -> Epoch:
    generated = {c: arrival.generated_ns for c, arrival in moment.newest(at_ns).items()}
    # What is seen besides ages is known of the instant of the decision, at which policies look.
    state = (lambda parts=(): moment.state) if at_ns == moment.now_ns else None
    return Epoch(at_ns, number, generated, state)
