"""The policies of one run: the first one, those it may change to, and the one that goes on learning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from edge_server.config import EdgeConfig
from edge_server.scheduler import BANDIT, OFFERED, Policy, make_live_policy
from freshfield.limits import MAX_POLICY_CHARS
from freshfield.scenario import Scenario

if TYPE_CHECKING:  # imported at run time only where a policy is learned
    from edge_server.scheduler.online.online_trainer import OnlineTrainer


class ServerPolicies:
    """Makes the policies of a server.

    first: the policy it starts with.
    offered: names that may be chosen during the run. The only learned policy among them is the first one: no
    client can name a file to open.
    trainer: trains the policy while it is used; None where nothing learns.
    """

    def __init__(self, scenario: Scenario, config: EdgeConfig, lpips_missing: str | None, out: Path) -> None:
        """Raises ValueError for a policy or a reward that is not possible."""
        self._scenario = scenario
        self.first: Policy = self._make(config.policy.name, config.policy.value)
        self.offered = OFFERED if self.first.name in OFFERED else (self.first.name, *OFFERED)
        self.trainer = self._open_trainer(config, lpips_missing, out)
        if self.trainer is not None:
            self.first = self.trainer.policy

    def make(self, name: str, value: float | None) -> Policy:
        """The policy that an operator asks for. Raises ValueError if it is not offered."""
        if name not in self.offered and len(name) > MAX_POLICY_CHARS:
            raise ValueError(f"policy: a name of {len(name)} characters; none has more than {MAX_POLICY_CHARS}")
        if name.startswith(BANDIT) and name not in self.offered:
            raise ValueError(f"policy {name!r}: what was learned is chosen at the start (--policy {name})")
        policy = self._make(name, value)
        if self.trainer is not None and policy.name == self.trainer.policy.name:
            return self.trainer.policy  # it goes on learning
        return policy

    def learning_line(self, policy: str) -> str:
        """How learning goes, for people; empty where nothing learns, or another ``policy`` decides."""
        if self.trainer is None or policy != self.trainer.policy.name:
            return ""
        return self.trainer.policy.summary()

    def _make(self, name: str, value: float | None) -> Policy:
        return make_live_policy(name, value, self._scenario.rng("policy", name))

    def _open_trainer(self, config: EdgeConfig, lpips_missing: str | None, out: Path) -> OnlineTrainer | None:
        learn, name = config.learn, self.first.name
        if learn is None:
            return None
        if not name.startswith(BANDIT):
            raise ValueError(f"{name} cannot learn: only bandit:FILE can (--policy, edge.policy)")
        if not self._scenario.held_out:
            raise ValueError("nothing is held out (cameras.held_out), so that there is no reward to learn by")
        from edge_server.scheduler.online.online_trainer import open_online_trainer

        trainer = open_online_trainer(
            Path(name.removeprefix(BANDIT)),
            learn.reward,
            learn.fallback,
            self._scenario.rng("lessons"),
            lpips_missing,
            out,
        )
        reward = trainer.reward
        if reward.distance and reward.distance_is == "perceptual" and "perceptual" not in config.metrics:
            raise ValueError(
                "the policy was trained by the stand-in distance, which nothing measures here: "
                "list it in the scenario, edge.metrics: [perceptual]"
            )
        return trainer
