"""Frames that are held out of the path of a carried camera: of the recording and of the world, for ever."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_node.capture import Camera, build_cameras
from camera_node.settings import source_config
from camera_node.synthetic import make_scene
from camera_node.synthetic.walk import walks_through
from edge_server.experiments.virtual.from_scenario import build_truth
from edge_server.experiments.virtual.truth import CapturedTruth
from edge_server.fidelity.scorer import Scorer
from edge_server.settings import read_config
from freshfield.scenario import Scenario, ScenarioError, parse
from tests.camera_node.sources.datasets.photos import edited, write_photos

WORLD = {"kind": "world", "width": 16, "height": 12, "fps": 10, "carried": ["hand"], "params": {"people": 0}}


def scenario(source: dict[str, Any], every: int = 8, ids: tuple[str, ...] = ("hand", "kept")) -> Scenario:
    cameras = {"ids": list(ids), "held_out": list(ids[len(ids) // 2 :]), "held_out_every": every}
    return parse({"seed": 5, "cameras": cameras, "source": source}, Path("carried.yaml"))


def opened(found: Scenario, only: str = "") -> dict[str, Camera]:
    return {c.name: c for c in build_cameras(found, source_config(found), [only] if only else found.cameras)}


def path_of_one(folder: Path, count: int) -> Path:
    """A recording of one moving camera at 10 frames a second."""
    file = write_photos(folder, count)
    return edited(file, lambda data: [frame.update(time=3.0 + k / 10) for k, frame in enumerate(data["frames"])])


@pytest.mark.parametrize("loop", ["back-and-forth", "restart"])
@pytest.mark.parametrize(("fps", "count"), [(None, 33), (5, 60)])
def test_no_frame_of_a_recording_is_both_held_out_and_trained_on_in_any_round(tmp_path, loop, fps, count):
    data = path_of_one(tmp_path, count)
    source = {"kind": "transforms", "data": str(data), "loop": loop, "codec": "png"}
    hand, kept = opened(scenario({**source, "fps": fps} if fps else source)).values()
    rate = fps or 10
    assert float(hand.fps) == rate and float(kept.fps) == rate / 8
    trained = {hand.source.content(tick) for tick in range(500)}
    held_out = {kept.source.content(tick) for tick in range(100)}
    assert held_out and trained.isdisjoint(held_out)
    assert [kept.source.content(tick) for tick in range(2)] == [0, 8 * 10 // rate]
    instants = [hand.rate_schedule.due_ns(k) for k in range(14)] + [kept.rate_schedule.due_ns(k) for k in range(2)]
    assert sorted(instants) == [k * 10**9 // rate for k in range(16)]
    assert kept.capture(1).pose != kept.capture(0).pose


def test_a_held_out_frame_of_the_world_has_the_errors_of_the_camera_that_is_carried(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def whole(effects):
        source = {**WORLD, "effects": effects}
        return opened(parse({"seed": 5, "cameras": {"ids": ["hand"]}, "source": source}, Path("w")))["hand"]

    effects = {"pose_noise": {"correlation_s": 0.5}, "exposure_drift": {}, "pose_delay": {"delay_ms": 40}}
    found, alone = scenario({**WORLD, "effects": effects}), whole(effects)
    cameras = opened(found)
    assert cameras["kept"].capture(2) == alone.capture(16)
    assert cameras["kept"].capture(2) == opened(found, "kept")["kept"].capture(2), "also in a process of its own"
    assert [cameras["hand"].capture(k) for k in (0, 7)] == [alone.capture(k) for k in (1, 9)]
    truth = build_truth(found, source_config(found), read_config(found), Scorer())
    assert isinstance(truth, CapturedTruth), "scored on captures, since only those are neighbors of trained ones"
    walk = walks_through(make_scene("room"), ["hand"])["hand"]
    for listed, t_s in (({}, 0.4), ({"pose_delay": {"delay_ms": 40}}, 0.36)):
        assert whole(listed).capture(4).pose.matrix() == pytest.approx(walk.pose(t_s), abs=1e-9)


def test_a_walk_repeats_after_a_lap_and_neither_jumps_nor_leaves_the_room():
    for scene in (make_scene("room"), *(make_scene("drawn_room", {"layout_seed": seed}) for seed in range(3))):
        first, second = walks_through(scene, ["a", "b"]).values()
        poses = np.array([first.pose(k / 100) for k in range(1920)])
        assert poses[0] == pytest.approx(first.pose(first.lap_s), abs=1e-9)
        assert second.pose(0.0) == pytest.approx(first.pose(first.lap_s / 2), abs=1e-9)
        step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        turned = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
        assert step_m.min() > 0.001 and step_m.max() < 0.012, "walking pace"
        assert np.rad2deg(np.arccos(np.clip((turned.min() - 1) / 2, -1, 1))) < 0.8, "degrees in 10 ms"
        low, high = scene.bounds
        assert (poses[:, :3, 3] > low + 1.0).all() and (poses[:, :3, 3] < high - 0.4).all()


@pytest.mark.parametrize(
    ("source", "every", "ids", "message"),
    [
        (WORLD, 1, ("hand", "kept"), r"cameras.held_out_every: expected 2 or more, .* got 1, 1 of 2 held out"),
        (WORLD, 8, ("hand", "other", "kept"), r"as many held-out cameras as training cameras"),
        (WORLD, 7, ("hand", "kept"), r"hand's path repeats after 192 captures, expected a multiple of 7"),
        ({**WORLD, "carried": ["foot"]}, 8, ("hand", "kept"), r"source.carried: expected cameras .* got foot"),
        ({**WORLD, "scene": "tower", "params": {}}, 8, ("hand", "kept"), r"scene tower is no room to walk in"),
        ({"kind": "camera"}, 8, ("hand", "kept"), r"needs a recorded data set or a synthetic world"),
        ({"kind": "transforms", "data": "{}"}, 8, ("hand", "kept"), r"of every 8 captures one is held out: 5 are too"),
    ],
)
def test_what_cannot_be_divided_is_said_in_one_line(tmp_path, source, every, ids, message):
    if source.get("data"):
        source = {**source, "data": str(path_of_one(tmp_path, 5))}
    with pytest.raises((ScenarioError, ValueError), match=message) as error:
        opened(scenario(source, every, ids))
    assert "\n" not in str(error.value)
