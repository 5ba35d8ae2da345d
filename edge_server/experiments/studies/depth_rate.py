"""What measured depth costs and gains: how often frames bring it, on lines of some widths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from camera_node.capture import Camera
from edge_server.experiments.common.drawn_images import draw_images
from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import Row, SeedTable
from edge_server.experiments.common.tables import mean_or_none
from edge_server.experiments.studies.drawing import curves
from edge_server.experiments.studies.study import Study, StudyRequest, open_engine
from edge_server.experiments.studies.study_constants import DEPTH_SCORED_FROM, DEPTH_SECONDS
from edge_server.experiments.studies.trial import scenario_of, scene_label, scenes_here
from edge_server.experiments.studies.verdicts import Claim, better
from edge_server.experiments.virtual.from_scenario import build_deployment, training_cameras
from edge_server.experiments.virtual.simulate_command import usual_settings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.images import to_bytes
from edge_server.fidelity.scorer import SHOWN
from edge_server.settings import read_config
from freshfield.frame import Frame, to_request
from freshfield.scenario import Scenario

NONE, SOME, EACH = 0, 5, 1  # every n-th frame brings depth
PICTURED = ("duo", "quad")
WIDTHS_MBIT = (0.0, 8.0, 2.0)  # of each camera's line; 0: unbounded
_OF_FRAMES = {NONE: "no frame", SOME: "each fifth frame", EACH: "each frame"}
METRICS = ("shown_psnr_db", "shown_psnr_moving_db", "aaoi_ms", "kilobytes_per_s")


@dataclass(frozen=True)
class DepthRun:
    """A deployment in virtual time. every: each so many-th frame brings depth, 0: none. megabits_per_s: rate of each
    camera's line, 0: unbounded."""

    scene: str
    seed: int
    every: int
    megabits_per_s: float
    seconds: float

    def scenario(self) -> Scenario:
        """The scene's scenario with this rate of depth and this line. Raises ScenarioError."""
        found = scenario_of(self.scene, self.seed)
        channel = dict(found.channel)
        if self.megabits_per_s:
            channel["faults"] = {**channel.get("faults", {}), "bandwidth": {"megabits_per_s": self.megabits_per_s}}
        return replace(found, source={**found.source, "depth_every": self.every}, channel=channel)


def _cases(request: StudyRequest) -> list[DepthRun]:
    return [
        DepthRun(scene, seed, every, width, DEPTH_SECONDS[request.quick])
        for scene in scenes_here(request, ("quad",))
        for seed in request.repeats(2, 6)
        for width in (WIDTHS_MBIT[::2] if request.quick else WIDTHS_MBIT)
        for every in (NONE, SOME, EACH)
    ]


def _measure(runs: Sequence[DepthRun], request: StudyRequest) -> list[Row]:
    with open_engine(request, "depth") as engine:
        results = engine.run(
            partial(run_with_depth, folders=request.folders),
            runs,
            "runs",
            files=lambda run: [run.scenario().path, *request.folders.files_of(run.scenario())],
        )
    return [
        {
            "scene": run.scene,
            "line": f"{run.megabits_per_s:g} Mbit/s a camera" if run.megabits_per_s else "unbounded",
            "depth_every": run.every,
            "depth_hz": found["fps"] / run.every if run.every else 0.0,
            "seed": run.seed,
            **found,
        }
        for run, found in zip(runs, results)
    ]


def run_with_depth(run: DepthRun, folders: Folders) -> Row:
    """Run it; figures are means over its last third.

    shown_psnr_db, shown_psnr_moving_db: of what is shown at random instants. aaoi_ms: mean age of used views.
    kilobytes_per_s: what all cameras send. fps: of each. Raises ScenarioError or DatasetError.
    """
    deployment, cameras = _deployed(run, folders)
    since_s = DEPTH_SCORED_FROM * run.seconds
    shown = [score for score in deployment.shown if score.published_ns >= 1e9 * since_s]
    ages = [p.aaoi_ms for p in deployment.publications if p.t_s >= since_s]
    fps = float(cameras[0].fps)
    return {
        **{f"shown_{name}": mean_or_none([getattr(s, name) for s in shown]) for name in SHOWN[:2]},
        "aaoi_ms": mean_or_none(ages),
        "kilobytes_per_s": 1e-3 * fps * sum(_message_bytes(camera) for camera in cameras),
        "fps": fps,
    }


def _deployed(run: DepthRun, folders: Folders) -> tuple[VirtualDeployment, list[Camera]]:
    """The deployment at the end of the run, and its training cameras."""
    scenario = run.scenario()
    cameras = training_cameras(scenario, folders.data)
    deployment = build_deployment(scenario, usual_settings(read_config(scenario)), cameras=cameras, data=folders.data)
    deployment.run(run.seconds)
    return deployment, cameras


def _draw_images(request: StudyRequest, table: SeedTable) -> None:
    """Draw the last instant of each scene to OUT/depth-pictures.png: the truth, and what is shown without depth and
    with that of each fifth frame, on unbounded lines."""
    rows: list[tuple[str, list[tuple[str, Any]]]] = []
    for scene in scenes_here(request, PICTURED):
        shown = []
        for every in (NONE, SOME):
            run = DepthRun(scene, 0, every, 0.0, DEPTH_SECONDS[request.quick])
            deployment, _ = _deployed(run, request.folders)
            present_ns, truth = deployment.clock.now_ns(), deployment.truth
            assert truth is not None  # studies take scenes of which some camera is held out
            image, lens, pose = truth.view(run.scenario().held_out[0], truth.nearest_ns(present_ns))
            color = deployment.updates.field.snapshot(present_ns).render(pose, lens).color
            shown.append((f"depth of {_OF_FRAMES[every]}", to_bytes(color)))
        rows.append((scene_label(scene), [("truth", image), *shown]))
    draw_images(request.figure("depth-pictures.png"), rows)


def _message_bytes(camera: Camera) -> float:
    """Mean size of a camera's messages over as many frames as depth takes turns in."""
    sizes = []
    for tick in range(SOME):
        shot = camera.capture(tick)
        frame = Frame(
            camera.name, "s", tick, 0, shot.pose, shot.intrinsics, camera.codec, shot.payload, depth=shot.encoded_depth
        )
        sizes.append(to_request(frame).ByteSize())
    return sum(sizes) / len(sizes)


DEPTH = Study(
    "depth",
    "What measured depth costs in bytes and age, and gains in fidelity, by its rate and the line's width",
    _cases,
    _measure,
    METRICS[:2],
    (
        Claim(
            "depth of each fifth frame is better than none.",
            better({"depth_every": SOME}, {"depth_every": NONE}),
            bound=None,
        ),
        Claim(
            "depth of each frame is better than that of each fifth.",
            better({"depth_every": EACH}, {"depth_every": SOME}),
            bound=None,
        ),
    ),
    ("scene", "line"),
    (curves("depth", "depth_hz", "frames with depth a second", METRICS, "line"), _draw_images),
)
