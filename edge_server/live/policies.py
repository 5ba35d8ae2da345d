"""The policies of one run: the first one, and those it may change to."""

from __future__ import annotations

from edge_server.config import EdgeConfig
from edge_server.scheduler import BANDIT, OFFERED, Policy, make_live_policy
from freshfield.limits import MAX_POLICY_CHARS
from freshfield.scenario import Scenario


class ServerPolicies:
    """Makes the policies of a server.

    first: the policy it starts with.
    offered: names that may be chosen during the run. The only learned policy among them is the first one: no
    client can name a file to open.
    """

    def __init__(self, scenario: Scenario, config: EdgeConfig) -> None:
        """Raises ValueError for a policy that is not possible."""
        self._scenario = scenario
        self.first: Policy = self._make(config.policy.name, config.policy.value)
        self.offered = OFFERED if self.first.name in OFFERED else (self.first.name, *OFFERED)

    def make(self, name: str, value: float | None) -> Policy:
        """The policy that an operator asks for. Raises ValueError if it is not offered."""
        if name not in self.offered and len(name) > MAX_POLICY_CHARS:
            raise ValueError(f"policy: a name of {len(name)} characters; none has more than {MAX_POLICY_CHARS}")
        if name.startswith(BANDIT) and name not in self.offered:
            raise ValueError(f"policy {name!r}: what was learned is chosen at the start (--policy {name})")
        return self._make(name, value)

    def _make(self, name: str, value: float | None) -> Policy:
        return make_live_policy(name, value, self._scenario.rng("policy", name))
