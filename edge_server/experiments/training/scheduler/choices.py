"""Choices of live policies, and of a learner's actions, at a drawn decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from edge_server.experiments.training.scheduler.episode import Choice, DecisionPoint
from edge_server.scheduler import Epoch, Policy, make_policy, parse_policy
from edge_server.scheduler.learned.learner_spec import Spec

Maker = Callable[[np.random.Generator], Policy]
"""Makes a new policy from a random generator."""


def choose(policy: Policy, moment: DecisionPoint, number: int | None = None) -> Choice:
    """Plan, wait and select with ``policy`` at a decision, as in the live loop. A policy that would wait past
    the channel's record uses all newest frames at its end.

    number: number of the decision, for policies with state across decisions; None: the moment's own.
    """
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
    return Choice(tuple(cameras), at_ns)


def choice_of_action(spec: Spec, action: Any, moment: DecisionPoint) -> Choice:
    """The choice of a learner's action: (N,) bool, or an index into the specification's omegas."""
    if spec.action != "select":
        omega_ms = spec.omegas_ms[int(action)]
        return choose(make_policy(spec.action, omega_ms, np.random.default_rng(0)), moment)
    cameras = tuple(c for c, chosen in zip(moment.cameras, action) if chosen)
    # Without a reported frame there is nothing to select: use the first frame that arrives.
    use_all = make_policy("all", None, np.random.default_rng(0))
    return Choice(cameras, moment.now_ns) if cameras else choose(use_all, moment)


def choices(make: Maker, moments: Sequence[DecisionPoint], purpose: int = 0) -> list[Choice]:
    """Choices of a new policy at the decisions of one episode, in order. purpose: separates the random
    numbers of several policies."""
    policy = make(np.random.default_rng([moments[0].seed, purpose]))
    return [choose(policy, moment) for moment in moments]


def named(name: str) -> Maker:
    """Maker of a policy from ``make_policy``'s name and value, such as ``threshold:120``."""
    kind, value = parse_policy(name)
    return lambda rng: make_policy(kind, value, rng)


def _epoch(moment: DecisionPoint, at_ns: int, number: int) -> Epoch:
    newest = moment.newest(at_ns)
    generated = {c: arrival.generated_ns for c, arrival in newest.items()}
    received = {c: arrival.received_ns for c, arrival in newest.items()}
    # Except for ages, the state is known only at the instant of the decision, when policies read it.
    state = (lambda parts=(): moment.state) if at_ns == moment.now_ns else None
    return Epoch(at_ns, number, generated, state, received)
