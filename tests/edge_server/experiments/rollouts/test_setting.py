"""What an evaluation is: who rewards and who reports, which motion, from which field, with whose luck."""

from __future__ import annotations

import dataclasses

import numpy as np

from camera_node.synthetic import make_scene
from edge_server.experiments.rollouts.episode import Choice, EpisodeFactory, Outcome
from edge_server.experiments.rollouts.setting import Setting
from tests.edge_server.experiments.rollouts.small import NOTHING, reported, scenario, setting
from tests.edge_server.experiments.sets import write_recording


def one_of(what: Setting, seed: int = 5, camera: str = "cam00") -> Outcome:
    """What using everything comes to at the first decision of an episode."""
    episode = EpisodeFactory(what, NOTHING).episode(seed)
    point = episode.points[0]
    return episode.evaluate(0, Choice(tuple(point.newest(point.now_ns)), point.now_ns), (camera,))[camera]


def test_the_camera_that_reports_neither_rewards_nor_is_trained_on():
    what = reported()
    assert what.rewarding == ("cam00",) and what.judging == ("cam04",)
    point = EpisodeFactory(what, NOTHING).episode(5).points[0]
    assert point.cameras == ("cam01", "cam02", "cam03")
    rewarded, judged = one_of(what), one_of(what, camera="cam04")
    turned = dataclasses.replace(what, report=("cam00",))
    assert one_of(turned, camera="cam04") == judged and one_of(turned) == rewarded
    assert rewarded.psnr_db != judged.psnr_db and rewarded.aaoi_ms == judged.aaoi_ms


def test_every_episode_has_a_motion_of_its_own_and_its_cameras_see_the_same_one():
    factory = EpisodeFactory(setting(motions=True), NOTHING)
    images = set()
    for seed in (1, 2_000_001):  # of training and of testing
        stage = factory.stage(seed)
        params = {"count": 5, "width": 24, "height": 24, "supersample": 1, "speed_m_per_s": 2.0}
        scene = make_scene("room", {**params, "motion_seed": seed})
        images.add((image := stage.truth.view("cam00", 10**9)[0]).tobytes())
        assert np.array_equal(image, scene.render("cam00", 1.0))
        assert np.array_equal(stage.cameras[0].source.scene.render("cam01", 1.0), scene.render("cam01", 1.0))
    assert len(images) == 2
    same = EpisodeFactory(setting(motions=False), NOTHING)
    assert same.stage(1) is same.stage(2_000_001)


def test_a_recording_has_no_motion_to_draw(tmp_path):
    recorded = scenario(source={"kind": "transforms", "data": str(write_recording(tmp_path))})
    factory = EpisodeFactory(dataclasses.replace(setting(motions=True), scenario=recorded), NOTHING)
    assert "motion_seed" not in factory.scenario(3).source


def test_pictures_of_one_episode_are_not_taken_for_those_of_another():
    """Frames of two episodes have the same numbers."""
    what = setting(motions=True, parts=("semantics", "age"), decisions=1)
    factory = EpisodeFactory(what, NOTHING)
    after_others = [factory.episode(seed).points[0].state.embeddings for seed in (1, 2)][1]
    alone = EpisodeFactory(what, NOTHING).episode(2).points[0].state.embeddings
    assert after_others.any() and np.array_equal(after_others, alone)


def test_the_scenarios_seed_and_the_repeat_decide_the_fields_luck_and_so_does_the_episode():
    a = setting()
    other = dataclasses.replace(a.scenario, seed=a.scenario.seed + 99)
    b, again = dataclasses.replace(a, scenario=other), dataclasses.replace(a, repeat=1)
    assert len({what.key for what in (a, b, again)}) == 3
    assert len({what.field_seed(seed) for what in (a, b, again) for seed in range(20)}) == 60
    found = [one_of(what).psnr_db for what in (a, b, again)]
    assert len(set(found)) == 3 and one_of(a).psnr_db == found[0]
