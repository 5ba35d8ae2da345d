"""Policies: which of the newest views an update uses, and how long to wait for younger ones.

A decision has two halves, because a policy may wait in between: ``plan`` at the decision epoch says until
when to wait, ``select`` then picks cameras from what is in the buffer. Both are pure functions of what
they are given (and of the policy's own seeded stream), so that live and virtual time share them.

Adding a policy is one file here and a line in ``POLICIES``. A name may go on with a treatment of the views
that are selected: ``threshold+freshen`` (``edge_server.treatments``, a line in ``TREATMENTS``); a treatment's
name alone treats all views. ``bandit:FILE`` is a policy that was learnt (``edge_server.scheduler.learned``).
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:  # nothing of it is loaded where no policy asks for it
    from edge_server.scheduler.learned.bandit import Decided
    from edge_server.scheduler.learned.state import State
    from edge_server.treatments import Treatment


STATE_PARTS = ("semantics", "age", "pose")
"""Parts of the state that a learnt policy may look at, in the order of (6.33)."""


class Observe(Protocol):
    """What else there is to see. Computed when it is called, and only the ``parts`` asked for."""

    def __call__(self, parts: Sequence[str] = STATE_PARTS) -> State: ...


@dataclass(frozen=True)
class Epoch:
    """What a policy may look at: the time, the epoch's number and the generation time in ns of the newest
    frame of every camera that has reported (others are missing), on the edge's clock. state: of all cameras,
    with poses and embeddings, for policies that look at more than ages; None where nobody offers it."""

    now_ns: int
    number: int
    generated_ns: Mapping[str, int]
    state: Observe | None = None

    def age_ms(self, camera: str) -> float:
        return (self.now_ns - self.generated_ns[camera]) / 1e6


@dataclass(frozen=True)
class Plan:
    """The first half of a decision. omega_ms: as shown to people, None for policies without one.
    wait_until_ns: earliest instant of selection. generated_after_ns: frames not generated after it do not
    qualify (omega-wait), None admits all. flush: what is on its way at the decision is to be broken off."""

    decided_ns: int
    omega_ms: float | None = None
    wait_until_ns: int = 0
    generated_after_ns: int | None = None
    flush: bool = False


class Policy(Protocol):
    name: str

    @property
    def parameter(self) -> str | None:
        """Name and unit of the one value a user may set, such as ``omega_ms``; None if there is none."""
        ...

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
    "wait-flush": ("wait", "WaitFlush", "as wait, what is on its way at the decision broken off (6.5)"),
}


# name -> (module, class, one line of help)
TREATMENTS: dict[str, tuple[str, str, str]] = {
    "mask": ("motion_mask", "MotionMask", "of stale views, pixels that were moving count for less"),
    "freshen": ("flow_warp", "FlowWarp", "stale views are carried forward to now by their optical flow"),
}

# Prefix of a policy that was learnt: the path of a learner's checkpoint follows.
BANDIT = "bandit:"

# A live edge cannot take back what the network carries; virtual time can, to show what the thesis assumes.
VIRTUAL_ONLY = ("wait-flush",)
# What is offered where people choose; any other combination may be typed.
OFFERED: tuple[str, ...] = (
    *(policy for policy in POLICIES if policy not in VIRTUAL_ONLY), *TREATMENTS,
    *(f"{policy}+{treatment}" for policy in ("threshold", "wait", "freshest-k") for treatment in TREATMENTS),
)  # fmt: skip


def make_policy(name: str, value: float | None, rng: np.random.Generator) -> Policy:
    """The named policy, imported only now. ``value`` None takes its default.

    Raises ValueError for an unknown name or a value out of range, saying what is possible.
    """
    if name.startswith(BANDIT):
        if value is not None:
            raise ValueError(f"policy {name!r}: what was learnt has no value to set")
        from edge_server.scheduler.learned.bandit import Bandit

        return Bandit.from_file(name.removeprefix(BANDIT), rng)
    chooses, treats = _parts(name)
    if chooses not in POLICIES or name.endswith("+"):
        wrong = name if chooses in POLICIES else chooses
        raise ValueError(
            f"policy {wrong!r} is not known; choose one of {', '.join((*POLICIES, *TREATMENTS))}, "
            "or join a policy and a treatment, as in threshold+freshen; a learnt one is bandit:FILE"
        )
    module, cls, _ = POLICIES[chooses]
    policy: Policy = getattr(importlib.import_module(f"{__name__}.{module}"), cls)(value, rng)
    if not treats:
        return policy
    if treats not in TREATMENTS:
        raise ValueError(
            f"policy {name!r}: there is no treatment {treats!r}; after the + choose one of "
            f"{', '.join(TREATMENTS)}"
        )
    from edge_server.scheduler.treated import Treated

    module, cls, _ = TREATMENTS[treats]
    return Treated(name, policy, getattr(importlib.import_module(f"edge_server.treatments.{module}"), cls)())


def read_policy(text: str) -> tuple[str, float | None]:
    """Name and value of a policy as people type it: ``threshold:120``, ``all``, ``bandit:FILE``, where FILE
    is relative to where they are. ValueError where the value is no number."""
    if text.startswith(BANDIT):
        return learnt_policy(text, Path()), None
    name, _, value = text.partition(":")
    try:
        return name, float(value) if value else None
    except ValueError:
        raise ValueError(f"{text}: {value!r} is not a number") from None


def learnt_policy(name: str, folder: Path) -> str:
    """``bandit:FILE`` with a FILE relative to ``folder`` made absolute; another policy's name as it is."""
    if not name.startswith(BANDIT):
        return name
    return BANDIT + str((folder / Path(name.removeprefix(BANDIT)).expanduser()).absolute())


def make_live_policy(name: str, value: float | None, rng: np.random.Generator) -> Policy:
    """``make_policy`` for a live edge. Raises ValueError also for what only virtual time can do."""
    if _parts(name)[0] in VIRTUAL_ONLY:
        raise ValueError(
            f"policy {name!r} breaks off what the network carries, which a live edge cannot: it runs in "
            "virtual time only (edge-server simulate, edge-server study); live, use wait"
        )
    return make_policy(name, value, rng)


def treatment_of(policy: Policy) -> Treatment | None:
    """What ``policy`` has done to the views it selects; None: nothing, as for most."""
    return getattr(policy, "treatment", None)


def embedding_of(policy: Policy) -> tuple[int, str]:
    """Width of the embeddings that ``policy`` decides by, 0: it needs none, as most; and the name of the
    embedder whose they are, empty where the policy does not say."""
    return getattr(policy, "embedding", (0, ""))


def decision_of(policy: Policy) -> Decided | None:
    """The newest decision of a learnt policy, with what it saw; None of others, and before the first."""
    return getattr(policy, "last", None)


def help_of(name: str) -> str:
    """One line on a policy; empty for one that is not known."""
    if name.startswith(BANDIT):
        return "a policy that was learnt (edge-server train-scheduler)"
    chooses, treats = _parts(name)
    if chooses not in POLICIES or (treats and treats not in TREATMENTS):
        return ""
    if not treats:
        return POLICIES[chooses][2]
    line, said = POLICIES[chooses][2], TREATMENTS[treats][2]
    what, _, parameter = line.partition("; value:")
    both = said if name in TREATMENTS else f"{what}; {said}"
    return f"{both}; value:{parameter}" if parameter else both


def _parts(name: str) -> tuple[str, str]:
    """The policy that chooses and the treatment, or nothing, that ``name`` asks for."""
    if name in TREATMENTS:
        return "all", name
    chooses, _, treats = name.partition("+")
    return chooses, treats


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
