"""Settings of decisions and evaluations, as plain values that can be sent to other processes."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from edge_server.experiments import experiment_constants as tuned
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.scheduler.learned.rewards import Reward, make_reward
from edge_server.scheduler.learned.state import StateLayout
from edge_server.settings import ComputeConfig, read_config
from freshfield.scenario import Scenario, ScenarioError

# Training, model selection and testing use disjoint seeds.
PURPOSES = ("train", "choose", "test")
SEEDS_A_PURPOSE = 10**6
_SEEDS_A_RUN = 10**7


@dataclass(frozen=True)
class Setting:
    """The setting of decisions and evaluations.

    scenario: the deployment; each episode replaces its seed and policy.
    report: held-out cameras that only report; the other held-out cameras reward. Neither is trained on.
    deployed: the scheduler decides in the running deployment, whose field is never reset, instead of at single
        instants.
    motions: draw each episode's motion from its seed, if the world moves. If False, and with recordings, all
        episodes share one motion and seeds differ only in channel and instants.
    steps: optimizer steps per update.
    scratch: start every update with an empty field, as in the thesis (5.4, 6.3); else with a copy of the
        episode's warm field, trained for ``warm_steps`` before the first decision and, on the newest frames,
        for ``steps`` more before each later one, ``refresh_ms`` before the decision.
    repeat: number of the fields' random stream, to measure the variance of repeated fits.
    decisions: number per episode, at random instants between ``lead_ms`` and ``lead_ms + span_ms`` of virtual
        time.
    horizon_ms: longest wait.
    compute: virtual time charged per update.
    parts: parts of the state (6.33); only "semantics" embeds frames, as the scenario's ``edge.embedding``
        configures.
    Raises ScenarioError or ValueError.
    """

    scenario: Scenario
    report: tuple[str, ...] = ()
    deployed: bool = False
    motions: bool = True
    steps: int = tuned.UPDATE_STEPS
    scratch: bool = False
    warm_steps: int = tuned.WARM_STEPS
    refresh_ms: float = tuned.REFRESH_MS
    repeat: int = 0
    decisions: int = tuned.DECISIONS
    lead_ms: float = tuned.LEAD_MS
    span_ms: float = tuned.SPAN_MS
    horizon_ms: float = tuned.HORIZON_MS
    compute: ComputeConfig = dataclasses.field(default_factory=ComputeConfig)
    parts: tuple[str, ...] = ("age", "pose")

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
        if min(self.steps, self.warm_steps, self.decisions) < 1:
            raise ValueError("steps, warm_steps and decisions: expected at least 1")
        if not (
            self.span_ms >= tuned.INSTANT_GRID_MS and self.horizon_ms > 0.0 and 0.0 < self.refresh_ms < self.lead_ms
        ):
            raise ValueError(
                f"span_ms: expected at least {tuned.INSTANT_GRID_MS}; horizon_ms: more than 0; "
                "refresh_ms: more than 0 and less than lead_ms"
            )

    def __hash__(self) -> int:
        return hash(self.key)

    @property
    def draws_motions(self) -> bool:
        """Whether each episode has its own motion; a recording has only one."""
        return self.motions and self.scenario.source.get("kind") == "world"

    @property
    def rewarding(self) -> tuple[str, ...]:
        """Held-out cameras that reward."""
        return tuple(c for c in self.scenario.held_out if c not in self.report)

    @property
    def judging(self) -> tuple[str, ...]:
        """Held-out cameras that judge trained policies: those that report, if there are any."""
        return self.report or self.rewarding

    @cached_property
    def key(self) -> str:
        """Hash of everything that determines an evaluation, except the episode's seed."""
        s = self.scenario
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "scenario"}
        own["compute"] = structs.astuple(self.compute)
        parts: list[Any] = [s.seed, s.cameras, s.held_out, s.source, s.channel, s.edge, own]
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:24]

    def seeded(self, seed: int, moves: bool = False) -> Scenario:
        """The deployment of one episode. moves: its world moves, so its motion is drawn from the seed."""
        source = self.scenario.source
        if moves and self.motions:
            source = {**source, "motion_seed": seed}
        return dataclasses.replace(self.scenario, seed=seed, source=source)

    def field_seed(self, seed: int) -> int:
        """Seed of an episode's field."""
        words = np.random.SeedSequence([self.scenario.seed, seed, self.repeat]).generate_state(1)
        return int(words[0] >> 1)  # fields take 31-bit seeds


def seeds(run: int, purpose: str, count: int, first: int = 0) -> range:
    """Seeds of ``count`` episodes from number ``first`` on, for one of ``PURPOSES`` of run ``run``. Raises
    ValueError if the range would overlap the next."""
    if not (0 <= run < 10**9 and first >= 0 and first + count <= SEEDS_A_PURPOSE):
        raise ValueError(f"seed: expected 0 to 999999999, and at most {SEEDS_A_PURPOSE} episodes")
    start = run * _SEEDS_A_RUN + PURPOSES.index(purpose) * SEEDS_A_PURPOSE + first
    return range(start, start + count)


def reward_of(name: str, on: str, lpips_folder: Path | None, network: str = "alex") -> tuple[Reward, str | None]:
    """A preset reward, and why it has no LPIPS term (None if it has one).

    name: name of the preset.
    on: whole or moving, the pixels of the PSNR.
    lpips_folder: folder of the LPIPS weights.
    network: the scenario's edge.lpips.
    """
    reward = make_reward(name, fidelity=on)
    missing: str | None = "the scenario's edge.lpips is none"
    if network != "none":
        _, missing = open_lpips(lpips_folder)
    if not missing:
        return reward, None
    # Nothing can be learned from rewards that are never complete.
    return dataclasses.replace(reward, distance=0.0), f"the reward has no term of LPIPS: {missing}"


def layout_of(setting: Setting, parts: tuple[str, ...]) -> StateLayout:
    """The layout of a network's input: ``parts`` of the state, with the embedding of the setting's scenario.
    Raises ValueError if no embedder is available."""
    if "semantics" not in parts:
        return StateLayout(parts)
    from edge_server.embed import make_embedder
    from edge_server.embed.settings import EmbeddingConfig

    embedder = make_embedder(read_config(setting.scenario).embedding or EmbeddingConfig())
    return StateLayout(parts, embedder.dim, embedding=embedder.name)
