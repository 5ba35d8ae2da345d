"""The page as browsers receive it: it survives every failure, and bounds what it sends and costs."""

import asyncio
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from edge_server.fidelity.scorer import Score
from edge_server.fields import Rendering
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.live.state import CameraView, Comparison, EdgeState
from edge_server.page import PageError, display_modes, panel, start_page
from edge_server.page.controls import ControlPanel
from edge_server.page.rendering import LEVELS, MOVING, NEWER, ClientState, RenderLoop, browser_image, hatched
from edge_server.page.scene import Scene, thumbnail
from freshfield import coverage
from freshfield.geometry import Pinhole, Pose, look_at
from tests.edge_server.frames import frame
from tests.edge_server.page.preview import LENS, BallScene, bare_state, publication
from tests.edge_server.page.visitor import Visitor, page_of
from tests.support import wait_until


class Broken:
    """A field that has diverged: it renders nothing but not a number, or nothing at all."""

    def __init__(self, raises: bool = False) -> None:
        self._raises, self.renders = raises, 0

    def at(self, present_ns):
        return self

    def render(self, camera_to_world, intrinsics: Pinhole) -> Rendering:
        self.renders += 1
        if self._raises:
            raise FloatingPointError("no such density")
        depth = np.full((intrinsics.height, intrinsics.width), np.nan, np.float32)
        return Rendering(np.stack([depth] * 3, axis=-1), depth, depth)


def test_what_is_not_finite_shows_the_backdrop_and_the_rest_its_color():
    color = np.full((4, 3, 3), 0.5, np.float32)
    color[1, 1, 0], color[2, 2, 2] = np.nan, np.inf
    image = browser_image(color)
    assert image.dtype == np.uint8 and (image[0] == 128).all()
    assert image[1, 1].tolist() == image[2, 2].tolist() == [18, 20, 24]


def test_what_no_camera_has_seen_is_hatched():
    image, unseen = np.ones((48, 64, 3), np.float32), np.arange(16)[None].repeat(12, 0) >= 8
    shaded = hatched(image, unseen) < 1.0
    assert not shaded[:, :32].any() and 0.4 < shaded[:, 32:].mean() < 0.6


@pytest.mark.parametrize(("took_s", "bands"), [(0.05, 1), (0.4, 4), (1.2, 12)])
def test_an_image_at_rest_has_a_band_for_every_tenth_of_a_second_that_the_last_one_took(took_s, bands):
    """Each band projects the whole field again: an image that is quick is rendered whole."""
    loop, broken, visitor = RenderLoop(bare_state()), Broken(), ClientState(None)
    loop._adapt(len(LEVELS) - 1, took_s)
    for level, renders in ((len(LEVELS) - 1, bands), (MOVING, bands + 1)):
        image = loop._render(broken, np.eye(4), Pinhole.from_fov(40, 300, 60), visitor, visitor.serial, level)
        assert image.color.shape == (300, 40, 3) and broken.renders == renders


def test_one_camera_is_seen_from_before_it_then_from_the_fields_box_and_looked_through_as_the_field_corrects_it():
    seen = frame()
    state = bare_state([CameraView("cam01", False, seen, 1.0, 1, 0), CameraView("never", False, None, None, 0, 0)])
    server, client = MagicMock(), MagicMock()
    server.get_clients.return_value = {0: client}
    scene = Scene(server, state)
    assert thumbnail(replace(seen, payload=b"\xff\xd8 nothing")) is None
    scene.refresh(state.cameras(), watched=True)  # the other camera may report: nobody is moved yet
    client.atomic.assert_not_called()
    began, scene._first_seen = scene._first_seen, -1e3  # cameras may report one by one for any time
    scene._seen_at, scene._seen = -1.0, 1  # long enough ago: the other camera may never report
    scene.refresh(state.cameras(), watched=True)
    np.testing.assert_array_equal(client.camera.position, scene._viewpoint.position)
    scene._first_seen = began
    server.scene.add_camera_frustum.assert_called_once()
    np.testing.assert_array_equal(server.scene.add_camera_frustum.return_value.image, thumbnail(seen))
    ahead = scene._viewpoint.look_at - seen.pose.translation_m
    assert np.allclose(ahead, np.linalg.norm(ahead) * seen.pose.matrix()[:3, 2])
    refined = seen.pose.matrix()
    scene._look_through(client, "cam01")
    np.testing.assert_array_equal(client.camera.position, seen.pose.translation_m)
    assert client.camera.fov == pytest.approx(2 * np.arctan(0.5 * seen.intrinsics.height / seen.intrinsics.fy))
    refined[:3, 3] += 0.02
    field = SimpleNamespace(
        box=replace(UNIT_BOX, center_m=(0.5, 0.0, 0.25)), correction=lambda _: SimpleNamespace(camera_to_world=refined)
    )
    state.publish(publication(0), field)
    scene.refresh(state.cameras(), watched=True)
    assert server.initial_camera.look_at.tolist() == [0.5, 0.0, 0.25]
    scene._look_through(client, "cam01")
    np.testing.assert_array_equal(client.camera.position, refined[:3, 3])


def test_a_camera_that_moves_is_shown_where_it_is_and_one_that_stands_is_not_sent_again():
    server = MagicMock()
    scene, add = Scene(server, bare_state()), server.scene.add_camera_frustum
    scene._viewpoint, shown = SimpleNamespace(radius_m=2.0), add.return_value
    for x_m in (0.0, 0.0, 0.5):
        pose = Pose.from_matrix(look_at((x_m, -3.0, 1.0), (0.0, 0.0, 0.0)))
        newest = replace(frame(camera="cam00"), pose=pose, intrinsics=LENS)
        shown.position = shown.wxyz = None
        scene._frustum(CameraView("cam00", False, newest, 1.0, 1, 0), newest)
        assert (shown.position, shown.wxyz) == ((pose.translation_m, pose.quaternion) if x_m else (None, None))
    assert add.call_count == 1 and add.call_args.kwargs["position"] != pose.translation_m


def test_the_tiles_say_the_latest_score_and_the_ages_of_training_cameras():
    state = bare_state()
    state.publish(replace(publication(4), update_ms=20.0, psnr_db=21.0, scored_on="cam00"), Broken())
    state.publish(replace(publication(5), update_ms=30.0), Broken())
    ages = (("cam00", True, 900.0), ("cam01", False, 100.0), ("cam02", False, 300.0), ("cam03", False, None))
    cameras = [CameraView(name, held_out, None, age_ms, 0, 0) for name, held_out, age_ms in ages]
    found = panel.summary(state, cameras, state.publications())
    assert (found.updates, found.update_ms, found.psnr_db, found.scored_on) == (6, 30.0, 21.0, "cam00")
    assert (found.mean_age_ms, found.worst_age_ms, found.reporting, found.cameras) == (200.0, 300.0, 3, 4)
    assert found.condition == "live"
    state.controls.paused = True
    assert panel.summary(state, [], []).condition == "paused"


def test_what_cameras_see_is_reckoned_when_they_stand_still():
    server = MagicMock()
    server.gui.add_html.side_effect = lambda content, **_: SimpleNamespace(content=content, visible=True, order=0.0)
    shown = panel.Panel(server, bare_state())

    def coverage_of(*places_m, depth=()):
        poses = [Pose.from_matrix(look_at((x, -3.0, 1.0), (0.0, 0.0, 0.0))) for x in places_m]
        newest = [replace(frame(camera=f"cam0{k}"), pose=pose, intrinsics=LENS) for k, pose in enumerate(poses)]
        shown._refresh_coverage([CameraView(f.camera, False, f, 1.0, 1, 0, f.camera in depth) for f in newest])
        return shown._coverage.content

    assert "every camera has sent" in coverage_of(-1.0, 1.0)
    assert coverage.reached(2, depth=False) in (first := coverage_of(-1.0, 1.0))
    assert coverage_of(-1.0, 1.01) == coverage_of(-1.0, 1.2) == first  # noise; one that may be on its way
    assert coverage_of(-1.0, 1.2) != first
    assert coverage.reached(2, depth=True) in coverage_of(-1.0, 1.2, depth=("cam00",))


def control_panel(state: EdgeState) -> ControlPanel:
    gui = MagicMock()
    gui.add_dropdown.side_effect = lambda _, options, initial_value=None, **more: MagicMock(
        options=options, value=initial_value
    )
    return ControlPanel(MagicMock(gui=gui), state)


def test_a_learned_policy_is_shown_by_its_files_name_and_chosen_by_its_path():
    chosen, path = [], "bandit:/far/away/p.npz"
    state = replace(bare_state(), policies=(path, "all"), set_policy=lambda *p: chosen.append(p))
    panel = control_panel(state)
    assert panel.policy.options == ("bandit:p.npz", "all") and panel.policy.value == "all"
    panel._policy_chosen(MagicMock(target=MagicMock(value="bandit:p.npz")))
    assert chosen == [(path, None)]
    state.controls.policy = path
    panel.refresh()
    assert panel.policy.value == "bandit:p.npz"


def test_an_operator_is_answered_with_what_was_wrong_and_pauses_resets_and_resumes():
    client, set_policy = MagicMock(), MagicMock(side_effect=[ValueError("expected a whole number"), None])
    state = replace(bare_state(), policies=("all", "freshest-k"), set_policy=set_policy)
    panel = control_panel(state)
    for value, by in ((5, client), (3, client), (4, None)):  # the last is set by refresh, not by a visitor
        panel._value_entered(MagicMock(target=MagicMock(value=value), client=by))
    assert [call.args for call in set_policy.call_args_list] == [("all", 5.0), ("all", 3.0)]
    assert [call.args[1] for call in client.add_notification.call_args_list] == ["expected a whole number"]
    for button, paused in (("pause", True), ("reset", True), ("resume", False)):
        asyncio.run(panel._pressed(MagicMock(target=MagicMock(value=button), client=client)))
        assert state.controls.paused == paused and ("resume" in panel.buttons.options) == paused
    assert state.controls.reset_requested


def test_the_present_point_is_the_mean_of_the_last_instants_and_updates():
    state = bare_state()
    assert state.present() is None
    for number in range(40):
        state.publish(publication(number), BallScene(0.0))
        moving_db = 10.0 if number == 39 else None
        state.add_shown(Score("cam00", 0, 20.0 + (number >= 10), moving_db, None, None, None))
    times = [p.t_s for p in state.publications()[-30:]]
    assert state.present() == (pytest.approx(1e3 * np.diff(times).mean()), 21.0, 10.0)


def shown_to(loop: RenderLoop) -> MagicMock:
    """A visitor of the loop."""
    at = {"position": (4.0, 0.0, 3.0), "wxyz": (1.0, 0, 0, 0), "fov": 0.9, "image_width": 80, "image_height": 60}
    loop.add_client(client := MagicMock(client_id=1, camera=SimpleNamespace(**at)))
    return client


def test_nothing_is_rendered_without_visitors_and_one_who_moves_by_a_millimeter_has_moved():
    state, broken = bare_state(), Broken()
    loop = RenderLoop(state)
    state.publish(replace(publication(1), update_ms=800.0), broken)
    assert not loop._work(0.0) and broken.renders == 0
    client = shown_to(loop)
    for x_m, serial in ((4.0, 1), (4.001, 2), (4.001 + 1e-9, 2)):
        client.camera.position = (x_m, 0.0, 3.0)
        loop.camera_moved(client)
        assert loop._visitors[1].serial == serial
    assert loop._budget_s(NEWER) == pytest.approx(0.16), "a fifth of an update, 0.2 s at most"
    assert loop._budget_s(MOVING) == LEVELS[MOVING].budget_s


def test_who_looks_at_truth_gets_each_comparison_once_and_the_picture_before_there_is_one():
    state = bare_state()
    loop = RenderLoop(state)
    loop.choose(client := shown_to(loop), display_modes.TRUTH)
    sent = client.scene.set_background_image
    state.publish(publication(0), BallScene(0.0))
    assert loop._work(1e9) and sent.call_count == 1
    truth = np.full((6, 8, 3), 200, np.uint8)
    for number in (1, 2):
        state.scored(publication(0), Comparison("cam00", truth, truth, number))
        assert loop._work(1e9 * number + 1e9) and not loop._work(1e9 * number + 2e9)
        assert sent.call_count == 1 + number and (sent.call_args.args[0] == 200).mean() > 0.2
    loop.choose(client, display_modes.PICTURE)
    assert loop._work(9e9) and (sent.call_args.args[0] == 200).mean() < 0.2


def test_what_no_camera_has_seen_is_asked_for_finer_pictures_and_not_while_a_visitor_moves():
    state, scene = bare_state(), BallScene(0.0)
    scene.unseen = MagicMock(side_effect=lambda pose, camera: np.ones((camera.height, camera.width), bool))
    loop = RenderLoop(state)
    shown_to(loop)
    state.publish(publication(0), scene)
    for asked in (0, 1, 2):
        assert loop._work(1e9 * (1 + asked)) and scene.unseen.call_count == asked


@pytest.mark.parametrize("raises", [False, True])
def test_the_page_outlives_a_broken_field_and_stops_at_once(raises):
    before, state, field = set(threading.enumerate()), bare_state(), Broken(raises)
    state.cameras = lambda: [CameraView("never", False, None, None, 0, 0)]
    with page_of(state) as page, Visitor(page.port) as visitor:
        for number in range(8):
            state.publish(publication(number), field)
        black = np.zeros((4, 4, 3), np.uint8)
        state.scored(replace(publication(7), psnr_db=float("inf")), Comparison("never", black, black, 7))
        wait_until(lambda: field.renders > 0, "nothing was rendered")
        state.publish(publication(8), BallScene(0.0))  # it has recovered
        image = lambda: cv2.imdecode(np.frombuffer(visitor.image, np.uint8), cv2.IMREAD_COLOR)  # noqa: E731
        visitor.wait_for(lambda: visitor.image is not None and image().std() > 20, "the ball")
        with pytest.raises(PageError, match="--page-port"):
            start_page(bare_state(), "127.0.0.1", page.port)
    start_page(bare_state(), "127.0.0.1", page.port).stop()
    assert not [t for t in set(threading.enumerate()) - before if t.name.startswith("page")]


def test_a_state_that_fails_to_answer_is_reported_once_and_survived(caplog):
    state = bare_state()
    state.cameras = MagicMock(side_effect=RuntimeError("half started"))
    with page_of(state) as page, Visitor(page.port) as visitor:
        wait_until(lambda: "half started" in caplog.text, "no log entry")
        time.sleep(1.2)
        assert caplog.text.count("page: refresh failed") == 1
        state.cameras = lambda: [CameraView("late", False, None, None, 0, 0)]
        at = visitor.counts["GuiUpdateMessage"]
        visitor.wait_for(lambda: visitor.counts["GuiUpdateMessage"] > at, "the table")
