"""Where decisions come from and what one evaluation is, as plain values: they travel to other processes."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from edge_server.config import ComputeConfig
from freshfield.scenario import Scenario, ScenarioError

# A truth is rendered for every instant that is looked at, at ten times the price of a score: instants lie on
# a grid, which the lags of moving pixels (60, 120, 200, 300 ms) lie on too, so that pictures are shared.
GRID_MS = 10
# Seeds of training, of choosing among what was tried and of testing: never the same in two of them.
PURPOSES = ("train", "choose", "test")
SEEDS_A_PURPOSE = 10**6
_SEEDS_A_RUN = 10**7


@dataclass(frozen=True)
class Setting:
    """scenario: of the deployment; an episode's seed and policy replace its own. decisions: of one episode,
    at random instants between ``lead_ms`` and ``lead_ms + span_ms`` of its virtual time. horizon_ms: how
    long a decision may wait.

    report: those of the held-out cameras that only report; the others reward. None is trained on.
    judging: outcomes are scored from the reporting cameras instead of the rewarding ones (``judged``).
    motions: every episode has a motion of its own, drawn from its seed, where a world moves; False, and with
    recordings, the same one everywhere, so that seeds differ in their channel and instants alone.

    steps: of the optimiser for the update of a decision. scratch: every update begins with nothing, as in
    the thesis (5.4, 6.3); else with a copy of the episode's warm field, which was trained for
    ``warm_steps`` before the first decision and, with everything there was, for ``steps`` more
    ``refresh_ms`` before each. repeat: number of the stream that fields draw from: fits that differ in
    nothing else differ by their luck. compute: what virtual time charges an update. parts: of the state that
    decisions are drawn with (6.33); only with semantics are frames embedded, as ``edge.embedding`` of the
    scenario says. silent: cameras that never send anything.
    """

    scenario: Scenario
    report: tuple[str, ...] = ()
    judging: bool = False
    motions: bool = True
    steps: int = 100
    scratch: bool = False
    warm_steps: int = 150
    refresh_ms: float = 300.0
    repeat: int = 0
    decisions: int = 4
    lead_ms: float = 1000.0
    span_ms: float = 6000.0
    horizon_ms: float = 2000.0
    compute: ComputeConfig = dataclasses.field(default_factory=ComputeConfig)
    parts: tuple[str, ...] = ("age", "pose")
    silent: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.scenario.held_out:
            raise ScenarioError(
                f"{self.scenario.path}: cameras.held_out: nothing is held out, so that there is no reward: "
                "name a camera that no update may use"
            )
        if unknown := set(self.report) - set(self.scenario.held_out):
            raise ValueError(f"report: {', '.join(sorted(unknown))} is not held out")
        if not self.rewarding:
            raise ValueError("report: every held-out camera only reports, so that there is no reward")
        if unknown := set(self.silent) - set(self.scenario.training):
            raise ValueError(f"silent: {', '.join(sorted(unknown))} is not a training camera")
        if min(self.steps, self.warm_steps, self.decisions) < 1:
            raise ValueError("steps, warm_steps and decisions: expected at least 1")
        if not (self.span_ms >= GRID_MS and self.horizon_ms > 0.0 and 0.0 < self.refresh_ms < self.lead_ms):
            raise ValueError(
                f"span_ms: expected at least {GRID_MS}; horizon_ms: more than 0; refresh_ms: more than 0 and "
                "less than lead_ms"
            )

    @property
    def draws_motions(self) -> bool:
        """Whether episodes differ in their motion, too: a recording has only its own."""
        return self.motions and self.scenario.source.get("kind") == "world"

    @property
    def rewarding(self) -> tuple[str, ...]:
        """Held-out cameras that reward."""
        return tuple(c for c in self.scenario.held_out if c not in self.report)

    @property
    def scoring(self) -> tuple[str, ...]:
        """Held-out cameras that outcomes are scored from."""
        return self.report if self.judging else self.rewarding

    @property
    def judged(self) -> Setting:
        """The same decisions, scored by the cameras that report; itself where there is none."""
        return dataclasses.replace(self, judging=True) if self.report else self

    @cached_property
    def key(self) -> str:
        """Tells settings apart: a hash of everything that decides an evaluation, the episode's seed aside."""
        s = self.scenario
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "scenario"}
        own["compute"] = dataclasses.astuple(self.compute)
        parts: list[Any] = [s.seed, s.cameras, s.held_out, s.source, s.channel, s.edge, own]
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:24]

    def seeded(self, seed: int, moves: bool = False) -> Scenario:
        """The deployment of one episode. moves: its world does, so that its motion is drawn, too."""
        source = self.scenario.source
        if moves and self.motions:
            source = {**source, "motion_seed": seed}
        return dataclasses.replace(self.scenario, seed=seed, source=source)

    def field_seed(self, seed: int) -> int:
        """What the field of an episode is seeded with."""
        words = np.random.SeedSequence([self.scenario.seed, seed, self.repeat]).generate_state(1)
        return int(words[0] >> 1)  # fields take what fits 31 bits


def seeds(run: int, purpose: str, count: int, first: int = 0) -> range:
    """Seeds of ``count`` episodes from number ``first`` on, for one of ``PURPOSES`` of the run seeded
    ``run``. ValueError where a range would reach into the next."""
    if not (0 <= run < 10**9 and first >= 0 and first + count <= SEEDS_A_PURPOSE):
        raise ValueError(f"seed: expected 0 to 999999999, and at most {SEEDS_A_PURPOSE} episodes")
    start = run * _SEEDS_A_RUN + PURPOSES.index(purpose) * SEEDS_A_PURPOSE + first
    return range(start, start + count)
