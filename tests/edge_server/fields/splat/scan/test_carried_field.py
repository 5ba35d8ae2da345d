"""Views of a carried camera, one after the other, as a live edge gives them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.splat.densification import GaussianCloud
from edge_server.fields.splat.scan import settings as tuned
from freshfield.geometry import look_at, so3_exp
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.scan.carried import (
    BAD_FROM,
    HELD,
    SEEDS,
    by_seconds,
    carried_field,
    covered_view,
    gone_on,
    held_out,
    leaping,
    played,
    resumed_field,
    scored_db,
    slow,
    undisturbed,
)
from tests.edge_server.fields.splat.scan.walk import WALK, at, spoiled, walk


def test_frames_become_keyframes_and_held_out_ones_take_their_neighbors_corrections() -> None:
    views = spoiled(WALK)
    field = played(views)
    assert len(field.views) == len(views) - len(views[::HELD])
    raw_db, refined_db = scored_db(field, views)
    assert refined_db > 20.0 and refined_db > raw_db + 4.0
    snapshot, held = field.snapshot(), held_out(views)[3]
    before = snapshot.correction(held)
    field.fit([replace(views[1], camera="hand", generated_ns=views[-1].generated_ns + 1)], Budget(steps=30))
    after = snapshot.correction(held)
    assert before is not None and after is not None
    np.testing.assert_array_equal(before.camera_to_world, after.camera_to_world)  # a snapshot never changes


def test_without_depth_it_begins_anew_until_it_has_seen_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    views, field, anew = walk(depth=False), carried_field(), list[int]()
    begin, taken = field._begin_anew, list[int]()
    monkeypatch.setattr(field, "_begin_anew", lambda: anew.append(field._taken) or begin())
    for view in views[:30]:
        field.fit([replace(view, camera="hand")], Budget(steps=tuned.STEPS_A_KEYFRAME))
        taken.append(field._taken)
    assert anew == [2, 4, 8]
    # Beginning anew counts steps from 0 again, not the turns of frames.
    assert taken == list(range(taken[0], taken[0] + 30))
    # The depth that was found serves the box, and each keyframe's own the steps of its pose.
    box, pixels_m = field.view_store.box, [pixel_m for _, pixel_m in field._aims[: tuned.BEGINS[-1]]]
    assert box is not None and box.distance_m == pytest.approx(field._seen_m) and len(set(pixels_m)) == len(pixels_m)
    assert undisturbed(False)[-1] > 18.0


def test_a_frame_is_taken_once_and_not_before_its_turn() -> None:
    field, view = carried_field(), replace(WALK[1], camera="hand")
    for _ in range(3):
        field.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert len(field.views) == 1
    for k, expected in ((2, 2), (3, 3), (4, 4), (5, 4)):  # three turns have passed; a new camera needs none
        field.fit([replace(WALK[k], camera="hand")], Budget(steps=0))
        assert len(field.views) == expected, k
    field.fit([replace(WALK[6], camera="other")], Budget(steps=0))
    assert len(field.views) == 5


def test_each_moving_camera_has_corrections_of_its_own() -> None:
    """One is mounted 1.5 degrees askew, the other is not."""
    field, askew, turned = carried_field(), so3_exp(np.array([0.0, np.deg2rad(1.5), 0.0])), {"left": [], "right": []}
    for k in range(1, 30):
        right = WALK[k].camera_to_world.copy()
        right[:3, :3] = right[:3, :3] @ askew
        field.fit([replace(WALK[k], camera="left")], Budget(steps=24))
        field.fit([replace(WALK[k], camera="right", camera_to_world=right)], Budget(steps=24))
    for name, known in field._poses.known.items():
        assert known.track == name.partition("#")[0]
        turned[known.track].append(known.given[:3, :3].T @ known.rotation)
    apart_deg = np.rad2deg(np.mean(turned["right"], axis=0) - np.mean(turned["left"], axis=0))
    assert -1.9 < apart_deg[1] < -0.75 and np.abs(apart_deg[[0, 2]]).max() < 0.4


def test_keyframes_taken_near_each_other_go_first_and_memory_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tuned, "KEPT_PIXELS", 0)
    monkeypatch.setattr(tuned, "LEAST_KEPT", 20)
    one = WALK[::2]
    field = played([*one, *(replace(view, generated_ns=view.generated_ns + 8_000_000_000) for view in one)])
    assert len(field.views) == len(field._cams) == len(field._aims) == len(field._targets.exposure) == 20
    at = np.stack([view.camera_to_world[:3, 3] for view in field.views])
    apart = np.linalg.norm(at[:, None] - at[None], axis=2) + 10.0 * np.eye(len(at))
    assert apart[: -tuned.NEWEST, : -tuned.NEWEST].min() > 0.25  # spread over the whole round
    assert scored_db(field, WALK)[1] > 20.0


def test_it_resumes_bit_for_bit_whatever_the_number_of_threads() -> None:
    views = spoiled(WALK)
    fields = [carried_field(threads) for threads in (2, 1, 2)]
    for field in fields[:2]:
        played(views[:20], field)
    fields[2].load_state(fields[0].state())
    for field in fields:
        played(views[20:30], field)
    for other in fields[1:]:
        same_state(fields[0], other)
    assert fields[0]._poses.meta() == fields[1]._poses.meta() == fields[2]._poses.meta()


@pytest.mark.stability
def test_two_hundred_identical_frames_change_little() -> None:
    field, views = resumed_field(True), WALK[:BAD_FROM]
    last = replace(views[-1], camera="hand")
    for k in range(200):
        field.fit([replace(last, generated_ns=last.generated_ns + k + 1)], Budget(steps=4))
    assert scored_db(field, views)[1] > undisturbed(True)[2] - 1.0


def _other(view: View) -> View:
    return replace(view, image=np.ascontiguousarray(255 - view.image[::-1]), depth=None)


def _bright(view: View) -> View:
    return replace(view, image=np.clip(view.image * 3.0, 0, 255).astype(np.uint8))


def _white(view: View) -> View:
    depth = None if view.depth is None else np.full_like(view.depth, 1.0)
    return replace(view, image=np.full_like(view.image, 235), depth=depth)


def _turning(view: View, place: View = WALK[BAD_FROM]) -> View:
    """It looks about from one place."""
    pose = view.camera_to_world.copy()
    pose[:3, 3] = place.camera_to_world[:3, 3]
    return at(pose, view)


def _blurred(view: View) -> View:
    """It turns by ten degrees while it exposes."""
    parts = []
    for angle in np.linspace(-0.09, 0.09, 9):
        pose = view.camera_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ so3_exp(np.array([0.0, angle, 0.0]))
        parts.append(at(pose, view).image.astype(np.float64))
    return replace(view, image=(np.mean(parts, axis=0) + 0.5).astype(np.uint8))


@pytest.mark.stability
@pytest.mark.parametrize(
    ("spoil", "frames", "said", "depth", "least_db", "lost_db"),
    [
        (_other, 6, True, True, 20.8, 1.0),
        slow(_other, 6, True, False, 21.8, 1.0),
        (leaping, 3, True, True, 21.0, 1.0),
        slow(leaping, 3, True, False, 21.6, 1.0),
        (covered_view, 6, True, True, 20.8, 1.0),
        slow(covered_view, 6, True, False, 21.8, 1.0),
        slow(_bright, 6, False, True, 20.0, 1.5),
        (_bright, 6, False, False, 20.4, 1.4),
        slow(_white, 6, True, True, 20.6, 1.0),
        (_white, 6, True, False, 21.4, 1.0),
        (_turning, 10, False, True, 20.4, 1.0),
        slow(_turning, 10, False, False, 21.2, 1.0),
        slow(_blurred, 6, False, True, 20.8, 1.0),
        (_blurred, 6, False, False, 21.2, 1.0),
    ],
)
def test_after_a_bad_second_the_picture_recovers_within_one(
    spoil, frames: int, said: bool, depth: bool, least_db: float, lost_db: float
) -> None:
    """least_db: of all held-out frames at the end. lost_db: against a walk without bad frames, on average over four
    instants, a second after the first bad frame (half a second after the last) and each second later. At one instant
    two such runs differ by .4 dB for nothing: another scipy moves it as much, so a single one may lose 1 dB more.
    """
    views = clean = walk(depth=depth)
    bad = slice(BAD_FROM, BAD_FROM + frames)
    views = [*clean[: bad.start], *map(spoil, clean[bad]), *clean[bad.stop :]]
    field, found_db = gone_on(views, clean)
    assert np.isfinite(field.cloud.params).all()
    assert any("left out" in line for line in field.troubles) or not said
    assert found_db[-1] > least_db
    lost = (np.array(undisturbed(depth)) - found_db)[3:]
    assert lost.mean() < lost_db and lost.max() < lost_db + 1.0


def _looks_about(k: int, view: View) -> View:
    """It turns to and fro by 15 degrees at the place where the walk begins."""
    pose = view.camera_to_world.copy()
    pose[:3, :3] = pose[:3, :3] @ so3_exp(np.deg2rad([0.0, 15.0 * np.sin(0.3 * k), 0.0]))
    return at(pose, view)


def _at_a_wall(k: int, view: View) -> View:
    """It moves along a bare wall, with its back to the scene."""
    eye = view.camera_to_world[:3, 3]
    pose = look_at(eye, 2.0 * eye)
    pose[:3, 3] += 0.02 * k * pose[:3, 0]
    return replace(_white(view), camera_to_world=pose)


def _under_a_hand(k: int, view: View) -> View:
    return covered_view(view)


@pytest.mark.stability
@pytest.mark.parametrize("begin", [_looks_about, _under_a_hand])
def test_depth_that_nothing_tells_is_guessed_and_said_until_frames_tell_it(begin) -> None:
    """The scene is 2.1 m away: half a second of walking tells it, whatever was guessed before."""
    clean, field = walk(depth=False), carried_field()
    bad = [begin(k, clean[0]) for k in range(20)]
    for k, view in enumerate([*bad, *clean[:6]]):
        assert k != 20 or "tell no depth" in str(field.troubles)
        field.fit([replace(view, camera="hand", generated_ns=100_000_000 * k)], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert field._seen_m == pytest.approx(2.07, abs=0.05) and field.troubles == ()


def _walk_after(begin: Callable[[int, View], View], depth: bool, seed: int) -> list[float]:
    """Mean PSNR of the held-out frames so far, two to five seconds after two seconds of a bad beginning."""
    clean, field = walk(depth=depth)[:50], carried_field(seed=seed)
    for k in range(20):
        view = replace(begin(k, clean[0]), camera="hand", generated_ns=100_000_000 * k)
        field.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
    views = [replace(view, generated_ns=view.generated_ns + 2_000_000_000) for view in clean]
    found_db = by_seconds(views, views, field)
    assert np.isfinite(field.cloud.params).all()
    return found_db


@pytest.mark.slow  # 20 s each
@pytest.mark.stability
@pytest.mark.parametrize(
    ("begin", "depth", "lost_db"),
    [
        (_looks_about, True, 1.0),
        (_looks_about, False, 1.0),
        (_at_a_wall, True, 1.2),
        (_at_a_wall, False, 1.0),
        (_under_a_hand, True, 1.2),
        (_under_a_hand, False, 3.0),
    ],
)
def test_a_bad_beginning_is_forgotten_within_two_seconds(begin, depth: bool, lost_db: float) -> None:
    """lost_db: at most, against a walk without that beginning, at each of four instants, on average over three
    trainings. What a camera that only turns, or sees nothing, guesses of the scene cost up to 11 dB for as long as it
    was kept."""
    lost = [np.array(undisturbed(depth, seed))[:4] - _walk_after(begin, depth, seed) for seed in SEEDS]
    assert np.mean(lost, axis=0).max() < lost_db


@pytest.mark.stability
@pytest.mark.parametrize(("count", "lost_db"), [(3000, 3.0), slow(60_000, 3.5)])
def test_gaussians_that_fall_into_a_point_are_grown_again_within_two_seconds(
    count: int, lost_db: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """lost_db: at most, against a walk without that."""
    monkeypatch.setattr(tuned, "LEAST", max(tuned.LEAST, count))  # a picture so small asks for fewer
    field = played(WALK[:BAD_FROM], carried_field(gaussians=count))
    if len(field.cloud) < count:
        field.cloud = GaussianCloud.new(np.resize(field.cloud.params, (count, field.cloud.params.shape[1])))
    field.cloud.params[:, :3] = field.cloud.params[0, :3]
    played(WALK[BAD_FROM : BAD_FROM + 20], field)
    assert np.isfinite(field.cloud.params).all()
    assert scored_db(field, WALK[: BAD_FROM + 20])[1] > undisturbed(True)[4] - lost_db
