from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from edge_server.fidelity.psnr import PSNR_CEILING_DB
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Rendering
from edge_server.live.scoring.held_out import HeldOutCamera
from edge_server.live.settings import MOST_PENDING
from edge_server.live.state import Publication
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pinhole, Pose

MS = 1_000_000
SIDE = 48
LENS = Pinhole.from_fov(SIDE, SIDE, 60.0)
HERE = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def truth_at(ms):
    """A square that moves 1 pixel in 20 ms over a textured, static wall."""
    image = 0.3 + 0.2 * np.random.default_rng(0).random((SIDE, SIDE, 3))
    column = round(ms / 20) % (SIDE - 8)
    image[10:18, column : column + 8] = 0.95
    return np.round(image * 255).astype(np.uint8)


def frame(ms, image=None, x_m=0.0):
    image = truth_at(ms) if image is None else image
    pose = replace(HERE, translation_m=(x_m, 0.0, 0.0))
    return Frame("h", "s", ms, ms * MS, pose, LENS, "png", payload.encode(image, "png"))


def camera(until_ms):
    """A held-out camera, with frames of every 40 ms until then."""
    made = HeldOutCamera("h", Scorer())
    feed(made, until_ms)
    return made


def feed(held_out, until_ms, start_ms=0):
    return [found for ms in range(start_ms, until_ms + 1, 40) for found in held_out.take(frame(ms))]


class Shows:
    """A snapshot that shows one image (H, W, 3) in [0, 1], and notes where it was rendered."""

    def __init__(self, image):
        self.image, self.poses = np.asarray(image, np.float32), []

    def render(self, camera_to_world, intrinsics):
        self.poses.append(camera_to_world[0, 3])
        return Rendering(self.image, self.image[..., 0], self.image[..., 0])


def shows(ms):
    return Shows(truth_at(ms) / 255)


def publication(ms):
    return Publication(ms, ms / 1e3, ms * MS, None, ("a",), (1.0,), 1.0, 1.0)


@pytest.mark.parametrize("present_ms, gap_ms", [(430, 10.0), (410, -10.0)])
def test_a_publication_is_scored_against_the_capture_nearest_to_the_present(present_ms, gap_ms):
    held_out = camera(400)
    assert held_out.publish(publication(present_ms), shows(present_ms + gap_ms)) == []  # none at or after it yet
    (found,) = held_out.take(frame(440))
    score = found.score
    assert score.psnr_db == PSNR_CEILING_DB and score.psnr_moving_db == PSNR_CEILING_DB
    assert (score.camera, score.truth_gap_ms, score.published_ns) == ("h", gap_ms, present_ms * MS)
    assert found.truth.taken_ns == round((present_ms + gap_ms) * MS)
    assert found.publication.number == present_ms and found.rendered.shape == (SIDE, SIDE, 3)


def test_without_a_capture_within_half_a_period_there_is_no_score_and_nothing_piles_up():
    held_out = camera(400)
    held_out.publish(publication(500), shows(0))
    assert held_out.take(frame(600)) == []
    assert held_out.publish(publication(600), shows(600)), "the one that follows has one"
    held_out, shown = camera(400), shows(0)
    for k in range(100):
        held_out.publish(publication(401 + k), shown)
    assert len(shown.poses) == MOST_PENDING


def test_the_history_stays_short_and_nothing_is_decoded_that_no_score_needs(monkeypatch):
    decoded, decode = [], payload.decode
    monkeypatch.setattr(payload, "decode", lambda *of: decoded.append(1) or decode(*of))
    held_out = camera(60_000)
    assert len(held_out.truths) == 33 and not decoded  # 1.3 s
    held_out.publish(publication(59_960), shows(0))
    assert 2 <= len(decoded) <= 5


def test_a_clock_that_jumps_back_starts_a_new_history():
    held_out = camera(4000)
    feed(held_out, 400)
    (found,) = held_out.publish(publication(390), shows(400))
    assert found.score.psnr_db == PSNR_CEILING_DB and found.score.truth_gap_ms == 10.0


@pytest.mark.parametrize("noisy, most", [(False, 1.0), (True, 0.1)])
def test_the_noise_of_real_video_is_not_motion(noisy, most):
    rng = np.random.default_rng(8)
    wall = 0.3 + 0.4 * rng.random((SIDE, SIDE, 3))
    held_out = HeldOutCamera("h", Scorer(), noisy)
    for ms in range(0, 801, 40):
        held_out.take(frame(ms, np.round(np.clip(wall + rng.normal(0, 0.02, wall.shape), 0, 1) * 255).astype(np.uint8)))
        found = held_out.publish(publication(ms - 5), Shows(wall))
    assert most - 0.5 <= found[0].score.moving_share <= most


def test_a_camera_that_moves_is_rendered_where_it_was_when_the_truth_was_taken_and_one_snapshot_waits():
    held_out = HeldOutCamera("h", Scorer())
    for ms in range(0, 401, 40):
        held_out.take(frame(ms, x_m=ms / 1e3))
    shown, later = shows(440), shows(440)
    held_out.publish(publication(430), shown)
    held_out.publish(publication(435), later)
    assert shown.poses == []  # its place is not known before its truth has come
    (found,) = held_out.take(frame(440, x_m=0.44))
    assert shown.poses == [0.44] and later.poses == [] and found.score.psnr_db == PSNR_CEILING_DB


def test_one_damaged_frame_costs_its_own_publication_and_is_decoded_once(monkeypatch):
    held_out = camera(400)
    held_out.publish(publication(440), shows(440))
    held_out.publish(publication(520), shows(520))
    torn = replace(frame(440), payload=b"torn")
    found = [*held_out.take(torn), *feed(held_out, 800, 480)]
    assert [each.publication.number for each in found] == [520]
    assert held_out.undecodable == 1 and torn not in [truth.frame for truth in held_out.truths]


def test_a_poisoned_rendering_goes_unscored_and_the_log_says_where(caplog):
    poisoned = truth_at(0) / 255
    poisoned[3, 4, 1] = np.nan
    held_out = camera(400)
    assert held_out.publish(publication(390), Shows(poisoned)) == []
    assert re.search(r"rendering: 1 of 6912 .* row 3, column 4, channel 1", caplog.text)
    assert len(held_out.publish(publication(391), shows(0))) == 1, "the next is scored"
