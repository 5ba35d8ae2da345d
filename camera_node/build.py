"""From a scenario to cameras that are ready to capture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from camera_node.capture import Camera, EncodedCache
from camera_node.config import SourceConfig
from camera_node.sources import open_sources
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from camera_node.synthetic.effects import Effects


def build_cameras(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None = None,
    cache_bytes: int = 64 * 2**20,
) -> list[Camera]:
    """Open the sources of ``cameras``, in the scenario's order, with one cache for all.

    Raises ScenarioError or DatasetError, both with one line for a person.
    """
    effects = {camera: load(scenario, config, camera) for camera in cameras}
    sources = open_sources(scenario, config, cameras, data, effects)
    cache = EncodedCache(cache_bytes)
    drifts = {c: made for c, made in effects.items() if made is not None and made.clock}
    return [Camera(sources[c], config, cache, drifts.get(c)) for c in scenario.cameras if c in sources]


def load(scenario: Scenario, config: SourceConfig, camera: str) -> Effects | None:
    """The effects of one camera, or None, for which nothing at all is imported. Raises ScenarioError."""
    if not config.effects:
        return None
    from camera_node.synthetic.effects import EffectError, load_effects

    try:
        effects = load_effects(
            config.effect_parameters,
            lambda name: scenario.rng(f"effect {name}", camera),
            held_out=camera in scenario.held_out,
        )
    except EffectError as error:
        raise ScenarioError(f"{scenario.path}: source.effects: {error}") from None
    if config.kind != "world" and (effects.world or effects.lens or effects.exposure):
        raise ScenarioError(
            f"{scenario.path}: source.effects: effects of the kinds world, lens and exposure need "
            "source kind world"
        )
    return effects
