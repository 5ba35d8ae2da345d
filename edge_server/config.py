"""The model of a scenario's ``edge:`` section."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from edge_server.edge_defaults import CHOSEN, CYCLE, FIELD, cameras_move, with_defaults
from edge_server.scheduler import Policy, resolve_checkpoint
from freshfield.limits import LONGEST_MS
from freshfield.scenario import Scenario, ScenarioError, read_section
from freshfield.untrusted import read_json

if TYPE_CHECKING:
    from edge_server.embed import EmbeddingConfig
    from edge_server.embed.embedder import Embedder


LEAST_UPDATE_MS = 10.0
"""Shortest fitting time of an update: a shorter one is not worth the decoding of its views."""


@dataclass(frozen=True)
class PolicyConfig:
    """Which views an update uses.

    name: a policy of edge_server.scheduler, or bandit:FILE, relative to the scenario.
    value: the policy's one parameter (omega_ms, k, period_ms); None takes its default.
    """

    name: str = "all"
    value: float | None = None


@dataclass(frozen=True)
class ComputeConfig:
    """What an update costs in virtual time; by default nothing, as in the thesis. ``edge-server costs``
    measures what a machine takes.

    ms_per_step: for each optimizer step. ms_per_update: for each update.
    ms_per_view: for each frame that has arrived since the last update.
    """

    ms_per_step: float = 0.0
    ms_per_update: float = 0.0
    ms_per_view: float = 0.0

    def __post_init__(self) -> None:
        if not all(0.0 <= ms < 1e9 for ms in dataclasses.astuple(self)):
            raise ValueError("compute: milliseconds must be finite and not negative")

    def charge_ns(self, steps: int, arrivals: int = 0) -> int:
        """Nanoseconds of an update of ``steps`` optimizer steps and ``arrivals`` new frames."""
        return round((self.ms_per_update + self.ms_per_step * steps + self.ms_per_view * arrivals) * 1e6)


@dataclass(frozen=True)
class KeyframesConfig:
    """Earlier viewpoints of moving cameras (``live.keyframes``).

    most: largest number of keyframes of each camera.
    apart_m, apart_deg: a view becomes a keyframe at this distance or angle from all others.
    """

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
    """What ``edge-server export`` makes of the field at the end of a run of deploy/up.py.

    mesh: file in the run's folder, .ply or .glb.
    voxel_mm: side of a voxel; None: the size of a pixel at the surface.
    """

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
    What a scenario leaves open of field, layers, updates, update_ms, steps and keyframes is chosen by what
    its cameras do (``edge_defaults``); the values here are those of the thesis's cycle.
    policy: which views an update uses.
    updates: cycle starts an update when the last one is done, as in the thesis; arrivals as soon as a frame
    has arrived since.
    update_ms: fitting time of an update.
    frontier: a frontier.json of ``edge-server frontier``, relative to the scenario, which page and report
    draw. None: the shipped one.
    steps: optimizer steps of an update in virtual time.
    compute: what an update costs in virtual time: ``zero``, the milliseconds of ``ComputeConfig``, or a file
    of ``edge-server costs``, relative to the scenario.
    scores: what policies reach in virtual time, for the page: the values of a scores.json of ``edge-server
    train-scheduler --hold``, which a scenario names relative to itself.
    grace_ms: how long the first update waits for cameras that have not reported.
    lpips: network to score with, where its weights are installed; none turns it off.
    noisy_truth: held-out frames are noisy video, so that the bound of moving pixels follows their noise.
    metrics: further ones to score with: perceptual, the stand-in where there is no LPIPS.
    embedding: an edge_server.embed.EmbeddingConfig, for policies that look at what cameras see.
    keyframes: earlier viewpoints of moving cameras go on supervising; null: they do not.
    foreground: an edge_server.foreground.ForegroundConfig, cuts the background out of every view.
    export: what deploy/up.py makes of the field when the run ends.
    What a scenario does not name is neither imported nor computed.
    """

    field: str = FIELD
    field_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    updates: str = CYCLE["updates"]
    update_ms: float = CYCLE["update_ms"]
    frontier: str | None = None
    steps: int = CYCLE["steps"]
    compute: ComputeConfig = dataclasses.field(default_factory=ComputeConfig)
    grace_ms: float = 3000.0
    lpips: str = "alex"
    noisy_truth: bool = False
    metrics: tuple[str, ...] = ()
    embedding: Any = None  # its type would import its module whether a scenario asks for it or not
    keyframes: KeyframesConfig | None = None
    foreground: Any = None  # as embedding
    export: ExportConfig | None = None
    scores: Any = None

    def __post_init__(self) -> None:
        for name, least in (("update_ms", LEAST_UPDATE_MS), ("grace_ms", 0.0)):
            value = getattr(self, name)
            if not least <= value <= LONGEST_MS:
                raise ValueError(f"{name}: expected {least:g} to {LONGEST_MS:.0f}, got {value:g}")
        if self.updates not in ("cycle", "arrivals"):
            raise ValueError(f"updates: expected cycle or arrivals, got {self.updates!r}")
        if not 1 <= self.steps <= 10_000_000:
            raise ValueError(f"steps: expected 1 to 10000000, got {self.steps}")
        if self.lpips not in ("alex", "squeeze", "none"):
            raise ValueError(f"lpips: expected alex, squeeze or none, got {self.lpips!r}")
        if unknown := set(self.metrics) - {"perceptual"}:
            raise ValueError(f"metrics: expected perceptual, got {', '.join(sorted(unknown))}")


def described(scenario: Scenario, config: EdgeConfig, moving: str) -> str:
    """One line for people: how the edge works, and why.

    config: the scenario's, with defaults.
    moving: what moves, such as a camera's name; empty: nothing.
    """
    layers = " in layers" if config.field_options.get("layers") else ""
    keyframes = " with keyframes" if config.keyframes is not None else ""
    pace = "at arrivals" if config.updates == "arrivals" else "in a cycle"
    line = f"{config.field}{layers}{keyframes}, updated {pace} for {config.update_ms:g} ms"
    options = scenario.edge.get("field_options") or {}
    given = [key for key in CHOSEN if key in scenario.edge or key in options]
    open_keys = {"layers", "updates", "keyframes"} - set(given)
    why = [f"{moving} moves" if moving else "no camera moves"] if open_keys else []
    why += [f"the scenario sets {', '.join(given)}"] if given else []
    return f"{line}: {'; '.join(why)}"


def embedding_for(config: EdgeConfig, policy: Policy) -> EmbeddingConfig | None:
    """How frames are embedded: as the scenario says, else, if the policy needs embeddings, with the defaults
    that policies are trained with. None where neither asks for embeddings."""
    if config.embedding is not None or policy.embedding[0] == 0:
        return config.embedding
    from edge_server.embed import EmbeddingConfig

    return EmbeddingConfig()


def open_embedder(embedding: EmbeddingConfig | None) -> Embedder | None:
    """The embedder; None without a config. ValueError where its model cannot be used."""
    if embedding is None:
        return None
    from edge_server.embed import make_embedder

    return make_embedder(embedding)


class _Machine(msgspec.Struct):
    cpu: str
    cores: int


class _OwnSeed(msgspec.Struct):
    psnr_db: float | None
    views: float | None


class _Policy(msgspec.Struct):
    own_seed: _OwnSeed
    psnr_db_over_all: tuple[float | None, float | None, float | None] = (None, None, None)


class _Scores(msgspec.Struct):
    """What the page shows of a scores.json (``page.markup.policy_scores``)."""

    seconds: float
    seed: int
    seeds: int
    machine: _Machine
    policies: dict[str, _Policy]


def read_config(scenario: Scenario, moving: bool | None = None) -> EdgeConfig:
    """The edge section of a scenario, with what it leaves open. Raises ScenarioError.

    moving: whether a camera moves, as its poses told; None: as the scenario says, else they stand still.
    """
    section = with_defaults(scenario.edge, cameras_move(scenario) if moving is None else moving)
    if section.get("compute") == "zero":
        section["compute"] = {}
    elif isinstance(section.get("compute"), str):
        section["compute"] = _read_json(scenario, "compute", section["compute"]).get("compute")
    if section.get("embedding") is not None:
        from edge_server.embed import read_embedding

        section["embedding"] = read_embedding(section["embedding"], scenario.path)
    if section.get("foreground") is not None:
        from edge_server.foreground import read_foreground

        section["foreground"] = read_foreground(section["foreground"], scenario.path)
    if section.get("scores") is not None:
        section["scores"] = _read_json(scenario, "scores", section["scores"], _Scores)
    config = read_section(EdgeConfig, section, f"{scenario.path}: edge")
    name = resolve_checkpoint(config.policy.name, scenario.path.parent)
    return dataclasses.replace(config, policy=dataclasses.replace(config.policy, name=name))


def _read_json(scenario: Scenario, key: str, name: str, model: type | None = None) -> dict[str, Any]:
    """An object in a JSON file that the scenario names, relative to it. Raises ScenarioError.

    model: what it must have at least.
    """
    if not isinstance(name, str):
        raise ScenarioError(f"{scenario.path}: edge.{key}: expected the name of a file, got {name!r}")
    path = scenario.path.parent / name
    try:
        found = read_json(path.read_text())
        if not isinstance(found, dict):
            raise ValueError("expected a JSON object")
        if model is not None:
            msgspec.convert(found, model)
        return found
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{scenario.path}: edge.{key}: {path}: {error}") from None
