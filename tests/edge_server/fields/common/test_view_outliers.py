"""How far pixels are trusted: by age, and by what moved; and what a field makes of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.common import supervision
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.supervision import CameraMemory, remember_views, without_views
from edge_server.fields.common.view_outliers import MOST_REFUSALS, find_outliers, pixel_weights
from edge_server.fields.common.view_store import ViewStore
from edge_server.fields.ngp.settings import NgpSettings
from tests.edge_server.fields.scenes import picture, psnr, ring
from tests.edge_server.fields.small import SMALL, every_field, small

MS = 1_000_000
AGES_MS = (0, 50, 100, 200)
STILL = [replace(v, generated_ns=0) for v in ring(4, size=32)]
BALL = np.array([0.3, 0.0, 0.5])


def _later(views: list[View], ages_ms: tuple[float, ...] = AGES_MS) -> list[View]:
    """The ball has moved; the views are so old."""
    return [
        replace(v, image=picture(v.intrinsics, v.camera_to_world, BALL), generated_ns=round((1000 - age) * MS))
        for v, age in zip(views, ages_ms)
    ]


def _memory(*instants: list[View]) -> dict[str, CameraMemory]:
    memory: dict[str, CameraMemory] = {}
    for views in instants:
        remember_views(memory, views)
    return memory


def _settings(**options: float) -> NgpSettings:
    return NgpSettings(**options)  # type: ignore[arg-type]


def test_off_is_nothing_at_all() -> None:
    now = _later(STILL)
    assert pixel_weights(now, _memory(STILL, now), _settings()) is None
    assert pixel_weights(now, _memory(STILL, now), _settings(mask_grow_px_s=50.0)) is None
    assert pixel_weights([], {}, _settings(age_tau_ms=10.0)) is None
    same_age = _later(STILL, (0, 0, 0, 0))
    assert pixel_weights(same_age, _memory(STILL, same_age), _settings(age_tau_ms=9.0, mask_stale_ms=9.0)) is None


def test_weights_fall_with_age_beside_the_newest() -> None:
    now = _later(STILL)
    found = pixel_weights(now, _memory(now), _settings(age_tau_ms=100.0))
    assert found is not None
    for weight, view, age_ms in zip(found, now, AGES_MS):
        assert weight.dtype == np.float32 and weight.shape == view.image.shape[:2]
        np.testing.assert_allclose(weight, np.exp(-age_ms / 100.0), rtol=1e-6)


def test_of_stale_views_only_what_stood_still_counts() -> None:
    now = _later(STILL)
    memory = _memory(STILL, now)
    found = pixel_weights(now, memory, _settings(mask_stale_ms=60.0, age_tau_ms=100.0))
    assert found is not None
    for weight, view, age_ms in zip(found, now, AGES_MS):
        moved = memory[view.camera].moved
        assert moved is not None and 0 < moved.sum() < moved.size
        trust = np.float32(np.exp(-age_ms / 100.0))
        expected = np.where(moved & (age_ms > 60.0), np.float32(0.0), trust)
        np.testing.assert_array_equal(weight, expected)


def test_masks_grow_with_age() -> None:
    now = _later(STILL)
    memory = _memory(STILL, now)
    left = []
    for grow in (0.0, 10.0, 20.0, 1e6):
        found = pixel_weights(now, memory, _settings(mask_stale_ms=60.0, mask_grow_px_s=grow))
        assert found is not None
        left.append([int((w > 0).sum()) for w in found])
    moved = memory[now[2].camera].moved
    assert moved is not None
    assert [row[0] for row in left] == [32 * 32] * 4  # the newest is trusted whole, always
    assert left[0][2] > left[1][2] > left[2][2] > left[3][2] == 0
    assert left[1][2] - left[2][2] > 0 and left[0][3] - left[1][3] > left[0][2] - left[1][2]


def test_unknown_motion_is_not_masked() -> None:
    """One picture only, a camera that moved, a memory of another view: weighed by age alone."""
    now = _later(STILL)
    options = _settings(mask_stale_ms=60.0, age_tau_ms=100.0)
    by_age = pixel_weights(now, {}, _settings(age_tau_ms=100.0))
    shaken = []
    for view in STILL:
        pose = view.camera_to_world.copy()
        pose[0, 3] += 0.1
        shaken.append(replace(view, camera_to_world=pose))
    other = _memory(STILL, _later(STILL))  # equal views, but not these
    assert by_age is not None
    for memory in (_memory(now), _memory(shaken, now), other, {}):
        found = pixel_weights(now, memory, options)
        assert found is not None
        np.testing.assert_array_equal(found, by_age)


def test_clocks_that_lie_do_no_harm() -> None:
    now = [replace(v, generated_ns=ns) for v, ns in zip(_later(STILL), (0, -(2**62), 2**62 - 1, 2**62 - 1))]
    found = pixel_weights(now, _memory(STILL, now), _settings(age_tau_ms=1e-3, mask_stale_ms=1e-3))
    assert found is not None and np.isfinite(found).all()
    assert [float(w.max()) for w in found] == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("name", ["age_tau_ms", "mask_stale_ms", "mask_grow_px_s", "refuse_beyond"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_options_are_checked(name: str, value: float) -> None:
    for settings in SMALL.values():
        with pytest.raises(ValueError, match=f"{name} must be in"):
            replace(settings, **{name: value})


def _take_in(settings: Any, *instants: list[View]) -> Views:
    rig = ViewStore(settings)
    for views in instants:
        data = rig.add(views).data
    return data


def test_the_rig_packs_weights_only_where_asked() -> None:
    now = _later(STILL)
    off = _take_in(_settings(), STILL, now)
    assert off.weight.size == off.drawn.size == 0 and off.changed.size > 0
    aged = _take_in(_settings(age_tau_ms=100.0), STILL, now)
    assert aged.weight.shape == (len(aged.pixels),) and aged.drawn.size == 0
    masked = _take_in(_settings(mask_stale_ms=60.0), STILL, now)
    assert 0 < masked.drawn.size < len(masked.pixels)
    assert 0 < masked.changed.size < off.changed.size and (masked.weight[masked.changed] == 1.0).all()


@every_field
def test_masked_pixels_teach_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views whose moving pixels are noise: with the mask the field does not see the noise."""
    rng = np.random.default_rng(5)
    old, before = ring(13, size=32), ring(13, size=32, ball_m=BALL)
    fresh = [replace(v, generated_ns=200 * MS) for v in before[::2]]
    spoilt = []
    for view in before[1::2]:
        image = view.image.copy()
        image[8:20, 8:20] = rng.integers(0, 256, (12, 12, 3), dtype=np.uint8)
        spoilt.append(replace(view, image=image, generated_ns=0))
    on = ring(13, size=32, ball_m=np.array([0.5, 0.0, 0.5]))[::2]
    # What moved is said by hand, so that both leave out the same pixels: all of one view, a part of others.
    masks = {view.camera: np.zeros((32, 32), np.bool_) for view in spoilt}
    for k, mask in enumerate(masks.values()):
        mask[4:24, 4:24] = True
        mask |= k == 0
    real = supervision.moved_pixels
    monkeypatch.setattr(supervision, "moved_pixels", lambda before, now: masks.get(now.camera, real(before, now)))
    states = []
    for other in (False, True):
        stale = []
        for view in spoilt:
            inverted = masks[view.camera][..., None] & other
            stale.append(replace(view, image=np.where(inverted, 255 - view.image, view.image)))
        field = small(name, mask_stale_ms=60.0, changed_share=0.5)
        field.fit(old, Budget(steps=20))
        field.fit(fresh + stale, Budget(steps=30))
        field.fit([replace(v, generated_ns=400 * MS) for v in on] + stale, Budget(steps=30))
        states.append(field.state())
    learned = [name for name in states[0] if not name.startswith("image_") and name != "meta"]
    assert {"table", "density"} < set(learned) or {"params", "velocity", "guest"} < set(learned)
    for name in learned:
        np.testing.assert_array_equal(states[0][name], states[1][name], err_msg=name)


@every_field
def test_weighted_fits_repeat_and_resume_bit_for_bit(name: str) -> None:
    options = {"age_tau_ms": 100.0, "mask_stale_ms": 60.0, "mask_grow_px_s": 20.0}
    ages = tuple(25.0 * k for k in range(13))
    still = [replace(v, generated_ns=0) for v in ring(13, size=32)]
    now = _later(still, ages)
    one, two = small(name, threads=1, **options), small(name, threads=3, **options)
    one.fit(still, Budget(steps=15))
    one.fit(now, Budget(steps=10))
    middle = one.state()
    two.load_state(middle)
    for field in (one, two):
        field.fit(now, Budget(steps=10))
    for name, array in one.state().items():
        if name != "meta":
            np.testing.assert_array_equal(array, two.state()[name], err_msg=name)
    for view in now[:2]:
        assert psnr(one.render(view.camera_to_world, view.intrinsics).color, view.image / 255.0) > 10.0


def _shown(off: dict[str, float]) -> Any:
    """A field that shows each camera's picture, off by so much."""

    def pixels(view: View, points: np.ndarray) -> np.ndarray:
        column, row = points.astype(np.int64).T
        taken = view.image[row, column, :3].astype(np.float32) / 255.0
        return taken + np.float32(off.get(view.camera, 0.02))

    return lambda views, points: list(map(pixels, views, points))


def _refused(memory: dict[str, CameraMemory], off: dict[str, float], **more: Any) -> list[str]:
    views = [m.view for m in memory.values()]
    known: dict[str, Any] = {"beyond": 2.5, "settled": True, **more}
    flags = find_outliers(views, memory, render_points=_shown(off), **known)
    return [view.camera for view, flag in zip(views, flags) if flag]


def test_a_view_is_refused_where_others_agree_and_it_did() -> None:
    memory = _memory(ring(8, size=32))
    wrong = {"cam03": 0.5}
    assert _refused(memory, wrong) == [], "it never agreed: it may see what no other does"
    assert _refused(memory, {}) == []
    assert {m.refusals_left for m in memory.values()} == {MOST_REFUSALS}
    assert _refused(memory, wrong, beyond=0.0) == []
    assert _refused(memory, wrong, settled=False) == []
    assert _refused(memory, {"cam03": 0.09}) == [], "little is wrong with it"
    assert _refused(memory, {f"cam{k:02d}": 0.5 for k in range(3)}) == [], "too many to be wrong"
    assert _refused(memory, {"cam03": float("nan")}) == ["cam03"]
    assert memory["cam03"].refusals_left == MOST_REFUSALS - 1
    assert _refused(memory, {}) == [] and memory["cam03"].refusals_left == MOST_REFUSALS
    assert [_refused(memory, wrong) for _ in range(MOST_REFUSALS)] == [["cam03"]] * MOST_REFUSALS
    assert _refused(memory, wrong) == [], "the scene has changed, then"


def test_views_agree_with_a_field_that_shows_half_of_them_exactly() -> None:
    memory = _memory(ring(8, size=32))
    small = {f"cam{k:02d}": 0.0 if k < 6 else 0.04 for k in range(8)}
    assert _refused(memory, small) == [] and {m.refusals_left for m in memory.values()} == {MOST_REFUSALS}
    assert _refused(memory, {**small, "cam07": 0.5}) == ["cam07"]


def test_a_camera_that_moves_is_not_doubted() -> None:
    views = ring(8, size=32)
    memory = _memory(views)
    _refused(memory, {})
    pose = views[3].camera_to_world.copy()
    pose[0, 3] += 0.5
    remember_views(memory, [replace(views[3], camera_to_world=pose)])
    assert _refused(memory, {"cam03": 0.5}) == []


def test_what_moves_through_a_picture_is_no_reason_to_refuse_it() -> None:
    memory = _memory(ring(8, size=32))
    _refused(memory, {})
    view = memory["cam03"].view

    def pixels(of: View, points: np.ndarray) -> np.ndarray:
        image = of.image.astype(np.float32) / 255.0
        if of is view:
            image[:13] = 1.0 - image[:13]  # a good third of it
        column, row = points.astype(np.int64).T
        return image[row, column]

    views = [m.view for m in memory.values()]
    assert not find_outliers(views, memory, 2.5, True, lambda *of: list(map(pixels, *of))).any()


@every_field
def test_a_refused_camera_is_named_and_pictures_that_are_known_are_not_judged_again(name: str) -> None:
    field = small(name)
    views = ring(13, size=32)
    for update in range(4):
        field.fit([replace(v, generated_ns=update * 100 * MS) for v in views], Budget(steps=40))
    wrong = [replace(v, generated_ns=500 * MS) for v in views]
    noise = np.random.default_rng(1).integers(0, 256, views[3].image.shape, dtype=np.uint8)
    wrong[3] = replace(wrong[3], image=noise)
    assert field.fit(wrong, Budget(steps=26)).refused == ("cam03",)
    credit = field.view_store.memory["cam03"].refusals_left
    assert credit < MOST_REFUSALS
    again = field.fit(wrong, Budget(steps=26))
    other = small(name)
    other.load_state(field.state())
    resumed = other.fit(wrong, Budget(steps=26))
    assert again.refused == resumed.refused == ("cam03",)
    assert field.view_store.memory["cam03"].refusals_left == other.view_store.memory["cam03"].refusals_left == credit
    assert field.fit([replace(v, generated_ns=600 * MS) for v in views], Budget(steps=26)).refused == ()


def test_cameras_whose_errors_are_learnt_are_not_refused() -> None:
    field = small("ngp", exposure=True)
    views = ring(13, size=32)
    field.fit(views, Budget(steps=150))
    dark = [replace(v, generated_ns=100 * MS) for v in views]
    dark[3] = replace(dark[3], image=(views[3].image * 0.2).astype(np.uint8))
    assert field.fit(dark, Budget(steps=26)).refused == ()


@every_field
def test_a_snapshot_is_of_the_box_the_field_has(name: str) -> None:
    """Two cameras find one box, all of them another: what was learned is void, what is shown too."""
    field = small(name)
    views, shift = ring(13, size=32), np.eye(4)
    shift[:3, 3] = 3.0
    field.fit([replace(v, camera_to_world=shift @ v.camera_to_world) for v in views[:2]], Budget(steps=5))
    old = field.snapshot()
    field.fit(views, Budget(steps=5))
    assert field.view_store.box != old.box, "the same box: nothing was tested"
    assert field.snapshot().box == field.view_store.box


def test_three_views_cannot_outvote_one() -> None:
    memory = _memory(ring(3, size=32))
    assert _refused(memory, {}) == _refused(memory, {"cam01": 0.9}) == []
    assert {m.refusals_left for m in memory.values()} == {0}


def test_views_that_are_left_out_keep_the_others_weights() -> None:
    now = _later(STILL)
    data = _take_in(_settings(age_tau_ms=100.0), STILL, now)
    left = without_views(data, np.array([False, True, False, False]))
    a, b = data.first[1], data.first[2]
    assert (left.weight[a:b] == 0).all() and not ((left.drawn >= a) & (left.drawn < b)).any()
    np.testing.assert_array_equal(np.delete(left.weight, slice(a, b)), np.delete(data.weight, slice(a, b)))
    assert len(left.drawn) == len(data.pixels) - (b - a) and not np.isin(left.changed, range(a, b)).any()
    assert without_views(data, np.zeros(4, np.bool_)) is data and (data.weight > 0).all()
