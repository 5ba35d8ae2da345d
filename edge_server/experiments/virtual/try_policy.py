"""A policy in a scenario's whole deployment in virtual time, as a library has it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.common.arguments import check_seconds
from edge_server.experiments.common.folders import folders_from
from edge_server.experiments.virtual.simulate_command import open_simulation, summary, usual_settings, with_policy
from edge_server.fidelity.scorer import Score
from edge_server.live.state import Publication
from edge_server.scheduler import Policy
from freshfield.scenario import load


@dataclass(frozen=True)
class Trial:
    """What a policy decided, and what was shown.

    policy: its name.
    summary: what ``edge-server simulate --json`` prints.
    decisions: one for each update: its instant ``t_s``, the cameras ``selected``, their ``ages_ms`` at publication,
        ``update_ms`` from decision to publication and others.
    scores: of what was shown at random instants of the held-out cameras.
    """

    policy: str
    summary: dict[str, Any]
    decisions: list[Publication] = field(repr=False)
    scores: list[Score] = field(repr=False)

    @property
    def psnr_db(self) -> float | None:
        """Mean over the last fifth of what was shown; None if nothing is held out, or nothing was shown."""
        found: float | None = self.summary["shown"]["psnr_db"]
        return found

    @property
    def psnr_moving_db(self) -> float | None:
        """As ``psnr_db``, of the pixels that move."""
        found: float | None = self.summary["shown"]["psnr_moving_db"]
        return found

    @property
    def shown(self) -> NDArray[np.float64]:
        """(instants, 3): seconds, PSNR in dB of the image shown, and of its moving pixels (NaN: none moves)."""
        rows = [(s.published_ns / 1e9, s.psnr_db, s.psnr_moving_db) for s in self.scores]
        return np.array(rows, np.float64).reshape(-1, 3)

    @property
    def ages_ms(self) -> NDArray[np.float64]:
        """(updates, 2): seconds, and mean age in milliseconds of the selected frames at publication (6.35)."""
        return np.array([(d.t_s, d.aaoi_ms) for d in self.decisions], np.float64).reshape(-1, 2)


def try_policy(
    policy: str | Policy, scenario: str | Path = "card", seconds: float = 20.0, seed: int | None = None
) -> Trial:
    """Run a scenario's cameras, channel and field in virtual time under a policy; one seed, one result.

    policy: as people write it (``threshold:120``, ``bandit:FILE``), or an object of a class derived from
        ``freshfield.Policy``.
    scenario: a file, or the name of a shipped one; with a held-out camera there are scores.
    seconds: of virtual time. seed: in place of the scenario's.
    Raises ScenarioError, DatasetError, or ValueError for a time that no run can take.
    """
    check_seconds(seconds)
    opened = load(str(scenario), seed)
    if isinstance(policy, str):
        opened = with_policy(opened, policy)
    deployment, _ = open_simulation(opened, folders_from(), usual_settings)
    if not isinstance(policy, str):
        if not hasattr(policy, "name"):
            policy.name = type(policy).__name__
        deployment.updates.policy = policy
    deployment.run(seconds)
    name = deployment.updates.policy.name
    return Trial(name, summary(opened, deployment, seconds), deployment.publications, deployment.shown)
