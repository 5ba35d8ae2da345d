"""Sources as the node uses them: ticks, frames held out of a carried camera's path, effects on the wire."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_node.capture import Camera, build_cameras
from camera_node.settings import source_config
from camera_node.sources.datasets.records import Dataset, DatasetError, PosedImage
from camera_node.sources.datasets.streamer import Timeline
from camera_node.synthetic import make_scene
from camera_node.synthetic.effects import NAMES
from camera_node.synthetic.walk import walks_through
from edge_server.experiments.virtual.from_scenario import build_truth
from edge_server.experiments.virtual.truth import CapturedTruth
from edge_server.fidelity.scorer import Scorer
from edge_server.settings import read_config
from freshfield import payload
from freshfield.geometry import Pinhole, Pose
from freshfield.scenario import Scenario, ScenarioError, parse
from tests.camera_node.sources.datasets.photos import edited, opened, photo_scenario, picture, pose_of, write_photos
from tests.support import refused, small_world


def test_a_recording_is_assigned_by_name(tmp_path):
    data = write_photos(tmp_path, 6, cameras=3)
    source = opened(photo_scenario(data, 3, fps=20), ["cam02"])["cam02"]
    # Recorded at 10 a second, captured at 20: every frame is seen twice.
    assert [source.content(k) for k in range(0, 8)] == [0, 1, 1, 2, 2, 3, 3, 4]
    np.testing.assert_array_equal(source.read(1).image, picture(13)[..., ::-1])
    other = opened(photo_scenario(data, 3, assignment={"cam00": "cam02", "cam02": "cam00"}), ["cam00"])
    np.testing.assert_array_equal(other["cam00"].read(1).image, picture(13)[..., ::-1])
    for count, assignment, message in (
        (4, {}, r"no camera 'cam03'.*cam00, cam01, cam02"),
        (3, {"cam01": "cam00"}, "more than one camera shows cam00"),
    ):
        refused(ScenarioError, message, opened, photo_scenario(data, count, assignment=assignment))
    photos = photo_scenario(write_photos(tmp_path / "photos", 9), assignment={"cam01": "left"})
    refused(ScenarioError, "the data has no camera 'left' .it has none that has a name", opened, photos)


@pytest.mark.parametrize(("fps", "time_unit_s"), [(0, 1.0), (1e9, 1.0), (None, 1e308), (None, 1e-320)])
def test_an_impossible_rate_of_a_recording_is_named(fps, time_unit_s, tmp_path):
    data = edited(
        write_photos(tmp_path, 3, cameras=2),
        lambda d: [frame.update(time=frame["time"] * time_unit_s) for frame in d["frames"]],
        fps=fps,
    )
    refused(DatasetError, r"transforms\.json: recorded .* expected 0\.01 to 1000", opened, photo_scenario(data, 2))


def test_a_jpeg_of_the_right_size_is_sent_as_it_lies_unless_it_is_cut(tmp_path):
    data = write_photos(tmp_path, 8, suffix=".jpg")
    source = opened(photo_scenario(data, 2, codec="jpeg"), ["cam01"])["cam01"]
    assert source.read(4).image == (tmp_path / "images/005.jpg").read_bytes()
    shrunk = opened(photo_scenario(data, 2, codec="jpeg", scale=2), ["cam01"])["cam01"]
    assert not isinstance(shrunk.read(4).image, bytes) and shrunk.intrinsics.width == 16
    whole = (tmp_path / "images/006.jpg").read_bytes()
    (tmp_path / "images/006.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    refused(DatasetError, r"006\.jpg: damaged or cut short", source.read, 5)


def test_a_timeline_holds_what_all_cameras_have_at_the_fastest_ones_rate():
    times = {"fast": [0.2, 0.3, 0.4, 0.6, 0.7, 0.8], "slow": [0.0, 0.2, 0.4, 0.6], "once": [5.0], "unused": [8.0, 9.0]}
    rows, lens = [(camera, t_s) for camera in times for t_s in times[camera]], Pinhole(8, 8, 8, 8, 4, 4)
    images = (PosedImage(f"{camera}{t_s}", camera, t_s, np.eye(4), lens, lambda: None) for camera, t_s in rows)
    found = Timeline.of(Dataset(tuple(images)), ["fast", "slow", "once", "unknown"], Path("set"))
    assert found == Timeline(0.2, 5, Fraction(10))


WORLD = {"kind": "world", "width": 16, "height": 12, "fps": 10, "carried": ["hand"], "params": {"people": 0}}


def scenario(source: dict[str, Any], every: int = 8, ids: tuple[str, ...] = ("hand", "kept")) -> Scenario:
    cameras = {"ids": list(ids), "held_out": list(ids[len(ids) // 2 :]), "held_out_every": every}
    return parse({"seed": 5, "cameras": cameras, "source": source}, Path("carried.yaml"))


def cameras_of(found: Scenario, only: str = "") -> dict[str, Camera]:
    return {c.name: c for c in build_cameras(found, source_config(found), [only] if only else found.cameras)}


@pytest.mark.parametrize(("fps", "count", "lost"), [(None, 33, 99), (5, 60, 99), (20, 33, 99), (None, 33, 16)])
def test_no_frame_of_a_recording_is_both_held_out_and_trained_on_in_any_round(tmp_path, fps, count, lost):
    at_10 = [3.0 + (k + (k >= lost)) / 10 for k in range(count)]
    data = edited(write_photos(tmp_path, count), lambda d: [f.update(time=t) for f, t in zip(d["frames"], at_10)])
    source = {"kind": "transforms", "data": str(data), "codec": "png"}
    hand, kept = cameras_of(scenario({**source, "fps": fps} if fps else source)).values()
    rate = fps or 10
    assert float(hand.fps) == rate and float(kept.fps) == rate / 8
    trained = {hand.source.content(tick) for tick in range(500)}
    held_out = {kept.source.content(tick) for tick in range(100)}
    assert held_out and trained.isdisjoint(held_out)
    assert [kept.source.content(tick) for tick in range(2)] == [0, 8 * 10 // rate]
    counted = ((hand.source.rate_schedule(), 14), (kept.source.rate_schedule(), 2))
    instants = [schedule.due_ns(k) for schedule, count in counted for k in range(count)]
    assert sorted(instants) == [k * 10**9 // rate for k in range(16)]
    assert kept.capture(1).pose != kept.capture(0).pose


def test_a_held_out_frame_of_the_world_has_the_errors_of_the_camera_that_is_carried():
    def whole(effects):
        source = {**WORLD, "effects": effects}
        return cameras_of(parse({"seed": 5, "cameras": {"ids": ["hand"]}, "source": source}, Path("w")))["hand"]

    effects = {"pose_noise": {"correlation_s": 0.5}, "exposure_drift": {}, "pose_delay": {"delay_ms": 40}}
    found, alone = scenario({**WORLD, "effects": effects}), whole(effects)
    cameras = cameras_of(found)
    assert cameras["kept"].capture(2) == alone.capture(16)
    assert cameras["kept"].capture(2) == cameras_of(found, "kept")["kept"].capture(2), "also in a process of its own"
    assert [cameras["hand"].capture(k) for k in (0, 7)] == [alone.capture(k) for k in (1, 9)]
    truth = build_truth(found, source_config(found), read_config(found), Scorer())
    assert isinstance(truth, CapturedTruth), "scored on captures, since only those are neighbors of trained ones"
    walk = walks_through(make_scene("room"), ["hand"])["hand"]
    for listed, t_s in (({}, 0.4), ({"pose_delay": {"delay_ms": 40}}, 0.36)):
        assert whole(listed).capture(4).pose.matrix() == pytest.approx(walk.pose(t_s), abs=1e-9)
    refused(ScenarioError, "source.effects: hand is carried, and a bump", whole, {"bump": {}})
    share = scenario({**WORLD, "effects": {"pose_noise": {"cameras": ["kept"]}}})
    refused(ScenarioError, "kept shows captures of hand: name that one", cameras_of, share)


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
        ({"kind": "camera"}, 8, ("hand", "kept"), r"needs a recorded data set or a synthetic world"),
    ],
)
def test_what_cannot_be_divided_is_said_in_one_line(source, every, ids, message):
    refused(ScenarioError, message, lambda: cameras_of(scenario(source, every, ids)))


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def cameras(effects: dict[str, Any], count: int = 3, **more: Any) -> dict[str, Camera]:
    source = small_world(scene="tower", width=24, height=16, fps=10, codec="zstd", effects=effects, **more)
    top = {"seed": 5, "cameras": {"count": count, "held_out": ["cam00"]}, "source": source}
    scenario = parse(top, Path("world.yaml"))
    return {c.name: c for c in build_cameras(scenario, source_config(scenario), scenario.cameras)}


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"clock_drift", "depth_sensor", "pose_delay"}))
def test_an_effect_reaches_the_frames_but_not_the_truth(name):
    """Deterministic by the seed, whoever else is there, in any order; in_truth reaches the held-out camera, too."""
    plain, affected, truth = cameras({}), cameras({name: {}}), cameras({name: {"in_truth": True}})
    fewer, ticks = cameras({name: {}}, count=2), (0, 7, 123_456)

    def frames(camera: Camera, ticks: tuple[int, ...] = ticks) -> list[tuple[bytes, Pose]]:
        shots = [camera.capture(tick) for tick in ticks]
        return [(s.payload, s.pose) for s in shots]

    assert frames(affected["cam00"]) == frames(plain["cam00"])
    assert frames(affected["cam01"]) != frames(plain["cam01"])
    assert frames(truth["cam00"]) != frames(plain["cam00"])
    assert frames(truth["cam01"]) == frames(affected["cam01"]) == frames(fewer["cam01"], ticks[::-1])[::-1]


def test_a_depth_sensor_measures_with_every_camera_but_the_held_out_one_and_changes_no_image():
    plain, found, fewer = cameras({}), cameras({"depth_sensor": {}}), cameras({"depth_sensor": {}}, count=2)

    def depth(camera: Camera) -> np.ndarray | None:
        measured = camera.source.depth(3, camera.source.read(3))
        return None if measured is None else measured.counts

    assert depth(plain["cam01"]) is None and depth(found["cam00"]) is None
    first = depth(found["cam01"])
    assert first is not None and first.shape == (16, 24) and first.any()
    assert np.array_equal(first, depth(fewer["cam01"])) and not np.array_equal(first, depth(found["cam02"]))
    found["cam01"].source.release()
    assert np.array_equal(first, depth(found["cam01"]))
    assert found["cam01"].capture(3) == plain["cam01"].capture(3)
    assert found["cam01"].source.key() == plain["cam01"].source.key(), "rendered frames are found again"


def test_a_bumped_camera_shows_another_view_from_then_on_and_reports_its_old_pose(tmp_path):
    bump = {"at_s": 1.0, "pitch_deg": 1.0, "cameras": ["cam01"]}
    refused(ScenarioError, "effects.bump.cameras: 'cam1' is not one", cameras, {"bump": {**bump, "cameras": ["cam1"]}})
    found, plain = cameras({"bump": bump, "depth_sensor": {}}), cameras({"depth_sensor": {}})

    def made(camera: Camera, tick: int) -> tuple[Any, ...]:
        shot = camera.source.read(tick)
        return shot.image, camera.source.depth(tick, shot).counts.tobytes(), shot.pose

    turned, stood = made(found["cam01"], 10), made(plain["cam01"], 10)
    assert turned[0] != stood[0] and turned[1] != stood[1] and turned[2] == stood[2]
    assert made(found["cam02"], 10) == made(plain["cam02"], 10)
    again = plain["cam01"].source.contents
    assert made(found["cam01"], again + 9)[0] != made(plain["cam01"], 9)[0], "it stays turned"
    assert made(found["cam01"], 9) == made(plain["cam01"], 9), "in any order"
    # One that watches an arm stands still where its calibration says, too: here in the other one's place.
    at = plain["cam02"].source.read(0).pose.matrix().tolist()
    (tmp_path / "eye.yaml").write_text(f"{{setup: eye-to-hand, transform: {at}}}")
    watches = cameras({"bump": bump}, arm={"host": "127.0.0.9", "cameras": {"cam01": str(tmp_path / "eye.yaml")}})
    same = [watches["cam01"].capture(k).payload == watches["cam02"].capture(k).payload for k in (9, 10)]
    assert same == [True, False], "bumped at the tenth frame"


def test_a_wrong_pose_is_claimed_of_the_right_image():
    found = cameras({"pose_noise": {"translation_mm": 20.0, "rotation_deg": 1.0}})["cam01"]
    plain = cameras({})["cam01"]
    again = plain.source.contents
    assert found.source.contents is None and again is not None
    shots = [found.capture(k) for k in (3, 3 + again)]
    assert shots[0].payload == shots[1].payload == plain.capture(3).payload
    assert len({shots[0].pose, shots[1].pose, plain.capture(3).pose}) == 3
    bias = {"translation_mm": 0.0, "rotation_deg": 0.0, "translation_bias_mm": 20.0}
    wrong = cameras({"pose_noise": bias})["cam01"]
    assert wrong.source.contents == again, "a wrong calibration costs nothing more"
    assert wrong.capture(1).pose == wrong.capture(99).pose != plain.capture(1).pose


def test_recordings_stand_where_they_stood_and_are_sent_as_they_lie_with_a_wrong_pose(tmp_path):
    data = write_photos(tmp_path, 24)
    world = "kinds delay and mount need source kind world"
    for name, why in (("bump", world), ("pose_delay", world), ("depth_sensor", "cam01 has no depth, which")):
        scenario = photo_scenario(data, 3, effects={name: None})
        refused(ScenarioError, why, build_cameras, scenario, source_config(scenario), scenario.cameras)
    scenario = photo_scenario(data, cameras=3, fps=5, effects={"pose_noise": {}})
    truth, wrong = build_cameras(scenario, source_config(scenario), ["cam00", "cam01"])
    assert (wrong.source.repeats_after, wrong.source.timed) == (20, False), "as of the eleven photos without errors"
    shot = wrong.capture(1)
    np.testing.assert_array_equal(payload.decode(shot.payload, "png", 32, 24), picture(3)[..., ::-1])
    assert not np.allclose(shot.pose.matrix(), pose_of(3), atol=1e-6)
    assert np.allclose(shot.pose.matrix(), pose_of(3), atol=0.3)
    np.testing.assert_allclose(truth.capture(1).pose.matrix(), pose_of(8), atol=1e-9)
