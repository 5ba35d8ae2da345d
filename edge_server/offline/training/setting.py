"""Where decisions come from and what one evaluation is, as plain values: they travel to other processes."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from edge_server.config import ComputeConfig
from freshfield.scenario import Scenario, ScenarioError

# A truth is rendered for every instant that is looked at, at ten times the price of a score: instants lie on
# a grid, which the lags of moving pixels (60, 120, 200, 300 ms) lie on too, so that pictures are shared.
GRID_MS = 10
# Seeds of training, of choosing among what was tried and of testing: never the same in two of them.
PURPOSES = ("train", "choose", "test")
_SEEDS_A_PURPOSE = 10**6
_SEEDS_A_RUN = 10**7


@dataclass(frozen=True)
class Setting:
    """scenario: of the deployment; its seed and policy are replaced. decisions: of one episode, at random
    instants between ``lead_ms`` and ``lead_ms + span_ms`` of its virtual time. horizon_ms: how long a
    decision may wait.

    steps: of the optimiser for the update of a decision. scratch: every update begins with nothing, as in
    the thesis (5.4, 6.3); else with a copy of the episode's warm field, which was trained for
    ``warm_steps`` before the first decision and, with everything there was, for ``steps`` more
    ``refresh_ms`` before each. compute: what virtual time charges an update. parts: of the state that
    decisions are drawn with (6.33); only with semantics are frames embedded, as ``edge.embedding`` of the
    scenario says.
    """

    scenario: Scenario
    steps: int = 100
    scratch: bool = True
    warm_steps: int = 150
    refresh_ms: float = 300.0
    decisions: int = 4
    lead_ms: float = 1000.0
    span_ms: float = 6000.0
    horizon_ms: float = 2000.0
    compute: ComputeConfig = dataclasses.field(default_factory=ComputeConfig)
    parts: tuple[str, ...] = ("age", "pose")

    def __post_init__(self) -> None:
        if not self.scenario.held_out:
            raise ScenarioError(
                f"{self.scenario.path}: cameras.held_out: nothing is held out, so that there is no reward: "
                "name a camera that no update may use"
            )
        if min(self.steps, self.warm_steps, self.decisions) < 1:
            raise ValueError("steps, warm_steps and decisions: expected at least 1")
        if not (self.span_ms >= GRID_MS and self.horizon_ms > 0.0 and 0.0 < self.refresh_ms < self.lead_ms):
            raise ValueError(
                f"span_ms: expected at least {GRID_MS}; horizon_ms: more than 0; refresh_ms: more than 0 and "
                "less than lead_ms"
            )

    @cached_property
    def key(self) -> str:
        """Tells settings apart: a hash of everything that decides an evaluation, the seed aside."""
        s = self.scenario
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "scenario"}
        own["compute"] = dataclasses.astuple(self.compute)
        parts: list[Any] = [s.cameras, s.held_out, s.source, s.channel, s.edge, own]
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:24]

    def seeded(self, seed: int) -> Scenario:
        """The deployment of one episode."""
        return dataclasses.replace(self.scenario, seed=seed)


def seeds(run: int, purpose: str, count: int, first: int = 0) -> range:
    """Seeds of ``count`` episodes from number ``first`` on, for one of ``PURPOSES`` of the run seeded
    ``run``. ValueError where a range would reach into the next."""
    if not (0 <= run < 10**9 and first >= 0 and first + count <= _SEEDS_A_PURPOSE):
        raise ValueError(f"seed: expected 0 to 999999999, and at most {_SEEDS_A_PURPOSE} episodes")
    start = run * _SEEDS_A_RUN + PURPOSES.index(purpose) * _SEEDS_A_PURPOSE + first
    return range(start, start + count)
