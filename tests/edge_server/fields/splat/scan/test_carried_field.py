"""Views of a carried camera, one after the other, as a live edge gives them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, View
from edge_server.fields.splat.densification import GaussianCloud
from edge_server.fields.splat.scan import settings as tuned
from edge_server.fields.splat.scan.carried_field import CarriedField
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import look_at, se3, so3_exp
from tests.edge_server.fields.scenes import seen
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.scan.walk import LENS, WALK, at, spoiled, walk

HELD = 8  # one in so many frames is held out
BAD_FROM = 40  # frame of a walk, four seconds after its begin
# Training amplifies rounding, and processors round differently: a single training says little where much is lost.
SEEDS = (0, 1, 2)


def slow(*case: Any) -> Any:
    """A case that differs from a quick one in length, or in what it is combined with."""
    return pytest.param(*case, marks=pytest.mark.slow)


def _field(threads: int = 2, gaussians: int = 3000, seed: int = 0) -> CarriedField:
    options = {"gaussians": gaussians, "start": 500, "seed_cells": 32, "contracted": False, "seed": seed}
    return CarriedField(SplatSettings(scan=True, refine=True, carried=True, threads=threads, **options))


def _played(views: list[View], field: CarriedField | None = None, steps: int = tuned.STEPS_A_KEYFRAME) -> CarriedField:
    """The field after an update with each frame that is not held out, all of one camera."""
    field = field or _field()
    for k, view in enumerate(views):
        if k % HELD:
            field.fit([replace(view, camera="hand")], Budget(steps=steps))
    return field


def _held(views: list[View]) -> list[View]:
    return [replace(view, camera="kept") for view in views[::HELD]]


def _db(field: CarriedField, views: list[View]) -> tuple[float, float]:
    """PSNR of held-out frames, as given and refined."""
    score, _ = score_views(field, _held(views), Scorer())
    assert score.psnr_refined_db is not None
    return score.psnr_db, score.psnr_refined_db


def test_frames_become_keyframes_and_held_out_ones_take_their_neighbors_corrections() -> None:
    views = spoiled(WALK)
    field = _played(views)
    assert len(field.views) == len(views) - len(views[::HELD])
    raw_db, refined_db = _db(field, views)
    assert refined_db > 20.0 and refined_db > raw_db + 4.0
    snapshot, held = field.snapshot(), _held(views)[3]
    before = snapshot.correction(held)
    field.fit([replace(views[1], camera="hand", generated_ns=views[-1].generated_ns + 1)], Budget(steps=30))
    after = snapshot.correction(held)
    assert before is not None and after is not None
    np.testing.assert_array_equal(before.camera_to_world, after.camera_to_world)  # a snapshot never changes


def test_without_depth_it_begins_anew_until_it_has_seen_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    views, field, anew = walk(depth=False), _field(), list[int]()
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
    assert _undisturbed(False)[-1] > 18.0


def test_a_frame_is_taken_once_and_not_before_its_turn() -> None:
    field, view = _field(), replace(WALK[1], camera="hand")
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
    field, askew, turned = _field(), so3_exp(np.array([0.0, np.deg2rad(1.5), 0.0])), {"left": [], "right": []}
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
    field = _played([*one, *(replace(view, generated_ns=view.generated_ns + 8_000_000_000) for view in one)])
    assert len(field.views) == len(field._cams) == len(field._aims) == len(field._targets.exposure) == 20
    at = np.stack([view.camera_to_world[:3, 3] for view in field.views])
    apart = np.linalg.norm(at[:, None] - at[None], axis=2) + 10.0 * np.eye(len(at))
    assert apart[: -tuned.NEWEST, : -tuned.NEWEST].min() > 0.25  # spread over the whole round
    assert _db(field, WALK)[1] > 20.0


def test_it_resumes_bit_for_bit_whatever_the_number_of_threads() -> None:
    views = spoiled(WALK)
    fields = [_field(threads) for threads in (2, 1, 2)]
    for field in fields[:2]:
        _played(views[:20], field)
    fields[2].load_state(fields[0].state())
    for field in fields:
        _played(views[20:30], field)
    for other in fields[1:]:
        same_state(fields[0], other)
    assert fields[0]._poses.meta() == fields[1]._poses.meta() == fields[2]._poses.meta()


@pytest.mark.stability
def test_two_hundred_identical_frames_change_little() -> None:
    field, views = _resumed(True), WALK[:BAD_FROM]
    last = replace(views[-1], camera="hand")
    for k in range(200):
        field.fit([replace(last, generated_ns=last.generated_ns + k + 1)], Budget(steps=4))
    assert _db(field, views)[1] > _undisturbed(True)[2] - 1.0


def _other(view: View) -> View:
    return replace(view, image=np.ascontiguousarray(255 - view.image[::-1]), depth=None)


def _leaping(view: View) -> View:
    pose = view.camera_to_world.copy()
    pose[:3, 3] += pose[:3, 0]
    return replace(view, camera_to_world=pose)


def _covered(view: View) -> View:
    depth = None if view.depth is None else np.full_like(view.depth, 0.05)
    return replace(view, image=np.full_like(view.image, 40), depth=depth)


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


def _by_seconds(views: list[View], scored: list[View], field: CarriedField, begin: int = 0) -> list[float]:
    """Plays the frames from ``begin`` on; after each second from the second on the mean PSNR of the held-out frames so
    far of ``scored``."""
    found = []
    for end in range(begin + 10, len(views) + 1, 10):
        for k in range(end - 10, end):
            if k % HELD:
                field.fit([replace(views[k], camera="hand")], Budget(steps=tuned.STEPS_A_KEYFRAME))
        if end >= 20:
            found.append(_db(field, scored[:end])[1])
    return found


@cache
def _begun(depth: bool, seed: int) -> tuple[dict[str, np.ndarray], tuple[float, ...]]:
    """State and scores of the four seconds with which all walks begin that become bad later."""
    views, field = walk(depth=depth)[:BAD_FROM], _field(seed=seed)
    found_db = _by_seconds(views, views, field)
    return field.state(), tuple(found_db)


def _resumed(depth: bool, seed: int = 0) -> CarriedField:
    field = _field(seed=seed)
    field.load_state(_begun(depth, seed)[0])
    return field


def _gone_on(views: list[View], scored: list[View], seed: int = 0) -> tuple[CarriedField, list[float]]:
    """The field after frames of which the first four seconds are those of ``walk``, and its scores."""
    depth = views[0].depth is not None
    field = _resumed(depth, seed)
    return field, [*_begun(depth, seed)[1], *_by_seconds(views, scored, field, BAD_FROM)]


@cache
def _undisturbed(depth: bool, seed: int = 0) -> tuple[float, ...]:
    return tuple(_gone_on(walk(depth=depth), walk(depth=depth), seed)[1])


@pytest.mark.stability
@pytest.mark.parametrize(
    ("spoil", "frames", "said", "depth", "least_db", "lost_db"),
    [
        (_other, 6, True, True, 20.8, 1.0),
        slow(_other, 6, True, False, 21.8, 1.0),
        (_leaping, 3, True, True, 21.0, 1.0),
        slow(_leaping, 3, True, False, 21.6, 1.0),
        (_covered, 6, True, True, 20.8, 1.0),
        slow(_covered, 6, True, False, 21.8, 1.0),
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
    field, found_db = _gone_on(views, clean)
    assert np.isfinite(field.cloud.params).all()
    assert any("left out" in line for line in field.troubles) or not said
    assert found_db[-1] > least_db
    lost = (np.array(_undisturbed(depth)) - found_db)[3:]
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
    return _covered(view)


@pytest.mark.stability
@pytest.mark.parametrize("begin", [_looks_about, _under_a_hand])
def test_depth_that_nothing_tells_is_guessed_and_said_until_frames_tell_it(begin) -> None:
    """The scene is 2.1 m away: half a second of walking tells it, whatever was guessed before."""
    clean, field = walk(depth=False), _field()
    bad = [begin(k, clean[0]) for k in range(20)]
    for k, view in enumerate([*bad, *clean[:6]]):
        assert k != 20 or "tell no depth" in str(field.troubles)
        field.fit([replace(view, camera="hand", generated_ns=100_000_000 * k)], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert field._seen_m == pytest.approx(2.07, abs=0.05) and field.troubles == ()


def _walk_after(begin: Callable[[int, View], View], depth: bool, seed: int) -> list[float]:
    """Mean PSNR of the held-out frames so far, two to five seconds after two seconds of a bad beginning."""
    clean, field = walk(depth=depth)[:50], _field(seed=seed)
    for k in range(20):
        view = replace(begin(k, clean[0]), camera="hand", generated_ns=100_000_000 * k)
        field.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
    views = [replace(view, generated_ns=view.generated_ns + 2_000_000_000) for view in clean]
    found_db = _by_seconds(views, views, field)
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
    lost = [np.array(_undisturbed(depth, seed))[:4] - _walk_after(begin, depth, seed) for seed in SEEDS]
    assert np.mean(lost, axis=0).max() < lost_db


@pytest.mark.stability
@pytest.mark.parametrize(("count", "lost_db"), [(3000, 3.0), slow(60_000, 3.5)])
def test_gaussians_that_fall_into_a_point_are_grown_again_within_two_seconds(
    count: int, lost_db: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """lost_db: at most, against a walk without that."""
    monkeypatch.setattr(tuned, "LEAST", max(tuned.LEAST, count))  # a picture so small asks for fewer
    field = _played(WALK[:BAD_FROM], _field(gaussians=count))
    if len(field.cloud) < count:
        field.cloud = GaussianCloud.new(np.resize(field.cloud.params, (count, field.cloud.params.shape[1])))
    field.cloud.params[:, :3] = field.cloud.params[0, :3]
    _played(WALK[BAD_FROM : BAD_FROM + 20], field)
    assert np.isfinite(field.cloud.params).all()
    assert _db(field, WALK[: BAD_FROM + 20])[1] > _undisturbed(True)[4] - lost_db


def _shifted(views: list[View], frames: int) -> list[View]:
    """With the pose of so many frames later, which are a tenth of a second each; negative: of earlier ones."""
    last = len(views) - 1
    return [
        replace(view, camera_to_world=views[min(max(k + frames, 0), last)].camera_to_world)
        for k, view in enumerate(views)
    ]


@pytest.mark.slow  # the same is told of given corrections in ``test_tracking``
@pytest.mark.stability
def test_poses_late_by_a_tenth_of_a_second_are_said_and_mended() -> None:
    late = _shifted(WALK, -1)
    assert _db(_played(late), late)[1] > 21.0  # with right poses 21.7
    # At one speed a delay is as a camera that is mounted elsewhere; to and fro it is told from that.
    there_and_back = [
        replace(WALK[30 - abs(k % 60 - 30)], generated_ns=view.generated_ns) for k, view in enumerate(WALK)
    ]
    right_db = _db(_played(there_and_back), there_and_back)[1]
    for frames, word in ((-1, "late"), (1, "early")):
        shifted = _shifted(there_and_back, frames)
        field = _played(shifted)
        (said,) = (line for line in field.troubles if line.startswith(f"hand: its poses are {word} by some"))
        assert 50 <= int(said.split(" ms or more")[0].split()[-1]) <= 100, said  # corrections follow a part of it
        assert _db(field, shifted)[1] > right_db - 0.8


def _in_unit(scale: float) -> Callable[[int, View], View]:
    def other(k: int, view: View) -> View:
        pose = view.camera_to_world.copy()
        pose[:3, 3] *= scale
        return replace(view, camera_to_world=pose)

    return other


def _without_rotation(k: int, view: View) -> View:
    pose = WALK[0].camera_to_world.copy()
    pose[:3, 3] = view.camera_to_world[:3, 3]
    return replace(view, camera_to_world=pose)


@pytest.mark.slow  # that pictures take over, and resume, is held below
@pytest.mark.stability
@pytest.mark.parametrize(
    ("spoil", "words", "lost_db"),
    [
        (_in_unit(1000.0), "times as far apart as meters are", 2.3),
        (_in_unit(0.001), "times as far apart as meters are", 4.0),
        (_without_rotation, "no rotation", 3.6),
    ],
)
def test_poses_that_never_fit_give_way_to_pictures_where_depth_is_measured(spoil, words: str, lost_db: float) -> None:
    """lost_db: at most, against right poses, at each of five instants from the fourth second on, on average over three
    trainings; as they are, such poses cost up to 11 dB for as long as was looked. The walk takes a keyframe each 4
    degrees and 15 cm, which 48 x 40 pixels show coarsely."""
    views, lost = [spoil(k, view) for k, view in enumerate(WALK)], []
    for seed in SEEDS:
        field = _field(seed=seed)
        found_db = _by_seconds(views, views, field)
        assert np.isfinite(field.cloud.params).all() and len(field.views) > 60
        assert any("reported poses do not fit" in line and words in line for line in field.troubles)
        lost.append((np.array(_undisturbed(True, seed)) - found_db)[2:])
    assert np.mean(lost, axis=0).max() < lost_db


@pytest.mark.stability
@pytest.mark.parametrize("turns", [True, False])
def test_without_depth_it_is_said_that_poses_have_no_rotation(turns: bool) -> None:
    """A camera that slides along the scene without turning is not accused. In pictures of the walk, half as large, a
    keyframe moves corners by less than a pixel."""
    field, lens, views = _field(), LENS.scaled(2.0), []
    for k in range(20):
        pose = WALK[0].camera_to_world.copy()
        pose[:3, 3] += (0.04 * k - 0.4) * pose[:3, 0]
        if turns:
            pose[:3, :3] = pose[:3, :3] @ so3_exp(np.deg2rad([6.0 * np.sin(0.5 * k), 12.0 * np.cos(0.5 * k), 0.0]))
        reported = np.array([*WALK[0].camera_to_world.T[:3], pose.T[3]]).T
        views.append(View("hand", seen(lens, pose)[0], reported, lens, 100_000_000 * k))
    for view in views:
        field.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert np.isfinite(field.cloud.params).all()
    assert any("hand: reported poses have no rotation" in line for line in field.troubles) is turns
    resumed = _field()
    resumed.load_state(field.state())
    assert resumed.troubles == field.troubles


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1000.0, 10.0])
def test_without_depth_any_unit_of_poses_is_as_good(scale: float) -> None:
    """With a distance that was guessed in meters, poses in millimeters ended 10 dB lower."""
    right = walk(depth=False)[:30]
    views = [_in_unit(scale)(k, view) for k, view in enumerate(right)]
    field = _played(views)
    assert _db(field, views)[1] > _begun(False, 0)[1][1] - 1.0
    assert not any("tell no depth" in line or "hand-eye" in line for line in field.troubles)


@pytest.mark.stability
@pytest.mark.parametrize("turn_deg", [12.0, 20.0, 40.0])
def test_exact_poses_stay_where_a_camera_turns_quickly(turn_deg: float) -> None:
    field = _field()
    for k in range(20):
        pose = WALK[0].camera_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ so3_exp(np.deg2rad([0.0, turn_deg * k, 0.0]))
        view = replace(at(pose, WALK[0]), generated_ns=100_000_000 * k)
        field.fit([replace(view, camera="hand")], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert not field.troubles and len(field.views) == 20
    angles = [np.rad2deg(np.linalg.norm(each.rotation)) for each in field._poses.known.values()]
    assert max(angles) < 2.0


@pytest.mark.stability
def test_reported_poses_are_believed_again_after_a_leap_of_a_second() -> None:
    clean = walk()
    leap = slice(BAD_FROM, BAD_FROM + 10)
    field, _ = _gone_on([*clean[: leap.start], *map(_leaping, clean[leap]), *clean[leap.stop :]], clean)
    late = field._poses.newest("hand", 20)
    assert max(np.linalg.norm(each.shift_m) for each in late) < 0.2
    assert all(each.reported is None for each in late)


def _relocalized(k: int, view: View) -> View:
    """From the fourth second on poses are off by a meter and 20 degrees: the tracker has found itself anew."""
    at_m, turn = WALK[BAD_FROM].camera_to_world[:3, 3], so3_exp(np.deg2rad([0.0, 0.0, 20.0]))
    leap = se3(turn, at_m - turn @ at_m + WALK[BAD_FROM].camera_to_world[:3, 2])
    return view if k < BAD_FROM else replace(view, camera_to_world=leap @ view.camera_to_world)


@pytest.mark.slow  # that a leap is found, and resumed, is held below
@pytest.mark.stability
@pytest.mark.parametrize("depth", [True, False])
def test_poses_that_leap_and_stay_so_are_taken_back(depth: bool) -> None:
    """Taken as they are after ten frames, they cost 4 dB of all held-out frames so far for as long as was looked."""
    views, lost = [_relocalized(k, view) for k, view in enumerate(walk(depth=depth))], []
    for seed in SEEDS:
        field, found_db = _gone_on(views, views, seed)
        lost.append((np.array(_undisturbed(depth, seed)) - found_db)[3:])
        (said,) = (line for line in field.troubles if line.startswith("hand: its poses leapt by 1."))
        assert 17 <= int(said.split(" degrees")[0].split()[-1]) <= 23, said
    assert np.mean(lost) < 0.6  # measured: .1 each, single trainings -.2 to .3


@pytest.mark.stability
@pytest.mark.parametrize("covered", [True, slow(False)])
@pytest.mark.parametrize(
    ("frames", "depth"), [(6, False), slow(9, False), (11, False), slow(14, False), (9, True), slow(11, True)]
)
def test_a_camera_that_is_carried_elsewhere_meanwhile_has_not_leapt(frames: int, depth: bool, covered: bool) -> None:
    """It sees a hand or nothing comes of it, and it goes a quarter faster. Its right poses were taken back by the way
    that it had gone: 2 m."""
    clean, begin = walk(depth=depth), BAD_FROM + round(1.25 * frames)
    bad = [_covered(view) for view in clean[BAD_FROM : BAD_FROM + frames]] if covered else []
    after = [
        replace(view, generated_ns=100_000_000 * k)
        for k, view in enumerate(clean[begin : begin + 14], BAD_FROM + frames)
    ]
    field = _resumed(depth)
    for view in [*bad, *after]:
        field.fit([replace(view, camera="hand")], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert not any("leapt" in line for line in field.troubles)
    for view in after[4:]:
        found = field.correction(replace(view, camera="hand", generated_ns=view.generated_ns + 1))
        assert found is not None
        assert np.linalg.norm((found.camera_to_world - view.camera_to_world)[:3, 3]) < 0.25  # measured: .13


@pytest.mark.parametrize("until", [42, 46])  # two frames suggest the leap; it is believed
def test_a_camera_whose_poses_leapt_resumes_bit_for_bit(until: int) -> None:
    views = [replace(_relocalized(k, view), camera="hand") for k, view in enumerate(WALK[:50])]
    field, resumed = _resumed(True), _field()
    for k, view in enumerate(views[BAD_FROM:], BAD_FROM):
        field.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
        if k == until:
            resumed.load_state(field.state())
        if k > until:
            resumed.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert "poses leapt" in str(field.troubles) and resumed.troubles == field.troubles
    same_state(field, resumed)


def test_a_camera_that_is_located_by_its_pictures_resumes_bit_for_bit() -> None:
    views = [replace(_in_unit(1000.0)(k, view), camera="hand") for k, view in enumerate(WALK[:30])]
    field, resumed = _field(), _field()
    for k, view in enumerate(views):
        field.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
        if k == 19:
            resumed.load_state(field.state())
        if k > 19:
            resumed.fit([view], Budget(steps=tuned.STEPS_A_KEYFRAME))
    assert field._own.replaced["hand"] > 15 and resumed.troubles == field.troubles
    same_state(field, resumed)
