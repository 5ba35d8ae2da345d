"""The model of a scenario's ``edge:`` section.

What it leaves open is chosen by what the cameras do. Where cameras stand still, ``splat`` works in layers and follows
arrivals in short updates; where a camera moves, it is a scan that chooses its own keyframes. With many cameras, with
other fields, and in the thesis's cycle (``updates: cycle``), earlier viewpoints go on supervising. docs/scheduling.md
has the figures. Whatever a scenario says itself is left as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec.structs import replace

from edge_server import edge_constants as tuned
from edge_server.edge_constants import LONGEST_MS
from edge_server.fidelity.images import color_behind
from edge_server.fields.registry import FIELD
from edge_server.scheduler import Policy, resolve_checkpoint
from freshfield.scenario import Scenario
from freshfield.settings import ScenarioError, Settings, about, read_settings, within
from freshfield.untrusted import read_json, read_text

if TYPE_CHECKING:
    from edge_server.embed.settings import EmbeddingConfig


LEAST_UPDATE_MS = 10.0
"""Shortest fitting time of an update: a shorter one is not worth the decoding of its views."""
MOST_MS = 1e9
"""Largest cost that virtual time charges."""
CHOSEN = ("field", "layers", "updates", "update_ms", "steps", "keyframes")


class PolicyConfig(Settings, frozen=True):
    """Which views an update uses. value: omega_ms, k or period_ms; not given: the policy's own default."""

    name: Annotated[str, about("a policy of edge_server.scheduler, or bandit:FILE, relative to the scenario")] = "all"
    value: Annotated[float | None, about("the policy's one parameter")] = None


class ComputeConfig(Settings, frozen=True):
    """What an update costs in virtual time; by default nothing, as in the thesis. ``edge-server costs``
    measures what a machine takes."""

    ms_per_step: Annotated[float, within(0.0, MOST_MS, "for each optimizer step")] = 0.0
    ms_per_update: Annotated[float, within(0.0, MOST_MS, "for each update")] = 0.0
    ms_per_view: Annotated[float, within(0.0, MOST_MS, "for each frame that arrived since the last update")] = 0.0

    def charge_ns(self, steps: int, arrivals: int = 0) -> int:
        """Nanoseconds of an update of ``steps`` optimizer steps and ``arrivals`` new frames."""
        return round((self.ms_per_update + self.ms_per_step * steps + self.ms_per_view * arrivals) * 1e6)


class KeyframesConfig(Settings, frozen=True):
    """Earlier viewpoints of moving cameras (``live.keyframes``). A view becomes a keyframe at a distance or at an
    angle from all others."""

    most: Annotated[int, within(1, 1000, "keyframes of each camera")] = 32
    apart_m: Annotated[float, within(0.0, math.inf, "distance between keyframes")] = 0.03
    apart_deg: Annotated[float, within(0.0, math.inf, "angle between keyframes")] = 5.0


class EdgeConfig(Settings, frozen=True):
    """The edge section of a scenario. What a scenario does not name is neither imported nor computed.

    field, layers, updates, update_ms, steps, keyframes: what a scenario leaves open is chosen by what its cameras do
        (``with_defaults``); the values here are those of the thesis's cycle.
    updates: cycle starts an update when the last one is done, as in the thesis; arrivals as soon as a frame has
        arrived since.
    frontier: page and report draw it; not given: the shipped one.
    compute: ``zero``, the milliseconds of ``ComputeConfig``, or a file of ``edge-server costs``, relative to the
        scenario.
    noisy_truth: the bound of moving pixels follows the noise of held-out frames.
    keyframes: null: earlier viewpoints do not go on supervising.
    embedding, foreground: an ``embed.EmbeddingConfig`` and a ``foreground.ForegroundConfig``, whose modules only a
        scenario that has them imports; so with depth_network.
    """

    field: Annotated[str, about("the representation (edge_server.fields.registry)")] = FIELD
    field_options: Annotated[dict[str, Any], about("its settings")] = msgspec.field(default_factory=dict)
    policy: Annotated[PolicyConfig, about("which views an update uses")] = msgspec.field(default_factory=PolicyConfig)
    updates: Annotated[Literal["cycle", "arrivals"], about("by what cameras do, see above")] = tuned.CYCLE["updates"]
    update_ms: Annotated[float, within(LEAST_UPDATE_MS, LONGEST_MS, "fitting time; by what cameras do, see above")] = (
        tuned.CYCLE["update_ms"]
    )
    frontier: Annotated[str | None, about("frontier.json of edge-server frontier, relative to the scenario")] = None
    steps: Annotated[int, within(1, 10_000_000, "optimizer steps of an update in virtual time")] = tuned.CYCLE["steps"]
    compute: Annotated[ComputeConfig, about("cost of an update in virtual time")] = msgspec.field(
        default_factory=ComputeConfig
    )
    grace_ms: Annotated[float, within(0.0, LONGEST_MS, "the first update waits for cameras without a report")] = 3000.0
    lpips: Annotated[Literal["alex", "none"], about("network to score with, where its weights are")] = "alex"
    noisy_truth: Annotated[bool, about("held-out frames are noisy video")] = False
    embedding: Annotated[Any, about("for policies that look at what cameras see")] = None
    keyframes: Annotated[KeyframesConfig | None, about("earlier viewpoints of moving cameras go on supervising")] = None
    foreground: Annotated[Any, about("cuts the background out of every view")] = None
    depth_network: Annotated[
        str | None, about("ONNX of relative inverse depth for few fixed cameras, relative to the scenario")
    ] = None

    @property
    def background(self) -> tuple[float, float, float]:
        """The color in [0, 1] that the field shows where images are transparent."""
        return color_behind(self.field_options)


def cameras_move(scenario: Scenario) -> bool:
    """Whether a scenario says that its cameras move: an arm, a trajectory or somebody carries them. Others may move,
    too, which their poses tell."""
    known = any(scenario.source.get(key) is not None for key in ("arm", "trajectory"))
    return known or bool(scenario.source.get("carried")) or bool(scenario.held_out_every)


def with_defaults(section: Mapping[str, Any], moving: bool, cameras: int) -> dict[str, Any]:
    """An ``edge:`` section with what it leaves open of field, layers, updates, update_ms, steps and keyframes.

    moving: whether a camera moves. cameras: how many are trained on. Keys that it has stay, whatever their values.
    """
    found = {"field": FIELD, **section}
    options = found.get("field_options", {})
    if not isinstance(options, dict):  # refused by who reads the section
        return found
    usual = found["field"] == FIELD and found.get("updates") != "cycle"
    if usual and not moving and "layers" not in options:
        found["field_options"] = options = {**options, "layers": True}
    layers = bool(options.get("layers"))
    if usual and moving and not layers and cameras <= tuned.MOST_CARRIED and "keyframes" not in found:
        found["field_options"] = {**tuned.CARRIED_OPTIONS, **options}
        return {**tuned.CARRIED, **found}
    if moving and not layers:
        found.setdefault("keyframes", {})
    found.setdefault("updates", (tuned.ARRIVALS if layers else tuned.CYCLE)["updates"])
    times = tuned.ARRIVALS if layers and found["updates"] == "arrivals" else tuned.CYCLE
    return {**times, **found}


def described(scenario: Scenario, config: EdgeConfig, moving: str) -> str:
    """One line for people: how the edge works, and why.

    config: the scenario's, with defaults.
    moving: what moves, such as a camera's name; empty: nothing.
    """
    layers = " in layers" if config.field_options.get("layers") else ""
    scan = " as a scan" if config.field_options.get("carried") else ""
    keyframes = " with keyframes" if config.keyframes is not None else ""
    pace = "at arrivals" if config.updates == "arrivals" else "in a cycle"
    line = f"{config.field}{layers}{scan}{keyframes}, updated {pace} for {config.update_ms:g} ms"
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
    from edge_server.embed.settings import EmbeddingConfig

    return EmbeddingConfig()


def read_config(scenario: Scenario, moving: bool | None = None) -> EdgeConfig:
    """The edge section of a scenario, with what it leaves open. Raises ScenarioError.

    moving: whether a camera moves, as its poses told; None: as the scenario says, else they stand still.
    """
    moves = cameras_move(scenario) if moving is None else moving
    section = with_defaults(scenario.edge, moves, len(scenario.training))
    if section.get("compute") == "zero":
        section["compute"] = {}
    elif isinstance(section.get("compute"), str):
        section["compute"] = _read_json(scenario, "compute", section["compute"]).get("compute")
    if section.get("embedding") is not None:
        from edge_server.embed.settings import read_embedding

        section["embedding"] = read_embedding(section["embedding"], scenario.path)
    if section.get("foreground") is not None:
        from edge_server.foreground.settings import read_foreground

        section["foreground"] = read_foreground(section["foreground"], scenario.path)
    config = read_settings(EdgeConfig, section, f"{scenario.path}: edge")
    name = resolve_checkpoint(config.policy.name, scenario.path.parent)
    return replace(config, policy=replace(config.policy, name=name))


def _read_json(scenario: Scenario, key: str, name: str) -> dict[str, Any]:
    """An object in a JSON file that the scenario names, relative to it. Raises ScenarioError."""
    path = scenario.path.parent / name
    try:
        found = read_json(read_text(path))
        if not isinstance(found, dict):
            raise ValueError("expected a JSON object")
        return found
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{scenario.path}: edge.{key}: {path}: {error}") from None
