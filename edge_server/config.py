"""The model of a scenario's ``edge:`` section."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge_server.scheduler import Policy, resolve_checkpoint
from freshfield.scenario import Scenario, read_section

if TYPE_CHECKING:
    from edge_server.embed import EmbeddingConfig
    from edge_server.embed.embedder import Embedder


@dataclass(frozen=True)
class PolicyConfig:
    """Which views an update uses. value: the policy's one parameter (omega_ms, k, period_ms), see
    edge_server.scheduler; None takes the policy's default. name: also bandit:FILE, relative to the
    scenario."""

    name: str = "all"
    value: float | None = None


@dataclass(frozen=True)
class LearnConfig:
    """How a policy that was learnt goes on learning while it is used (``edge-server run``; in virtual time
    nobody does). reward: NAME or NAME:moving of edge_server.scheduler.learned.rewards; empty: the one it was
    trained with. fallback: the fixed policy beside it, NAME or NAME:VALUE; empty: the best of its
    training."""

    reward: str = ""
    fallback: str = ""


@dataclass(frozen=True)
class ComputeConfig:
    """What virtual time charges an update; live time charges what it takes. The default is nothing, as the
    thesis has it; ``edge-server frontier`` measures what a machine takes. ms_per_treated_view: of policies
    that mask or freshen views."""

    ms_per_step: float = 0.0
    ms_per_update: float = 0.0
    ms_per_treated_view: float = 0.0

    def __post_init__(self) -> None:
        if not all(0.0 <= ms < 1e9 for ms in dataclasses.astuple(self)):
            raise ValueError("compute: milliseconds must be finite and not negative")

    def charge_ns(self, steps: int, treated: int = 0) -> int:
        """Nanoseconds that an update of ``steps`` optimiser steps takes, ``treated`` views treated before."""
        views_ms = self.ms_per_treated_view * treated
        return round((self.ms_per_update + self.ms_per_step * steps + views_ms) * 1e6)


@dataclass(frozen=True)
class KeyframesConfig:
    """Earlier viewpoints of cameras that move, for ``live.keyframes``. most: of each camera. apart_m,
    apart_deg: a viewpoint is another one if it lies so far from all that are kept, or is turned so far."""

    most: int = 32
    apart_m: float = 0.03
    apart_deg: float = 5.0

    def __post_init__(self) -> None:
        if not 1 <= self.most <= 1000:
            raise ValueError(f"most: expected 1 to 1000, got {self.most}")
        if self.apart_m < 0 or self.apart_deg < 0:
            raise ValueError("apart_m and apart_deg cannot be negative")


@dataclass(frozen=True)
class ExportConfig:
    """What a run leaves at its end besides its report: deploy/up.py has ``edge-server export`` make it. mesh:
    file in the run's folder, .ply or .glb. voxel_mm: of the mesh; None: what a pixel spans at the surface."""

    mesh: str
    voxel_mm: float | None = None

    def __post_init__(self) -> None:
        if Path(self.mesh).name != self.mesh or Path(self.mesh).suffix.lower() not in (".ply", ".glb"):
            raise ValueError(f"mesh: expected a file name that ends in .ply or .glb, got {self.mesh!r}")
        if self.voxel_mm is not None and not 0.01 <= self.voxel_mm <= 1000.0:
            raise ValueError(f"voxel_mm: expected 0.01 to 1000, got {self.voxel_mm:g}")


@dataclass(frozen=True)
class EdgeConfig:
    """The edge section of a scenario.

    field, field_options: the representation and its settings (edge_server.fields.registry).
    update_ms: what one update may spend fitting. deadline_ms: instead of it, from decision to publication:
    the best way to spend it is looked up in ``frontier`` (a frontier.json of ``edge-server frontier``,
    relative to the scenario; None: the one shipped), and the time to fit follows how busy the machine is.
    steps, compute: of an update in virtual time, where optimiser steps are counted, not seconds: how many,
    and what is charged for them (``zero``, or ms_per_step and ms_per_update).
    grace_ms: how long the first update waits for cameras that have not reported. lpips: network scored
    with, where its weights are installed; none turns it off.
    noisy_truth: held-out frames are real or noisy video, so that the bound of moving pixels follows
    their noise. metrics: further ones to score with: perceptual, the stand-in where there is no LPIPS
    (fidelity.perceptual). embedding: an edge_server.embed.EmbeddingConfig for policies that look at what
    cameras see; None: nothing is embedded. keyframes: earlier viewpoints of cameras that move go on
    supervising; not given, nothing of the kind is loaded or kept. learn: a policy bandit:FILE goes on
    learning, by the held-out cameras; not given, it stays as it is. foreground: an
    edge_server.foreground.ForegroundConfig, cuts the background out of every view; None: views stay whole.
    export: an ``ExportConfig``, what deploy/up.py makes of the field when the run ends.
    """

    field: str = "ngp"
    field_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    update_ms: float = 800.0
    deadline_ms: float | None = None
    frontier: str | None = None
    steps: int = 100
    compute: ComputeConfig = dataclasses.field(default_factory=ComputeConfig)
    grace_ms: float = 3000.0
    lpips: str = "alex"
    noisy_truth: bool = False
    metrics: tuple[str, ...] = ()
    embedding: Any = None  # named here, its module would be imported whether a scenario asks for it or not
    keyframes: KeyframesConfig | None = None
    foreground: Any = None  # as embedding
    learn: LearnConfig | None = None
    export: ExportConfig | None = None

    def __post_init__(self) -> None:
        if not 10.0 <= self.update_ms <= 3_600_000.0:
            raise ValueError(f"update_ms: expected 10 to 3600000, got {self.update_ms:g}")
        if self.deadline_ms is not None and not 20.0 <= self.deadline_ms <= 3_600_000.0:
            raise ValueError(f"deadline_ms: expected 20 to 3600000, got {self.deadline_ms:g}")
        if self.frontier is not None and self.deadline_ms is None:
            raise ValueError("frontier: it is read for a deadline_ms, which is not given")
        if not 1 <= self.steps <= 10_000_000:
            raise ValueError(f"steps: expected 1 to 10000000, got {self.steps}")
        if self.grace_ms < 0:
            raise ValueError("grace_ms: expected zero or more")
        if self.lpips not in ("alex", "squeeze", "none"):
            raise ValueError(f"lpips: expected alex, squeeze or none, got {self.lpips!r}")
        if unknown := set(self.metrics) - {"perceptual"}:
            raise ValueError(f"metrics: expected perceptual, got {', '.join(sorted(unknown))}")


def embedding_for(config: EdgeConfig, policy: Policy) -> EmbeddingConfig | None:
    """How frames are embedded, where the scenario or the policy asks for it: as the scenario says, else as
    policies are taught where it says nothing. None: nobody asks, and nothing of it is imported."""
    if config.embedding is not None or not policy.embedding[0]:
        return config.embedding
    from edge_server.embed import EmbeddingConfig

    return EmbeddingConfig()


def open_embedder(embedding: EmbeddingConfig | None) -> Embedder | None:
    """What embeds frames; None for None. ValueError where the model cannot be used."""
    if embedding is None:
        return None
    from edge_server.embed import make_embedder

    return make_embedder(embedding)


def read_config(scenario: Scenario) -> EdgeConfig:
    """The edge section of a scenario; raises freshfield.scenario.ScenarioError."""
    section = dict(scenario.edge)
    if section.get("compute") == "zero":
        section["compute"] = {}
    if section.get("embedding") is not None:
        from edge_server.embed import read_embedding

        section["embedding"] = read_embedding(section["embedding"], scenario.path)
    if section.get("foreground") is not None:
        from edge_server.foreground import read_foreground

        section["foreground"] = read_foreground(section["foreground"], scenario.path)
    config = read_section(EdgeConfig, section, f"{scenario.path}: edge")
    name = resolve_checkpoint(config.policy.name, scenario.path.parent)
    return dataclasses.replace(config, policy=dataclasses.replace(config.policy, name=name))
