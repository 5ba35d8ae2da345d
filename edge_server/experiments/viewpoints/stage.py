"""The stage of a capture: the candidate viewpoints of a scenario, their images, and the held-out views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from camera_node.settings import RecordedConfig, SourceConfig, WorldConfig, find_data, source_config
from camera_node.synthetic.scene import Scene
from edge_server.embed import EmbeddingError, make_embedder
from edge_server.embed.settings import EmbeddingConfig
from edge_server.experiments.scenes.multiview_still import WHITE, known_options, score_views
from edge_server.experiments.scenes.recorded import load_recorded
from edge_server.experiments.viewpoints.capture_constants import (
    HELD_OUT_VIEWPOINTS,
    NEAR_OF_RADIUS,
    PLAN_CANDIDATES,
    STAGE_EMBEDDING_DIM,
)
from edge_server.experiments.virtual.from_scenario import exact_scene
from edge_server.fidelity.images import BLACK, Color, to_bytes, to_unit
from edge_server.fidelity.scorer import Score, Scorer
from edge_server.fields import Budget, Field, View
from edge_server.fields.registry import make_field
from edge_server.viewpoints.candidates import Candidates, ViewpointError, from_poses, half_hemisphere
from edge_server.viewpoints.policy import Embed
from freshfield.scenario import Scenario, load

_BETWEEN = 0.25  # offset of ``half_hemisphere``


@dataclass
class Stage:
    """The stage of a capture.

    name: name of the scenario.
    candidates: viewpoints, with their reachability.
    held_out: views that no capture takes.
    options: options of the field that are known from the scene.
    background: color behind transparent images.
    scene: the synthetic scene; None for a recording.
    recorded: the candidates' views in a recording.
    """

    name: str
    candidates: Candidates
    held_out: tuple[View, ...]
    options: dict[str, Any]
    background: Color = BLACK
    scene: Scene | None = None
    recorded: tuple[View, ...] = ()
    _taken: dict[int, View] = field(default_factory=dict)

    def take(self, k: int) -> View:
        """The view at candidate k; of a synthetic scene it is rendered and cached."""
        if self.scene is None:
            return self.recorded[k]
        if k not in self._taken:
            self._taken[k] = _render(self.scene, f"view{k:03d}", self.candidates, k)
        return self._taken[k]

    def fit(self, views: Sequence[View], steps: int, seed: int) -> Field:
        """Fit a new field to the views."""
        made = make_field("splat", self.options, seed=seed)
        made.fit(list(views), Budget(steps=steps))
        return made

    def score(self, made: Field, scorer: Scorer) -> Score:
        """Mean fidelity on the held-out views."""
        return score_views(made, self.held_out, scorer)[0]


def open_stage(name: str, count: int = PLAN_CANDIDATES, size: int | None = None, data: Path | None = None) -> Stage:
    """Open the stage of a scenario: a file or the name of a shipped one.

    A synthetic world has ``count`` candidates on a half-hemisphere round its object, at the distance of the
    scenario's held-out camera or of its arm's path; with an arm, only those that it reaches are reachable.
    The candidates of a recording are its training views; every eighth view is held out.

    size: width and height of a world's images; None: the scenario's.
    data: folder of recorded data sets.
    Raises ScenarioError, DatasetError or ViewpointError.
    """
    scenario = load(name)
    source = source_config(scenario)
    if isinstance(source, WorldConfig):
        return _world(scenario, source, count, size)
    if isinstance(source, RecordedConfig):
        return _recording(scenario, source, data)
    raise ViewpointError(
        f"{scenario.path}: source: its cameras are real: a plan needs a synthetic world or a recording"
    )


def _world(scenario: Scenario, source: WorldConfig, count: int, size: int | None) -> Stage:
    if size is not None:
        source = structs.replace(source, width=size, height=size)
    scene = exact_scene(scenario, source)
    lens, pose = next(iter(scene.cameras.values()))
    target = np.asarray(scene.target)
    radius_m = float(np.linalg.norm(target - pose[:3, 3]))
    if pose[:3, 2] @ (target - pose[:3, 3]) < 0.0:
        raise ViewpointError(f"{scenario.path}: source: its cameras look outward: there is no object to go round")
    path = None if source.arm is None else source.arm.path
    sector: dict[str, Any] = {}
    if path is not None:
        target, radius_m = np.asarray(path.target_m), path.radius_m
        sector = {"azimuths_deg": path.azimuths_deg}
    candidates = replace(half_hemisphere(target, radius_m, lens, count, **sector), bounds=scene.bounds)
    tests = half_hemisphere(target, radius_m, lens, HELD_OUT_VIEWPOINTS, offset=_BETWEEN, **sector)
    if path is not None:
        candidates = candidates.within(_arm_reaches(scenario, source, candidates))
        # Viewpoints that the robot cannot reach are not scored either, unless it reaches none.
        reached = _arm_reaches(scenario, source, tests)
        reached |= not reached.any()
        tests = Candidates(tests.poses[reached], lens, target, reached[reached])
    held_out = tuple(_render(scene, f"test{k:02d}", tests, k) for k in range(len(tests)))
    return Stage(scenario.name, candidates, held_out, known_options(scene, NEAR_OF_RADIUS * radius_m), scene=scene)


def _arm_reaches(scenario: Scenario, source: SourceConfig, candidates: Candidates) -> NDArray[np.bool_]:
    from camera_node.robot.arm.camera_poses import arm_model, base_matrix, mount_on_flange
    from camera_node.robot.arm.tour_planning import reachable

    arm = source.arm  # type: ignore[attr-defined]
    mount = mount_on_flange(scenario, arm)
    return reachable(arm_model(scenario, arm), base_matrix(arm), mount, arm.path, list(candidates.poses))


def _recording(scenario: Scenario, source: RecordedConfig, data: Path | None) -> Stage:
    found = load_recorded(find_data(source.data, scenario, data), scale=source.scale)
    views = found.training
    candidates = from_poses([v.camera_to_world for v in views], views[0].intrinsics)
    transparent = any(view.image.shape[2] == 4 for view in views)
    options: dict[str, Any] = {"background": "white"} if transparent else {}
    return Stage(scenario.name, candidates, found.held_out, options, WHITE if transparent else BLACK, recorded=views)


def _render(scene: Scene, name: str, candidates: Candidates, k: int) -> View:
    pose = candidates.poses[k]
    return View(name, scene.view(candidates.lens, pose).image(0.0), pose, candidates.lens)


def open_embedder(background: Color) -> tuple[Embed | None, str | None]:
    """Returns (function from images to embeddings by the shipped YOLO backbone (4.8), None), or (None, reason
    why it is not available).

    background: color behind transparent images.
    """
    try:
        embedder = make_embedder(EmbeddingConfig(dim=STAGE_EMBEDDING_DIM))
    except EmbeddingError as error:
        return None, str(error)

    def embed(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        over = [to_unit(p, background=background).astype(np.float32) for p in pictures]
        return embedder.embed([to_bytes(picture) for picture in over])

    return embed, None
