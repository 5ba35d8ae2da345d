"""Policies: which of the newest views an update uses, and how long to wait for younger ones.

A decision has two halves, because a policy may wait in between: ``plan`` at the decision epoch says until
when to wait, ``select`` then picks cameras from what is in the buffer. Both are pure functions of what
they are given (and of the policy's own seeded stream), so that live and virtual time share them.

Adding a policy is one file here and a line in ``POLICIES``.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Epoch:
    """What a policy may look at: the time, the epoch's number and the generation time in ns of the newest
    frame of every camera that has reported (others are missing), on the edge's clock."""

    now_ns: int
    number: int
    generated_ns: Mapping[str, int]

    def age_ms(self, camera: str) -> float:
        return (self.now_ns - self.generated_ns[camera]) / 1e6


@dataclass(frozen=True)
class Plan:
    """The first half of a decision. omega_ms: as shown to people, None for policies without one.
    wait_until_ns: earliest instant of selection. generated_after_ns: frames not generated after it do not
    qualify (omega-wait), None admits all."""

    decided_ns: int
    omega_ms: float | None = None
    wait_until_ns: int = 0
    generated_after_ns: int | None = None


class Policy(Protocol):
    name: str
    parameter: str | None
    """Name and unit of the one value a user may set, such as ``omega_ms``; None if there is none."""

    @property
    def value(self) -> float | None: ...

    def plan(self, epoch: Epoch) -> Plan: ...

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        """Cameras to use, at least one if any qualifies (K_t >= 1). Empty: go on waiting."""
        ...


# name -> (module, class, one line of help)
POLICIES: dict[str, tuple[str, str, str]] = {
    "all": ("all", "UseAll", "every camera's newest frame, however old"),
    "periodic": ("periodic", "Periodic", "use all, at fixed instants; value: period_ms"),
    "random": ("random", "RandomSubset", "a uniformly random non-empty set; value: k fixes its size"),
    "round-robin": ("round_robin", "RoundRobin", "the next k cameras in turn; value: k"),
    "freshest-k": ("freshest_k", "FreshestK", "the k youngest frames; value: k"),
    "age-driven": ("age_driven", "AgeDriven", "the largest set whose mean age is minimal"),
    "threshold": ("threshold", "Threshold", "frames no older than omega (6.12-6.14); value: omega_ms"),
    "wait": ("wait", "Wait", "wait omega, use only frames generated meanwhile (6.15-6.17); value: omega_ms"),
}


def make_policy(name: str, value: float | None, rng: np.random.Generator) -> Policy:
    """The named policy, imported only now. ``value`` None takes its default.

    Raises ValueError for an unknown name or a value out of range, saying what is possible.
    """
    if name not in POLICIES:
        raise ValueError(f"policy {name!r} is not known; choose one of {', '.join(POLICIES)}")
    module, cls, _ = POLICIES[name]
    return getattr(importlib.import_module(f"{__name__}.{module}"), cls)(value, rng)


def freshest(epoch: Epoch, count: int) -> tuple[str, ...]:
    """The ``count`` cameras with the youngest frames; ties in the cameras' own order."""
    order = sorted(epoch.generated_ns, key=lambda c: -epoch.generated_ns[c])
    chosen = set(order[:count])
    return tuple(c for c in epoch.generated_ns if c in chosen)


def positive_int(value: float | None, default: int, name: str) -> int:
    """``value`` as a count of at least one, or ValueError naming the parameter."""
    if value is None:
        return default
    if value != int(value) or value < 1:
        raise ValueError(f"{name}: expected a whole number from 1, got {value:g}")
    return int(value)


def non_negative(value: float | None, default: float, name: str) -> float:
    """``value`` as a finite number of at least zero, or ValueError naming the parameter."""
    if value is None:
        return default
    if not np.isfinite(value) or value < 0:
        raise ValueError(f"{name}: expected zero or more, got {value:g}")
    return float(value)
