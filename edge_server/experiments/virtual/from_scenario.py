"""Builds a deployment in virtual time from a scenario: the same cameras, channel, policy and field as
live."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from camera_node.capture import Camera, build_cameras
from camera_node.settings import SourceConfig, WorldConfig, errors_of, source_config
from camera_node.synthetic import Scene, make_scene
from channel_emu.model.settings import channel_from_mapping
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.truth import CapturedTruth, ExactTruth, Truth
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Field
from edge_server.live.field_updater import open_updater
from edge_server.live.state import Publication
from edge_server.scheduler import make_policy
from edge_server.settings import EdgeConfig, cameras_move, read_config
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from edge_server.embed import Embedder


def build_deployment(
    scenario: Scenario,
    settings: RunSettings,
    *,
    field: Field | None = None,
    scorer: Scorer | None = None,
    cameras: list[Camera] | None = None,
    data: Path | None = None,
    on_published: Callable[[Publication], None] | None = None,
    truth: Truth | None = None,
    embedder: Embedder | None = None,
    on_motion: Callable[[EdgeConfig, str], None] | None = None,
) -> VirtualDeployment:
    """Build the deployment of ``scenario`` in virtual time, with the scenario's seed.

    settings: how it runs.
    field: to continue with; None makes the scenario's.
    scorer: None scores without LPIPS.
    cameras: result of ``training_cameras``, to share rendered frames between runs; None opens them.
    data: folder of recorded data sets.
    on_published: called with each publication.
    truth: result of ``build_truth``, to share it between runs; None builds it.
    embedder: to share it between runs; None: as the scenario says.
    on_motion: makes the deployment begin anew once a camera is seen to move, with a field for moving cameras;
    called then with the configuration and the camera.
    Raises ScenarioError or DatasetError.
    """
    edge = read_config(scenario)
    source = source_config(scenario)
    channel = channel_from_mapping(
        scenario.channel, f"{scenario.path}: channel", scenario.path.parent, scenario.cameras
    )
    try:
        policy = make_policy(edge.policy.name, edge.policy.value, scenario.rng("policy", edge.policy.name))
        field = field or _field(edge, scenario.seed)
    except ValueError as error:
        raise ScenarioError(f"{scenario.path}: edge: {error}") from None
    updater = open_updater(scenario, edge, policy, field, start_ns=0, embedder=embedder)
    if on_motion is not None and not cameras_move(scenario):
        updater.watch_cameras(read_config(scenario, moving=True), lambda new: _field(new, scenario.seed), on_motion)
    return VirtualDeployment(
        cameras or training_cameras(scenario, data),
        channel,
        updater,
        settings,
        scenario.seed,
        truth or build_truth(scenario, source, edge, scorer or Scorer(background=edge.background), data),
        on_published,
    )


def training_cameras(scenario: Scenario, data: Path | None = None) -> list[Camera]:
    """The training cameras as a node would host them. Raises ScenarioError for real cameras and for cameras
    on an arm, which run only in real time."""
    source = source_config(scenario)
    if source.waits or getattr(source, "arm", None) is not None:
        raise ScenarioError(
            f"{scenario.path}: source: its cameras or its arm keep real time and cannot be run in virtual "
            "time: use freshfield demo, or camera-node and edge-server run"
        )
    return build_cameras(scenario, source, scenario.training, data, tuned.FRAME_CACHE_BYTES)


def build_truth(
    scenario: Scenario, source: SourceConfig, edge: EdgeConfig, scorer: Scorer, data: Path | None = None
) -> Truth | None:
    """The exact scene if the world is synthetic, else the held-out captures; None if no camera is held
    out."""
    if not scenario.held_out:
        return None
    if isinstance(source, WorldConfig) and not scenario.held_out_every:
        scene = exact_scene(scenario, source)
        known = scene.cameras
        names = dict(zip(scenario.cameras, scenario.cameras if set(scenario.cameras) <= set(known) else known))
        cameras = {camera: known[names[camera]] for camera in scenario.held_out}
        return ExactTruth(scorer, cameras, lambda camera, t_s: scene.render(names[camera], t_s))
    held_out = build_cameras(scenario, source, scenario.held_out, data, tuned.FRAME_CACHE_BYTES)
    return CapturedTruth(scorer, held_out, edge.noisy_truth)


def exact_scene(scenario: Scenario, source: WorldConfig) -> Scene:
    """The world itself: noise and wrong poses belong to captured frames. Raises ScenarioError."""
    with errors_of(f"{scenario.path}: source"):
        return make_scene(source.scene, {"count": len(scenario.cameras), **source.scene_parameters()})


def _field(edge: EdgeConfig, seed: int) -> Field:
    from edge_server.fields.registry import make_field

    return make_field(edge.field, edge.field_options, seed=seed)
