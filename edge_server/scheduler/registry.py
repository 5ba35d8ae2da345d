"""Policies by name, as people write them: ``threshold:120``, ``wait``, ``bandit:FILE``.

Adding a policy takes a class and a line in ``POLICIES``. ``bandit:FILE`` is a learned policy
(``edge_server.scheduler.learned``).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from edge_server.edge_constants import MAX_POLICY_CHARS
from edge_server.scheduler import fixed
from edge_server.scheduler.policy import Policy
from edge_server.scheduler.wait import Wait, WaitArrived, WaitFlush
from freshfield import plugins
from freshfield.scenario import SCENARIO_FOLDER

# name -> (class, one line of help)
POLICIES: dict[str, tuple[type[Policy], str]] = {
    "all": (fixed.UseAll, "every camera's newest frame, however old"),
    "periodic": (fixed.Periodic, "as all, but at fixed instants; value: period_ms"),
    "random": (fixed.RandomSubset, "a uniformly random non-empty set; value: k fixes its size"),
    "round-robin": (fixed.RoundRobin, "the next k cameras in turn; value: k"),
    "freshest-k": (fixed.FreshestK, "the k youngest frames; value: k"),
    "age-driven": (fixed.AgeDriven, "the largest set whose mean age is minimal"),
    "threshold": (fixed.Threshold, "frames no older than omega (6.12-6.14); value: omega_ms"),
    "wait": (Wait, "wait omega, use only frames generated meanwhile (6.15-6.17); value: omega_ms"),
    "wait-arrived": (WaitArrived, "as wait, but frames that arrive meanwhile, however old (6.16)"),
    "wait-flush": (WaitFlush, "as wait, but abort the transmissions under way at the decision (6.5)"),
}

# Prefix of a learned policy: the path of a learner's checkpoint follows.
BANDIT = "bandit:"

# A live edge cannot abort what the network carries; virtual time can, to show what the thesis assumes.
VIRTUAL_ONLY = ("wait-flush",)
# The choices offered to users.
OFFERED: tuple[str, ...] = tuple(policy for policy in POLICIES if policy not in VIRTUAL_ONLY)


def make_policy(name: str, value: float | None, rng: np.random.Generator) -> Policy:
    """The named policy; modules of learned policies are imported only now.

    name: as in ``POLICIES``, bandit:FILE, or a plug-in class (``freshfield.plugins``).
    value: value of its parameter; None takes the default.
    rng: for policies that draw.
    Raises ValueError for an unknown name (the message lists the known ones), a value out of range, or a file
    that is not a learner's checkpoint.
    """
    if name.startswith(BANDIT):
        if value is not None:
            raise ValueError(f"policy {name!r}: a learned policy has no value to set")
        from edge_server.scheduler.learned.bandit import BanditPolicy

        return BanditPolicy.from_file(name.removeprefix(BANDIT), rng)
    made: type[Policy] = POLICIES[name][0] if name in POLICIES else plugins.find("policy", name, [*POLICIES, BANDIT])
    if not issubclass(made, Policy):
        raise plugins.PluginError(f"policy {name}: {made.__name__} does not derive from edge_server.scheduler.Policy")
    policy = made(value, rng)
    if name not in POLICIES:
        policy.name = name  # under which every other process finds it too
    return policy


def parse_policy(text: str) -> tuple[str, float | None]:
    """Name and value of a policy as people type it: ``threshold:120``, ``all``, ``bandit:FILE`` with FILE
    relative to the working directory (``resolve_checkpoint``). ValueError where the value is not a number."""
    if text.startswith(BANDIT):
        return resolve_checkpoint(text, Path()), None
    name, _, value = text.partition(":")
    if name not in POLICIES:
        name, value = plugins.split_value(plugins.absolute(text, Path()))
    try:
        return name, float(value) if value else None
    except ValueError:
        raise ValueError(f"{text}: {value!r} is not a number") from None


def short_name(name: str) -> str:
    """A policy's name for display: ``bandit:FILE`` and FILE.py:CLASS without the file's folder."""
    if name.startswith(BANDIT):
        return BANDIT + Path(name.removeprefix(BANDIT)).name
    return plugins.short_name(name)


def resolve_checkpoint(name: str, folder: Path) -> str:
    """``bandit:FILE`` with FILE made absolute; any other policy's name unchanged.

    FILE is relative to ``folder``; if it is not there, to the folder of the shipped scenarios, so that shipped policies
    (``bandit:card/policy.npz``) are found from anywhere, also in an installed wheel.
    """
    if not name.startswith(BANDIT):
        return name
    file = Path(name.removeprefix(BANDIT)).expanduser()
    own, shipped = (folder / file).absolute(), SCENARIO_FOLDER / file
    return BANDIT + str(shipped if shipped.is_file() and not own.exists() else own)


def policy_help(name: str) -> str:
    """One line on a policy; empty for an unknown one."""
    if name.startswith(BANDIT):
        return "a learned policy (edge-server train-scheduler)"
    return POLICIES[name][1] if name in POLICIES else ("of your own" if plugins.is_reference(name) else "")


class LivePolicies:
    """Makes the policies of a running edge.

    first: the policy that it starts with.
    offered: names that may be chosen during the run. The only learned policy among them is the first one: no
    client can name a file to open.
    """

    def __init__(self, name: str, value: float | None, rng: Callable[[str], np.random.Generator]) -> None:
        """name, value: of the first policy. rng: gives the random stream of a policy's name. Raises ValueError
        for a policy that is not possible."""
        self._rng = rng
        self.first = self._made(name, value)
        self.offered = OFFERED if self.first.name in OFFERED else (self.first.name, *OFFERED)

    def make(self, name: str, value: float | None) -> Policy:
        """The policy that an operator asks for. Raises ValueError if it is not offered."""
        if name not in self.offered and len(name) > MAX_POLICY_CHARS:
            raise ValueError(f"policy: a name of {len(name)} characters; none has more than {MAX_POLICY_CHARS}")
        if name not in POLICIES and name not in self.offered:
            outside = name.startswith(BANDIT) or plugins.is_reference(name)
            known = "learned and plug-in policies can only be chosen at the start (--policy)"
            raise ValueError(f"policy {name!r}: {known if outside else 'choose one of ' + ', '.join(self.offered)}")
        return self._made(name, value)

    def _made(self, name: str, value: float | None) -> Policy:
        """``make_policy``. Also raises ValueError for policies that need virtual time."""
        if name in VIRTUAL_ONLY:
            raise ValueError(
                f"policy {name!r} aborts frames in the network, which a live edge cannot do: it runs in "
                "virtual time only (edge-server simulate, edge-server study); live, use wait"
            )
        return make_policy(name, value, self._rng(name))
